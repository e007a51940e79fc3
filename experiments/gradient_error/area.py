"""The derivative of a sphere's covered area by its size: a number that shows the bias of
silhouettes alone.

    python -m experiments.gradient_error.area        # one minute; prints a table

Against central differences (2 % each way) of images with 64 rays per pixel, four views of 64
squared pixels. Beside the estimators as they are: silhouette edges with side rays farther away, and
pairs that look at no other triangle than the one that the front sample sees.
"""

from __future__ import annotations

from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt import backend
from appearance_opt.initial.sphere import sphere
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.positions import POSITIONS
from appearance_opt.render import gradient
from appearance_opt.render.boundary import edges, silhouette_walk
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.boundary.edges import Edges
from appearance_opt.render.boundary.pairs import Pairs
from appearance_opt.render.images import render_image
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.quality import Quality
from appearance_opt.views import ViewSampler
from experiments.gradient_error.problems import split

RESOLUTION, RADIUS, STEP = 64, 0.7, 0.02
EDGES = Quality(visibility=CameraRays((Edges(4.0),)))
PAIRS = Quality(visibility=Pairs())
SETTINGS: dict[str, tuple[Quality, tuple]] = {
    "edges 4, 8 rays": (EDGES, ()),
    "the same, side rays at 1e-3 pixels": (EDGES, (edges, "OFFSET", 1e-3 / RESOLUTION)),
    "the same, side rays at 1e-2 pixels": (EDGES, (edges, "OFFSET", 1e-2 / RESOLUTION)),
    "pairs": (PAIRS, ()),
    "pairs without a walk": (PAIRS, (silhouette_walk, "LONGEST", 1)),
    "pairs, 2 x 2": (Quality(4, visibility=Pairs()), ()),
}


def ball(splits: int) -> LatentMesh:
    """A sphere of 1,200 triangles, split in four ``splits`` times."""
    mesh = sphere(1200, (0.0, 0.0, 0.0), RADIUS, 16)
    p, f = mesh.positions.astype(np.float64), mesh.faces
    for _ in range(splits):
        p, f = split(p, f)
        p *= RADIUS / np.linalg.norm(p, axis=1, keepdims=True)
    f = f.astype(np.int32)
    return LatentMesh(
        p.astype(np.float32),
        f,
        np.arange(len(p), dtype=np.int32),
        f,
        np.zeros((len(p), 2), np.float32),
    )


def estimated(model: Latent, batch: Batch, quality: Quality) -> float:
    """dArea/dScale."""
    start = np.array(model.vertices())
    positions = mi.Float(start)
    dr.enable_grad(positions)
    drawn = model.drawn(surface=model.surface(positions), walkable=True)
    rendered = gradient.render(drawn, batch, quality, 0)
    by_image = np.zeros((batch.grid.pixels, 4), np.float32)
    by_image[:, 3] = 1
    gradient.backward(gradient.surrogate(rendered, drawn.shown, mi.Float(by_image.ravel())))
    return float(np.array(dr.grad(positions)).astype(np.float64) @ start)


def measured(model: Latent, batch: Batch) -> float:
    """The same by differences."""
    start = np.array(model.vertices())
    areas = []
    for scale in (1 + STEP, 1 - STEP):
        model.parameters[POSITIONS].value = mi.Float(start * scale)
        model.update_scene()
        drawn = model.drawn()
        image = render_image(drawn, batch, 64)
        areas.append(float(np.array(image).reshape(-1, 4)[:, 3].astype(np.float64).sum()))
    model.parameters[POSITIONS].value = mi.Float(start)
    model.update_scene()
    return (areas[0] - areas[1]) / (2 * STEP)


def main() -> None:
    backend.select("cpu")
    records = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=5).draw(1, 4).records()
    batch = Batch(records, Grid(4, RESOLUTION))
    constants = {"red": 0.6, "green": 0.3, "blue": 0.2, "roughness": 0.5, "metalness": 0.2}
    columns = []
    for splits in (0, 1, 2):
        model = latent_of(ball(splits), constants, frozenset(("shape",)), Rates())
        truth = measured(model, batch)
        column = [f"{len(model.mesh.faces):,} triangles"]
        for quality, change in SETTINGS.values():
            if change:
                with mock.patch.object(*change):
                    value = estimated(model, batch, quality)
            else:
                value = estimated(model, batch, quality)
            column.append(f"{100 * (value / truth - 1):+.1f} %")
        columns.append(column)
    print(
        "| estimator | " + " | ".join(c[0] for c in columns) + " |\n|---|" + "---|" * len(columns)
    )
    for k, name in enumerate(SETTINGS, 1):
        print(f"| {name} | " + " | ".join(c[k] for c in columns) + " |")


if __name__ == "__main__":
    main()
