"""Automatic cleanup: how much of the volume, silhouette and look that damage took is won back?

    python -m experiments.cleanup [--assets chess_king,flight_helmet] [--kinds "volume;detached;..."] [--budget 60]
    python -m experiments.cleanup --table

Each asset is simplified without a fit, damaged (``damage.py``), and mended in two ways: "init" is
``simplify --init BAD.glb --absolute``, "joint" is ``joint --subdivision 2``, which keeps
BAD's texture coordinates and adds a displacement map. "Won back": the share of the difference
between the damaged mesh and the undamaged start that is undone. Results are kept row by row in
``out/cleanup/results.json``, and a picture of each row (reference, start, damaged, cleaned, in two
views) beside it. Needs ``../shared/judge/references``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import appearance_opt as ao
from appearance_opt.asset.images import encode_png
from appearance_opt.asset.types import Asset
from experiments.cleanup.damage import DAMAGES, damaged, pieces, volume
from experiments.common import OUT as RESULTS
from experiments.common import Kept, source_of

OUT = RESULTS / "cleanup"
TRIANGLES = {"chess_king": 2432, "flight_helmet": 4622}
WAYS = ("init", "joint")
VIEWS, LEVEL = 8, 2


def measured(
    source: Path, asset: Asset, box: tuple[np.ndarray, np.ndarray]
) -> tuple[dict, np.ndarray]:
    """Look and shape of a candidate (its volume as a share of a box), and its image beside the
    reference's."""
    from appearance_opt.render.display import display

    compared = ao.compare(source, asset, views=VIEWS)
    names = ("psnr_covered", "flip", "silhouette_shift", "silhouette_iou")
    look = {n: getattr(compared.metrics, n) for n in names}
    images = np.stack(
        [
            display(i[:2]).reshape(-1, *i.shape[2:3], 3)
            for i in (compared.reference, compared.candidate)
        ]
    )
    return {**look, "volume": volume(asset, box), "pieces": pieces(asset)}, images


def mended(source: Path, bad: Path, way: str, common: dict) -> ao.SimplifyResult:
    """The spoilt file after the fit."""
    from appearance_opt.jobs.joint import joint

    if way == "joint":
        return joint(source, bad, None, ao.joint_options(subdivision=(LEVEL,), **common))
    options = ao.simplify_options(init=str(bad), relative=False, **common)
    return ao.simplify(source, None, options)


def row(asset: str, kinds: tuple[str, ...], way: str, common: dict) -> dict:
    """Start, damaged, cleaned."""
    source, start = source_of(asset), OUT / f"{asset}_start.glb"
    if not start.exists():
        ao.simplify(source, start, ao.simplify_options(triangles=TRIANGLES[asset], steps=0))
    good = ao.load(start)
    bad = OUT / f"{asset}_{'_'.join(kinds)}.glb"
    spoilt = damaged(good, kinds)
    ao.save(spoilt, bad)
    result = mended(source, bad, way, common)
    ao.save(result.shown, bad.with_name(f"{bad.stem}_{way}.glb"))
    states = {
        n: measured(source, v, good.bounds())
        for n, v in (("start", good), ("damaged", spoilt), ("cleaned", result.shown))
    }
    strip = np.concatenate(
        [states["start"][1][0], *(images[1] for _, images in states.values())], axis=1
    )
    picture = encode_png((np.clip(strip, 0, 1) * 255 + 0.5).astype(np.uint8))
    bad.with_name(f"{bad.stem}_{way}.png").write_bytes(picture)
    facts = {
        "seconds": result.seconds["total"],
        "steps": result.fit.steps,
        "drawn": result.shown.triangle_count,
    }
    return {**facts, **{n: look for n, (look, _) in states.items()}}


def won_back(r: dict, name: str) -> float:
    """Share, in percent, of the damage in one measure that was undone: negative if it grew."""
    before, after, good = (r[k][name] for k in ("damaged", "cleaned", "start"))
    return 100 * (1 - abs(after - good) / abs(before - good)) if good != before else 100.0


def table(rows: list[dict]) -> str:
    """Markdown."""
    lines = [
        "| asset | damage | way | PSNR: start, damaged, cleaned | silhouette shift | volume, of the start's | pieces "
        "| won back: volume, silhouette, FLIP |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        s, d, c = (r[k] for k in ("start", "damaged", "cleaned"))
        share = ", ".join(f"{won_back(r, n):.0f} %" for n in ("volume", "silhouette_shift", "flip"))
        psnr = ", ".join(f"{x['psnr_covered']:.1f}" for x in (s, d, c))
        shift = ", ".join(f"{x['silhouette_shift']:.2f}" for x in (s, d, c))
        size = ", ".join(f"{x['volume'] / s['volume']:.3f}" for x in (d, c))
        count = ", ".join(str(x["pieces"]) for x in (s, d, c))
        names = f"{r['asset']} | {', '.join(r['kinds'])} | {r['way']}"
        lines.append(f"| {names} | {psnr} | {shift} | {size} | {count} | {share} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--assets", default=",".join(TRIANGLES))
    parser.add_argument(
        "--kinds",
        default=";".join(DAMAGES) + ";" + ",".join(DAMAGES),
        help="sets, ';' between them",
    )
    parser.add_argument("--ways", default=",".join(WAYS))
    parser.add_argument("--budget", type=float, default=60.0)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--table", action="store_true")
    a = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    kept = Kept(OUT / "results.json")
    common = {"budget": a.budget} if a.steps is None else {"steps": a.steps}
    cases = [
        (n, k.split(","), w)
        for n in a.assets.split(",")
        for k in a.kinds.split(";")
        for w in a.ways.split(",")
    ]
    for asset, kinds, way in cases if not a.table else ():
        key = {"asset": asset, "kinds": kinds, "way": way, "common": common}
        found = kept.row(
            key, lambda asset=asset, kinds=kinds, way=way: row(asset, tuple(kinds), way, common)
        )
        print(table([found]).splitlines()[2], flush=True)
    print(table(kept.rows))


if __name__ == "__main__":
    main()
