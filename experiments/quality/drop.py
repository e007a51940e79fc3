"""Does a result lose more in another renderer than another tool's result does?

    python -m experiments.quality.drop --blender BPY/bin/python [--rows spot:1404,...] [--seeds 4]

The PSNR of our result and of Blender's (decimate, unwrap, Cycles bake) against the same reference,
by our own ``compare`` and by the neutral renderer in ``../shared/judge``. Both look from other
places under other lights, so only the difference of the two drops says something: fitting to images
of our own renderer could make a result that suits that renderer alone. ``--seeds``: sets of 24
views, whose means are taken; with several, the table says how far the difference of the two drops
is known (standard error over the sets). Needs the results of ``python -m experiments.quality`` and
Blender's package in an environment of its own (see experiments/baking). What is on disk in
``out/drop`` is not made again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from experiments.baking.pairs import SIZE, maps_of_blender
from experiments.common import OUT, judge, needs_judge, source_of
from experiments.quality.__main__ import OUT as QUALITY
from experiments.quality.__main__ import ROWS

FOLDER = OUT / "drop"
VIEWS, FIRST_SEED = 24, 1234
"""Views of a set, and the neutral renderer's seed for the first one."""

REACH = 0.02
"""Blender's cage, in units of the reference's radius."""


def blender_result(python: str, reference: Path, triangles: int, stem: Path) -> Path:
    """Blender's light mesh with its maps."""
    from appearance_opt import load, save
    from appearance_opt.asset.types import Asset
    from appearance_opt.placement import Placement

    low, result, maps = Path(f"{stem}_low.glb"), Path(f"{stem}_blender.glb"), Path(f"{stem}_maps")
    if result.exists():
        return result
    here = Path(__file__).parent
    command = [python, str(here / "blender_simplify.py"), str(reference), str(triangles), str(low)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    radius = Placement.around(load(reference).points()).scale
    bake = here.parent / "baking" / "blender_bake.py"
    command = [
        python,
        str(bake),
        str(reference),
        str(low),
        str(maps),
        str(SIZE),
        str(REACH * radius),
        "4",
    ]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    save(Asset((maps_of_blender(load(low).meshes[0], maps),), "blender"), result)
    return result


def run_row(python: str, asset: str, triangles: int, seeds: int) -> dict:
    """Scores of both results in both renderers: PSNR by tool, by renderer, one for each set of
    views."""
    from appearance_opt import compare

    FOLDER.mkdir(parents=True, exist_ok=True)
    reference, ours = source_of(asset), QUALITY / f"{asset}_{triangles}_default.glb"
    if not ours.is_file():
        sys.exit(f"{ours} is not there: run python -m experiments.quality first")
    stem = FOLDER / f"{asset}_{triangles}"
    candidates = {
        "ours": str(ours),
        "blender": str(blender_result(python, reference, triangles, stem)),
    }
    row: dict = {"asset": asset, "triangles": triangles} | {
        n: {"compare": [], "judge": []} for n in candidates
    }
    for k in range(seeds):
        judged = judge(reference, candidates, stem, VIEWS, seed=FIRST_SEED + k)
        for name, path in candidates.items():
            row[name]["judge"].append(judged[name]["psnr_cov"])
            row[name]["compare"].append(
                compare(reference, path, views=VIEWS, seed=k).metrics.psnr_covered
            )
    return row


def table_line(row: dict) -> str:
    """Markdown: means over the sets of views, and how much more ours drops, with its standard
    error."""
    drops, cells = [], []
    for name in ("ours", "blender"):
        own, judged = (np.array(row[name][k]) for k in ("compare", "judge"))
        drops.append(own - judged)
        cells.append(f"{own.mean():.2f}, {judged.mean():.2f}, {drops[-1].mean():+.2f}")
    more = drops[0] - drops[1]
    known = f" ± {more.std(ddof=1) / len(more) ** 0.5:.2f}" if len(more) > 1 else ""
    return f"| {row['asset']}, {row['triangles']} | {cells[0]} | {cells[1]} | {more.mean():+.2f}{known} |"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--blender", required=True, metavar="PYTHON")
    parser.add_argument("--rows", default="spot:1404,chess_king:2432,flight_helmet:1367")
    parser.add_argument("--seeds", type=int, default=1)
    a = parser.parse_args()
    needs_judge()
    wanted = {tuple(r.split(":")) for r in a.rows.split(",")}
    print(
        "| asset, triangles | ours: compare, judge, drop (dB) | Blender: compare, judge, drop (dB) | more |"
    )
    print("|---|---|---|---|")
    rows = []
    for asset, _, triangles in ROWS:
        if (asset, str(triangles)) in wanted:
            rows.append(run_row(a.blender, asset, triangles, a.seeds))
            print(table_line(rows[-1]), flush=True)
    (FOLDER / "drop.json").write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
