"""Quality on real assets, by a neutral renderer: start and fitted result against what other tools
reach.

    python -m experiments.quality [--preset default] [--rows spot:1404,...] [--views 24]

Needs the folder ``../shared/judge`` (a renderer that is not ours, reference GLBs and the other
tools' scores in ``peers.json``). Results are kept in ``out/quality/<preset>.json``, one row at a
time, so that a broken run goes on where it stopped; a row of other views is another row.
``--table`` prints the table for docs/quality.md from what is there.
"""

from __future__ import annotations

import argparse
import json

from experiments.common import JUDGE, Kept, isolated, judge, needs_judge, source_of
from experiments.common import OUT as RESULTS

OUT = RESULTS / "quality"
ROWS = (
    ("spot", "0.05", 4684),
    ("spot", "0.015", 1404),
    ("chess_king", "0.05", 8104),
    ("chess_king", "0.015", 2432),
    ("flight_helmet", "0.05", 4622),
    ("flight_helmet", "0.015", 1367),
)
METRICS = ("psnr_cov", "flip", "sil_shift_px")
SIMPLIFY = """
import json, sys
import appearance_opt as a
o = a.simplify_options(sys.argv[4], triangles=int(sys.argv[3]))
r = a.simplify(sys.argv[1], sys.argv[2] + ".glb", o, report=sys.argv[2] + ".report")
a.save(r.start, sys.argv[2] + "_start.glb")
print(json.dumps({"seconds": r.seconds, "steps": r.fit.steps, "best": r.fit.best_step}))
"""


def run_row(asset: str, triangles: int, preset: str, views: int) -> dict:
    """Simplify one asset in a fresh process and judge its start and its result."""
    OUT.mkdir(parents=True, exist_ok=True)
    reference, stem = source_of(asset), OUT / f"{asset}_{triangles}_{preset}"
    job = isolated(SIMPLIFY, str(reference), str(stem), str(triangles), preset)
    files = {"start": f"{stem}_start.glb", "result": f"{stem}.glb"}
    return {**judge(reference, files, stem, views, pictures=OUT / "pictures"), **job}


def best_tool(asset: str, ratio: str) -> dict:
    """The other tool with the highest PSNR in this row."""
    peers = json.loads((JUDGE / "peers.json").read_text())[asset][ratio]
    return max(peers, key=lambda p: p["psnr_cov"])


def table(rows: list[dict]) -> str:
    """Markdown: PSNR / FLIP / silhouette shift of the best tool, our start and our result."""
    lines = [
        "| asset, triangles | best other tool | our start | our result | gain (dB) | FLIP ratio | seconds, steps |",
        "|---|---|---|---|---|---|---|",
    ]
    gains, ratios = [], []
    for row in rows:
        ratio = next(r for a, r, t in ROWS if (a, t) == (row["asset"], row["triangles"]))
        tool = best_tool(row["asset"], ratio)
        cells = [
            " / ".join(f"{s[m]:.{d}f}" for m, d in zip(METRICS, (2, 4, 3), strict=True))
            for s in (tool, row["start"], row["result"])
        ]
        gains.append(row["result"]["psnr_cov"] - tool["psnr_cov"])
        ratios.append(row["result"]["flip"] / tool["flip"])
        lines.append(
            f"| {row['asset']}, {row['triangles']} | {cells[0]} ({tool['peer']}) | {cells[1]} | {cells[2]} | "
            f"{gains[-1]:+.2f} | {ratios[-1]:.2f} | {row['seconds']['total']:.0f}, {row['steps']} |"
        )
    n = max(len(rows), 1)
    lines.append(f"| mean | | | | {sum(gains) / n:+.2f} | {sum(ratios) / n:.2f} | |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--preset", default="default")
    parser.add_argument("--rows", default="")
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--table", action="store_true")
    a = parser.parse_args()
    kept = Kept(OUT / f"{a.preset}.json")
    asked = {"preset": a.preset, "views": a.views}
    if not a.table:
        needs_judge()
        wanted = {tuple(r.split(":")) for r in a.rows.split(",") if r}
        for asset, _, triangles in ROWS:
            if not wanted or (asset, str(triangles)) in wanted:
                key = {"asset": asset, "triangles": triangles, **asked}
                row = kept.row(key, lambda n=asset, t=triangles: run_row(n, t, a.preset, a.views))
                print(table([row]).splitlines()[2], flush=True)
    print(table(kept.of(asked)))


if __name__ == "__main__":
    main()
