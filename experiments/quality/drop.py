"""Does a result lose more in another renderer than another tool's result does?

    python -m experiments.quality.drop --blender BPY/bin/python [--rows spot:1404,...]

The PSNR of our result and of Blender's (decimate, unwrap, Cycles bake) against the same reference, by our own
``compare`` and by the neutral renderer in ``../shared/judge``. Both look from other places under other lights, so
only the difference of the two drops says something: fitting to images of our own renderer could make a result that
suits that renderer alone. Needs the results of ``python -m experiments.quality`` and Blender's package in an
environment of its own (see experiments/baking). What is on disk in ``out/drop`` is not made again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from experiments.baking.__main__ import SIZE, judge, maps_of_blender
from experiments.quality.__main__ import JUDGE, OUT, ROOT, ROWS

FOLDER = ROOT / "out" / "drop"
REACH = 0.02
"""Blender's cage, in units of the reference's radius."""


def blender_result(python: str, reference: Path, triangles: int, stem: Path) -> Path:
    """Blender's light mesh with its maps."""
    from appearance_opt import load, save
    from appearance_opt.asset.types import Asset
    from appearance_opt.views import framing

    low, result, maps = Path(f"{stem}_low.glb"), Path(f"{stem}_blender.glb"), Path(f"{stem}_maps")
    if result.exists():
        return result
    here = Path(__file__).parent
    command = [python, str(here / "blender_simplify.py"), str(reference), str(triangles), str(low)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    _, radius = framing(np.concatenate([m.positions for m in load(reference).meshes]))
    bake = here.parent / "baking" / "blender_bake.py"
    command = [python, str(bake), str(reference), str(low), str(maps), str(SIZE), str(REACH * radius), "4"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    save(Asset((maps_of_blender(load(low).meshes[0], maps),), "blender"), result)
    return result


def run_row(python: str, asset: str, triangles: int) -> dict:
    """Scores of both results in both renderers."""
    from appearance_opt import compare

    FOLDER.mkdir(parents=True, exist_ok=True)
    reference = JUDGE / "references" / f"{asset}.glb"
    stem = FOLDER / f"{asset}_{triangles}"
    candidates = {
        "ours": str(OUT / f"{asset}_{triangles}_default.glb"),
        "blender": str(blender_result(python, reference, triangles, stem)),
    }
    judged = judge(reference, candidates, stem, 24)
    row: dict = {"asset": asset, "triangles": triangles}
    for name, path in candidates.items():
        own = compare(reference, path, views=24).metrics.psnr_covered
        row[name] = {"compare": own, "judge": judged[name]["psnr_cov"]}
    return row


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--blender", required=True, metavar="PYTHON")
    parser.add_argument("--rows", default="spot:1404,chess_king:2432,flight_helmet:1367")
    a = parser.parse_args()
    if not JUDGE.exists():
        sys.exit(f"{JUDGE} is not there: this experiment needs the neutral renderer and its references")
    wanted = {tuple(r.split(":")) for r in a.rows.split(",")}
    print("| asset, triangles | ours: compare, judge, drop (dB) | Blender: compare, judge, drop (dB) |\n|---|---|---|")
    rows = []
    for asset, _, triangles in ROWS:
        if (asset, str(triangles)) not in wanted:
            continue
        rows.append(run_row(a.blender, asset, triangles))
        cells = [
            f"{s['compare']:.2f}, {s['judge']:.2f}, {s['compare'] - s['judge']:+.2f}"
            for s in (rows[-1]["ours"], rows[-1]["blender"])
        ]
        print(f"| {asset}, {triangles} | {cells[0]} | {cells[1]} |", flush=True)
    (FOLDER / "drop.json").write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
