"""Does a result look like its original in other engines? One table, in dB of covered PSNR.

    python -m experiments.engines [NAME ...] [--blender PYTHON] [--web FOLDER] [--pairs REF=RESULT]

Each engine draws original and result itself, from the cameras and under the lights of
``appearance-opt compare``: our own renderer; Mitsuba's path tracer with stock plugins, under the
lamp alone and under a sky with two bounces, with shadows; Cycles with and without shadows, where
``--blender`` names a Python with ``bpy``; three.js and Babylon.js, where ``--web`` names a folder
with the modules of ``package.json``. Rows are kept in ``out/engines``; ``--again`` forgets them.
"""

from __future__ import annotations

import argparse
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from experiments.common import OUT as RESULTS
from experiments.common import Kept, isolated, source_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

OUT = RESULTS / "engines"


def _bust() -> Path:
    """The scan-like asset as a file."""
    from appearance_opt import save
    from experiments.engines.bust import bust

    path = RESULTS / "scenes" / "bust.glb"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        save(bust(), path)
    return path


ROWS: dict[str, tuple[Callable[[], Path], int]] = {
    "spot": (lambda: source_of("spot"), 4684),
    "chess_king": (lambda: source_of("chess_king"), 3242),
    "flight_helmet": (lambda: source_of("flight_helmet"), 3759),
    "relic": (lambda: source_of("relic"), 8182),
    "bust": (_bust, 2000),
}
"""Assets, and the triangles of their results: 2 to 5 %."""

SIMPLIFY = """
import json, sys
import appearance_opt as a
o = a.simplify_options(triangles=int(sys.argv[3]), steps=int(sys.argv[4]))
r = a.simplify(sys.argv[1], sys.argv[2], o)
print(json.dumps({"steps": r.fit.steps, "best": r.fit.best_step}))
"""
SUPERSAMPLED = 4
"""Pixels of a rasteriser per pixel and axis: it shades each pixel once."""


def measure(
    reference: Path, candidate: Path, options: argparse.Namespace, name: str
) -> dict[str, float]:
    """Covered PSNR by engine; contact sheets in ``OUT``/sheets."""
    from appearance_opt import load
    from appearance_opt.evaluate.metrics import compare_images
    from appearance_opt.evaluate.path_traced import PathTraced
    from experiments.engines.views import Sitting, own_images, read_pictures, write_sheet

    both = [load(p) for p in (reference, candidate)]
    sitting = Sitting.of(both[0], options.views)
    size, spp = options.res, options.spp
    folder = OUT / "pictures" / name
    folder.mkdir(parents=True, exist_ok=True)
    sitting.write(folder / "views.json")
    out = {}

    def add(engine: str, first: NDArray, second: NDArray) -> None:
        out[engine] = compare_images(first, second).psnr_covered
        write_sheet(OUT / "sheets" / f"{name}_{engine.replace(' ', '_')}.png", first, second)

    def add_pictures(engine: str, command: list[str], shrink: int = 1) -> None:
        pictures = folder / engine.replace(" ", "_")
        pictures.mkdir(exist_ok=True)
        program, script, *more = command
        files = [f"reference={reference.resolve()}", f"result={candidate.resolve()}"]
        here = [program, str(Path(__file__).with_name(script)), *more]
        run = [*here, str(folder / "views.json"), str(pictures), *files]
        cwd = options.web if script.endswith(".mjs") else None
        done = subprocess.run(run, capture_output=True, text=True, cwd=cwd)
        if done.returncode:
            raise SystemExit(f"{engine}: {done.stderr[-2000:]}")
        first, second = (
            read_pictures(pictures, n, options.views, shrink) for n in ("reference", "result")
        )
        add(engine, first, second)

    add("own", *(own_images(sitting, a, size) for a in both))
    local = [sitting.placement.local(a) for a in both]
    for engine, sky, depth in (("mitsuba direct", False, 2), ("mitsuba sky", True, 4)):
        drawn = (PathTraced(a, sky, depth).render(sitting.views, size, spp) for a in local)
        add(engine, *drawn)
    if options.blender:
        drawing = ["--res", str(size), "--spp", str(spp)]
        for engine, more in (("cycles", []), ("cycles shadows", ["--shadows"])):
            add_pictures(engine, [options.blender, "blender_views.py", *drawing, *more])
    if options.web:
        drawing = ["--res", str(size * SUPERSAMPLED)]
        for engine in ("three", "babylon"):
            add_pictures(engine, ["node", "web.mjs", engine, *drawing], SUPERSAMPLED)
    return out


def run_row(name: str, options: argparse.Namespace) -> dict[str, float]:
    """Simplify one asset, and measure the result."""
    source, triangles = ROWS[name]
    folder = OUT / "results"
    folder.mkdir(parents=True, exist_ok=True)
    result = folder / f"{name}.glb"
    done = isolated(SIMPLIFY, str(source()), str(result), str(triangles), str(options.steps))
    return {**measure(source(), result, options, name), **done}


def table(rows: list[dict]) -> str:
    """Markdown: dB by engine, and the drop from our own."""
    if not rows:
        return "no rows"
    engines = [k for k, v in rows[0].items() if isinstance(v, float)]
    lines = ["| asset | " + " | ".join(engines) + " |", "|---" * (len(engines) + 1) + "|"]
    for row in rows:
        cells = [f"{row['own']:.1f}"]
        cells += [f"{row[e]:.1f} ({row[e] - row['own']:+.1f})" for e in engines[1:]]
        lines.append(f"| {row['asset']} | " + " | ".join(cells) + " |")
    means = [float(np.mean([r[e] for r in rows])) for e in engines]
    cells = [f"{means[0]:.1f}", *(f"{m:.1f} ({m - means[0]:+.1f})" for m in means[1:])]
    return "\n".join([*lines, "| mean | " + " | ".join(cells) + " |"])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", help=f"of {', '.join(ROWS)}")
    parser.add_argument(
        "--pairs", nargs="*", default=[], help="REFERENCE=RESULT: files as they are"
    )
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--res", type=int, default=192)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--spp", type=int, default=48)
    parser.add_argument("--blender", help="a Python with bpy")
    parser.add_argument("--web", type=Path, help="a folder with node_modules")
    parser.add_argument("--again", action="store_true")
    a = parser.parse_args()
    if a.pairs:
        rows = []
        for pair in a.pairs:
            reference, candidate = (Path(p) for p in pair.split("=", 1))
            row = {"asset": candidate.stem, **measure(reference, candidate, a, candidate.stem)}
            print(table([row]).splitlines()[2], flush=True)
            rows.append(row)
        print(table(rows))
        return
    kept = Kept(OUT / "rows.json")
    if a.again:
        kept.rows = []
    asked = {n: getattr(a, n) for n in ("steps", "res", "views", "spp")}
    asked |= {"blender": bool(a.blender), "web": bool(a.web)}
    for name in a.names or ROWS:
        row = kept.row({"asset": name, **asked}, lambda n=name: run_row(n, a))
        print(table([row]).splitlines()[2], flush=True)
    print(table(kept.of(asked)))


if __name__ == "__main__":
    main()
