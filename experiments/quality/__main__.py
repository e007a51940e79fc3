"""Quality on real assets, by a neutral renderer: start and fitted result against what other tools reach.

    python -m experiments.quality [--preset default] [--rows spot:1404,...] [--views 24]

Needs the folder ``../shared/judge`` (a renderer that is not ours, reference GLBs and the other tools' scores in
``peers.json``). Results are appended to ``out/quality/<preset>.json``, one row at a time, so that a broken run
goes on where it stopped; ``--table`` prints the table for docs/quality.md from what is there.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
JUDGE = ROOT.parent / "shared" / "judge"
OUT = ROOT / "out" / "quality"
ROWS = (
    ("spot", "0.05", 4684),
    ("spot", "0.015", 1404),
    ("chess_king", "0.05", 8104),
    ("chess_king", "0.015", 2432),
    ("flight_helmet", "0.05", 4622),
    ("flight_helmet", "0.015", 1367),
)
METRICS = ("psnr_cov", "flip", "sil_shift_px")


def run_row(asset: str, triangles: int, preset: str, views: int) -> dict:
    """Simplify one asset in a fresh process and judge its start and its result."""
    OUT.mkdir(parents=True, exist_ok=True)
    reference = JUDGE / "references" / f"{asset}.glb"
    stem = OUT / f"{asset}_{triangles}_{preset}"
    code = (
        "import json, sys, appearance_opt as a;"
        "o = a.simplify_options(sys.argv[4], triangles=int(sys.argv[3]));"
        "r = a.simplify(sys.argv[1], sys.argv[2] + '.glb', o, report=sys.argv[2] + '.report');"
        "a.save(r.start, sys.argv[2] + '_start.glb');"
        "print(json.dumps({'seconds': r.seconds, 'steps': r.fit.steps, 'best': r.fit.best_step}))"
    )
    arguments = [sys.executable, "-c", code, str(reference), str(stem), str(triangles), preset]
    job = subprocess.run(arguments, check=True, capture_output=True, text=True)
    scores = stem.with_suffix(".judge.json")
    judged = [f"{stem}_start.glb", f"{stem}.glb"]
    options = ["--views", str(views), "--spp", "36", "--json", str(scores), "--dump", str(OUT / "pictures")]
    command = [sys.executable, str(JUDGE / "evaluate.py"), str(reference), *judged, *options]
    subprocess.run(command, check=True, capture_output=True, cwd=JUDGE)
    start, result = json.loads(scores.read_text())["candidates"]
    return {"asset": asset, "triangles": triangles, "start": start, "result": result, **json.loads(job.stdout)}


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
    path = OUT / f"{a.preset}.json"
    rows = json.loads(path.read_text()) if path.exists() else []
    if not a.table:
        if not JUDGE.exists():
            sys.exit(f"{JUDGE} is not there: this experiment needs the neutral renderer and its references")
        wanted = {tuple(r.split(":")) for r in a.rows.split(",") if r}
        done = {(r["asset"], r["triangles"]) for r in rows}
        for asset, _, triangles in ROWS:
            if (asset, triangles) in done or (wanted and (asset, str(triangles)) not in wanted):
                continue
            rows.append(run_row(asset, triangles, a.preset, a.views))
            path.write_text(json.dumps(rows, indent=1))
            print(table(rows[-1:]).splitlines()[2], flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
