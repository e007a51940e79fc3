"""Distance fields to textured meshes: how close, from which first shape, how fast rays are.

    python -m experiments.conversion [--rows sphere,isosurface,today,shapes,rays,libraries]
        [--triangles 12000] [--budget 280 | --steps N]
    python -m experiments.conversion --table

``sphere``, ``isosurface``: the beetle of ``scenes/beetle.py`` by ``convert sdf``, the latter before
the fit, too. ``today``: marching cubes at equal triangles (scikit-image alone), colours at vertices.
``shapes``: vertices of four fitted shapes, how far from the true surface. ``rays``: sphere tracing of
ten primitives, and marching by fixed steps. ``libraries``: marching cubes against dual contouring
where edges are sharp (needs isomesh). Rows are kept in ``out/conversion/results.json``.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

from experiments.common import OUT as RESULTS
from experiments.common import Kept
from experiments.conversion import fields, meshes

OUT = RESULTS / "conversion"
ROWS = ("sphere", "isosurface", "today", "shapes", "rays", "libraries")


def measure(row: str, options: dict[str, Any]) -> dict[str, Any]:
    """What a row of the table says."""
    if row in ("sphere", "isosurface"):
        init = {"sphere": "sphere", "isosurface": "marching-cubes"}[row]
        return meshes.converted(init, options, OUT / f"{row}.glb")
    if row == "today":
        return meshes.marched(options["triangles"], OUT / "today.glb")
    if row == "shapes":
        return {"distance (% of the diagonal)": meshes.shapes_off(options)}
    return fields.rays() if row == "rays" else fields.libraries()


def main() -> None:
    """Measure what is asked for, and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", default=",".join(ROWS))
    parser.add_argument("--triangles", type=int, default=12_000)
    parser.add_argument("--budget", type=float, default=280.0)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--table", action="store_true", help="only print what is there")
    given = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    kept = Kept(OUT / "results.json")
    limit = {"budget": given.budget} if given.steps is None else {"steps": given.steps}
    options = {"triangles": given.triangles, **limit}
    for row in () if given.table else given.rows.split(","):
        key = {"row": row, **options}
        kept.row(key, lambda row=row: measure(row, options))
    if (OUT / "isosurface.glb").exists() and (OUT / "today.glb").exists():
        files = [OUT / f"{n}.glb" for n in ("isosurface", "today")]
        meshes.picture(files, OUT / "beetle.png")
    for found in kept.rows:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
