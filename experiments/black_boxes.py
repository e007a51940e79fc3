"""References of which only images are known: how close fits come to them.

    python -m experiments.black_boxes [--rows slow,pictures,live,paths] [--triangles 3000]
        [--budget 300 | --steps N] [--resolution 256] [--cpu-clock]
    python -m experiments.black_boxes --table

``slow``: the demo scene behind a renderer that takes a second for each view. ``pictures``: a hundred
pictures of it on disk; ``live``: the same fit with the renderer itself. ``paths``: the demo scene and
``chess_king`` by a path tracer under an environment, baked (unlit), judged in the same light. All
start from their visual hull, and are judged by views that no fit saw. ``--cpu-clock`` counts time of
the processor and of waiting for the renderer instead of wall-clock time: for machines that do other
work, too; an idle one with several cores is faster. Rows are kept in ``out/black_boxes/``.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import TYPE_CHECKING, Any

import numpy as np

import appearance_opt as ao
from appearance_opt import backend
from appearance_opt.evaluate.comparison import render_asset
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.evaluate.path_traced import PathTraced
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.scene import SceneReference
from appearance_opt.reference.subject import Subject
from appearance_opt.views import MEASURED
from experiments.common import OUT as RESULTS
from experiments.common import Kept, Missing, source_of
from scenes.shoot import shoot

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.reference.base import Reference
    from appearance_opt.views import Views

OUT = RESULTS / "black_boxes"
ROWS = ("slow", "pictures", "live", "paths")
VIEWS, SIZE, PATHS = 8, 256, 32
PICTURES = 100
"""Their sides are half again as many pixels as the views of the fit have: views are framed to the
silhouettes, pictures to a sphere."""


class Waiting:
    """Images of an asset, each of which takes ``seconds``; ``waited``: so far."""

    def __init__(self, asset: ao.Asset, seconds: float) -> None:
        self._reference, self.seconds, self.waited = MeshReference(asset), seconds, 0.0
        self.bounds = np.array(self._reference.bounds, np.float64)
        self.pretend = False

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]:
        """See ``Reference``."""
        self.waited += self.seconds * len(views)
        if not self.pretend:
            time.sleep(self.seconds * len(views))
        return self._reference.render(views, resolution, samples)


def judge(reference: Reference, result: ao.Asset) -> dict[str, float]:
    """PSNR of covered pixels and FLIP, in views that no fit saw."""
    subject = Subject.of_reference(reference)
    views = subject.sampler.held_out(MEASURED).draw(0, VIEWS)
    truth = subject.reference.render(views, SIZE, 9)
    image = render_asset(subject.placement.local(result), views, SIZE, 9)
    found = compare_images(truth, image)
    return {k: round(float(v), 4) for k, v in vars(found).items() if isinstance(v, float)}


def measure(row: str, options: dict[str, Any], cpu_clock: bool) -> dict[str, Any]:
    """What a row of the table says."""
    if row == "paths":
        return {name: path_traced(name, options) for name in ("relic", "chess_king")}
    asset = ao.load(source_of("relic"))
    live = Waiting(asset, 1.0 if row == "slow" else 0.0)
    if row == "pictures":
        folder = OUT / f"shots{options['resolution']}"
        if not (folder / "transforms.json").exists():
            shoot(live, folder, PICTURES, options["resolution"] * 3 // 2, "point")
        result = ao.convert("images", folder, OUT / f"{row}.glb", **options)
    else:
        if cpu_clock:
            live.pretend = True
            time.perf_counter = lambda: time.process_time() + live.waited
        result = ao.convert("reference", live, OUT / f"{row}.glb", **options)
    live.seconds = 0.0
    return {**told(result), "views waited for": int(live.waited), **judge(live, result.asset)}


def path_traced(name: str, options: dict[str, Any]) -> dict[str, Any]:
    """The fit of an asset that a path tracer shows under an environment."""
    try:
        asset = ao.load(source_of(name))
    except Missing as missing:
        return {"missing": str(missing)}
    traced = PathTraced(asset, environment=True)
    reference = SceneReference(traced.scene, samples=PATHS)
    result = ao.convert("scene", traced.scene, OUT / f"{name}.glb", paths=PATHS, **options)
    return {**told(result), **judge(replace_samples(reference, 4 * PATHS), result.asset)}


def replace_samples(reference: SceneReference, samples: int) -> SceneReference:
    """The same reference with more paths."""
    reference.samples = samples
    return reference


def told(result: ao.SimplifyResult) -> dict[str, Any]:
    """What a job says of itself."""
    curve = [point.psnr for point in result.fit.curve]
    return {
        "triangles": result.triangles,
        "steps": result.fit.steps,
        "seconds": {k: round(v, 1) for k, v in result.seconds.items()},
        "held-out PSNR": [round(curve[0], 2), round(max(curve), 2)],
    }


def main() -> None:
    """Measure what is asked for, and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", default=",".join(ROWS))
    parser.add_argument("--triangles", type=int, default=3000)
    parser.add_argument("--budget", type=float, default=300.0)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--texture-size", type=int, default=1024)
    parser.add_argument("--cpu-clock", action="store_true")
    parser.add_argument("--table", action="store_true", help="only print what is there")
    given = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    backend.select()
    kept = Kept(OUT / "results.json")
    limit = {"budget": given.budget} if given.steps is None else {"steps": given.steps}
    options = {
        "triangles": given.triangles,
        "resolution": given.resolution,
        "texture_size": given.texture_size,
        "budget": None,
        **limit,
    }
    for row in () if given.table else given.rows.split(","):
        key = {"row": row, **options}
        kept.row(key, lambda row=row: measure(row, options, given.cpu_clock))
    for found in kept.rows:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
