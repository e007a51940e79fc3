"""Automatic cleanup: how much of the volume, silhouette and look that damage took is won back?

    python -m experiments.cleanup [--assets chess_king,flight_helmet] [--kinds volume,detached,...] [--budget 60]

Each asset is simplified without a fit, damaged (``damage.py``), and handed to ``simplify --init BAD.glb --absolute``.
"Won back" is 1 - (error after) / (error of the damaged mesh), above the error of the undamaged start. Results go to
``out/cleanup/results.json``. Needs ``../shared/judge/references``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import appearance_opt as ao
from appearance_opt.asset.types import Asset
from experiments.cleanup.damage import DAMAGES, damaged, pieces, volume

ROOT = Path(__file__).resolve().parents[2]
REFERENCES = ROOT.parent / "shared" / "judge" / "references"
OUT = ROOT / "out" / "cleanup"
TRIANGLES = {"chess_king": 2432, "flight_helmet": 4622}


def measured(source: Path, asset: Asset) -> dict:
    """Look and shape of a candidate."""
    m = ao.compare(source, asset, views=12).metrics
    names = ("psnr_covered", "flip", "silhouette_shift", "silhouette_iou")
    return {**{n: getattr(m, n) for n in names}, "volume": volume(asset), "pieces": pieces(asset)}


def row(asset: str, kinds: tuple[str, ...], common: dict) -> dict:
    """Start, damaged, cleaned."""
    source = REFERENCES / f"{asset}.glb"
    start = OUT / f"{asset}_start.glb"
    if not start.exists():
        ao.simplify(source, start, ao.simplify_options("default", triangles=TRIANGLES[asset], steps=0))
    good = ao.load(start)
    bad = OUT / f"{asset}_{'_'.join(kinds)}.glb"
    spoilt = damaged(good, kinds)
    ao.save(spoilt, bad)
    options = ao.simplify_options("default", init=str(bad), relative=False, position_rate=0.02, **common)
    result = ao.simplify(source, bad.with_name(bad.stem + "_cleaned.glb"), options)
    states = {"start": good, "damaged": spoilt, "cleaned": result.asset}
    return {
        "asset": asset,
        "kinds": list(kinds),
        "seconds": result.seconds["total"],
        "steps": result.fit.steps,
        **{k: measured(source, v) for k, v in states.items()},
    }


def won_back(r: dict, name: str) -> float:
    """Share of the damage in one measure that was undone."""
    before, after, good = (r[k][name] for k in ("damaged", "cleaned", "start"))
    return 100 * (after - before) / (good - before) if good != before else 100.0


def table(rows: list[dict]) -> str:
    """Markdown."""
    lines = [
        "| asset | damage | PSNR: start, damaged, cleaned | silhouette shift | volume, of the start's | pieces "
        "| won back: volume, silhouette, FLIP |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        s, d, c = (r[k] for k in ("start", "damaged", "cleaned"))
        share = ", ".join(f"{won_back(r, n):.0f} %" for n in ("volume", "silhouette_shift", "flip"))
        lines.append(
            f"| {r['asset']} | {', '.join(r['kinds'])} | {s['psnr_covered']:.1f}, {d['psnr_covered']:.1f}, "
            f"{c['psnr_covered']:.1f} | {s['silhouette_shift']:.2f}, {d['silhouette_shift']:.2f}, "
            f"{c['silhouette_shift']:.2f} | {d['volume'] / s['volume']:.3f}, {c['volume'] / s['volume']:.3f} | "
            f"{s['pieces']}, {d['pieces']}, {c['pieces']} | {share} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--assets", default="chess_king,flight_helmet")
    parser.add_argument("--kinds", default=";".join(DAMAGES) + ";" + ",".join(DAMAGES), help="sets, ';' between them")
    parser.add_argument("--budget", type=float, default=60.0)
    parser.add_argument("--steps", type=int)
    a = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    common = {"budget": a.budget} if a.steps is None else {"steps": a.steps}
    rows = []
    for asset in a.assets.split(","):
        for kinds in a.kinds.split(";"):
            rows.append(row(asset, tuple(kinds.split(",")), common))
            (OUT / "results.json").write_text(json.dumps(rows, indent=1))
            print(table(rows[-1:]).splitlines()[2], flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
