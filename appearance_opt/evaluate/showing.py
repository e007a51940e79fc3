"""What a report shows of a reference and of what was made from it: numbers from random views,
a picture from an upright one, previews in 3D."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.evaluate import pictures
from appearance_opt.evaluate.comparison import render_asset
from appearance_opt.evaluate.environment import distant_lights, render_environment
from appearance_opt.evaluate.hero import hero_view
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.evaluate.preview import preview_of
from appearance_opt.evaluate.verdict import at_sizes
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.pool import check_images
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.rays import trace_grid
from appearance_opt.views import MEASURED

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.evaluate.metrics import Metrics
    from appearance_opt.evaluate.preview import Preview
    from appearance_opt.evaluate.verdict import AtSize
    from appearance_opt.reference.base import Reference
    from appearance_opt.views import Sampler, Views

LIGHTS = 16
"""Of the environment in which the pictures are taken: as many rays per pixel."""

SMALL = 96
"""Pixels per side where a view is chosen."""


@dataclass(frozen=True)
class Looks:
    """How finely a report looks: random views of so many pixels and samples, and the pixels of the
    upright picture."""

    views: int = 8
    resolution: int = 384
    samples: int = 9
    pictured: int = 576


@dataclass
class Shown:
    """See ``ReportData``, whose fields these are."""

    metrics: dict[str, Metrics]
    by_size: list[AtSize]
    views: list[dict[str, NDArray[np.uint8]]]
    captions: list[str]
    previews: dict[str, Preview]
    azimuth: float
    elevation: float


def show(
    reference: Reference,
    original: Asset | None,
    columns: dict[str, Asset],
    result: Asset,
    sampler: Sampler,
    looks: Looks,
) -> Shown:
    """Look at a reference and at the ``columns`` of a report, the last of which is what came of it;
    ``result``: the asset that was written. All of them in local coordinates. ``original``: what the
    reference was made from, None if that is no asset: it has no preview then, and its pictures are
    lit by a lamp."""
    views = sampler.held_out(MEASURED).draw(0, looks.views)
    size, samples = looks.resolution, looks.samples
    drawn = check_images(reference.render(views, size, samples), len(views), size, "the report")
    images = {name: render_asset(a, views, size, samples) for name, a in columns.items()}
    metrics = {name: compare_images(drawn, image) for name, image in images.items()}
    last = list(columns)[-1]

    assert sampler.hull is not None
    hero = picture_upright(
        reference,
        original,
        columns[last],
        sampler.hull,
        looks.pictured,
        samples,
        None if sampler.listed is None else views,
    )
    worst = int(np.argmax([v.flip for v in metrics[last].views]))
    random = {
        "reference": pictures.picture(drawn[worst]),
        "result": pictures.picture(images[last][worst]),
    }
    caption = f"of {len(views)} random views the one that differs most (FLIP), under its lamp"
    previews = {} if original is None else {"original": preview_of(original)}
    return Shown(
        metrics=metrics,
        by_size=at_sizes(drawn, images[last], metrics[last]),
        views=[hero.pictures, random],
        captions=[hero.caption, caption],
        previews={**previews, "result": preview_of(result)},
        azimuth=hero.azimuth,
        elevation=hero.elevation,
    )


@dataclass
class Upright:
    """Pictures of one upright view by name, and where it stands, in degrees."""

    pictures: dict[str, NDArray[np.uint8]]
    caption: str
    azimuth: float
    elevation: float


def picture_upright(
    reference: Reference,
    original: Asset | None,
    final: Asset,
    points: NDArray,
    size: int,
    samples: int = 9,
    listed: Views | None = None,
) -> Upright:
    """Original, result and its wireframe from the side that shows most, ``size`` pixels wide.
    ``points`` (N, 3): of the original; ``original``: what ``reference`` was made from, or None;
    ``listed``: the only views that it can be seen in, if there are no others."""
    if listed is None:
        view = hero_view(points, lambda v: reference.render(v, SMALL, 4))
    else:
        shown = reference.render(listed, SMALL, 4)[..., 3].sum(axis=(1, 2))
        view = listed[[int(shown.argmax())]]
    if original is None:
        first = check_images(reference.render(view, size, samples), 1, size, "the report")
        second, light = render_asset(final, view, size, samples), "a lamp"
    else:
        lights = distant_lights(LIGHTS)
        first, second = (render_environment(a, view, size, lights) for a in (original, final))
        light = "a sky and three lamps"
    wires = triangle_images(final, view, 2 * size)
    x, y, z = view.eye[0] / np.linalg.norm(view.eye[0])
    return Upright(
        {
            "reference": pictures.picture(first[0]),
            "result": pictures.picture(second[0]),
            "wireframe": pictures.wireframe(second[0], wires[0]),
        },
        f"under {light}",
        float(np.degrees(np.arctan2(x, z))),
        float(np.degrees(np.arcsin(y))),
    )


def triangle_images(asset: Asset, views: Views, resolution: int) -> NDArray[np.int64]:
    """(B, H, W) index of the triangle seen in each pixel, -1 for none."""
    scene, grid = MeshReference(asset).scene, Grid(1, resolution)
    pixel = np.array(grid.index)
    out = np.empty((len(views), resolution * resolution), np.int64)
    for k in range(len(views)):
        hits, _ = trace_grid(scene, Batch(views[k : k + 1].records(), grid))
        triangle = np.array(hits.triangle).astype(np.int64)
        out[k, pixel] = np.where(triangle == MISS, -1, triangle)
    return out.reshape(len(views), resolution, resolution)
