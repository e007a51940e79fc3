"""Triangles go to where the image error is.

The quadric metric knows distances, not appearance: whether a flattened bump is seen depends on
contrast, on texture and on the directions it is seen from. So the decimated mesh is drawn beside
the reference, the error of the pixels is collected on the faces of the reference, and the reference
is decimated once more with the faces weighted by it. The best start of all rounds is kept.
What that gains: docs/trials.md: reallocation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import maximum_filter

from appearance_opt.initial.visibility import around, welded_areas
from appearance_opt.latent.mesh import LatentTopology
from appearance_opt.latent.texels import maps_of
from appearance_opt.render import rays
from appearance_opt.render.display import display
from appearance_opt.render.images import render_image
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, Grid

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.reference.base import Reference
    from appearance_opt.reference.survey import Triangles
    from appearance_opt.views import Sampler

VIEWS, BATCH, RESOLUTION, SAMPLES = 64, 8, 256, 4
"""Views in which the error is measured, and how."""

RINGS = 6
"""Rings of faces over which the error is averaged: about the size of a new triangle. Without it the
noise of single pixels would be taken for detail."""

FIXED_POINT = 2.0**32
"""Errors are added up as integers: threads may add them in any order without changing the start."""

POWER, LOWEST, HIGHEST = 0.35, 0.3, 3.0  # docs/trials.md: reallocation
"""Weight = (error over its median)^POWER within bounds. Larger powers overshoot."""


class StartError:
    """How far a start looks from the reference, over views that neither the fit nor its validation
    uses. ``triangles``: those of the reference on which the error is collected."""

    def __init__(
        self,
        reference: Reference,
        triangles: Triangles,
        sampler: Sampler,
        views: int = VIEWS,
    ) -> None:
        self.triangles = triangles
        grid = Grid(BATCH, RESOLUTION)
        drawn = [sampler.draw(k, BATCH) for k in range(views // BATCH)]
        self._batches = [Batch(v.records(), grid) for v in drawn]
        self._images = [display(reference.render(v, RESOLUTION, SAMPLES)) for v in drawn]

    def measure(
        self, mesh: LatentMesh, maps: Mapping[str, NDArray | float]
    ) -> tuple[float, NDArray[np.float64]]:
        """(mean squared display error, its sum over the pixels that show each face of the reference
        (F,))."""
        total = dr.zeros(mi.UInt64, len(self.triangles.faces))
        drawn = LatentTopology(mesh, tangents=True).drawn(maps_of(maps))
        mean = 0.0
        for batch, expected in zip(self._batches, self._images, strict=True):
            image = self._display(render_image(drawn, batch, SAMPLES))
            error = np.mean((image - expected) ** 2, axis=-1)
            mean += float(error.mean()) / len(self._batches)
            # a pixel's neighbours answer for it, too: beside an outline the reference shows nothing
            # to blame
            spread = maximum_filter(error, size=(1, 3, 3))
            self._collect(total, batch, mi.Float(spread.ravel()))
        return mean, np.array(total).astype(np.float64) / FIXED_POINT

    def _collect(self, total: mi.UInt64, batch: Batch, error: mi.Float) -> None:
        hits, _ = rays.trace_grid(self.triangles.scene, batch)
        seen = hits.triangle != MISS
        value = mi.UInt64(dr.gather(mi.Float, error, batch.grid.index) * FIXED_POINT)
        dr.scatter_reduce(dr.ReduceOp.Add, total, value, dr.select(seen, hits.triangle, 0), seen)
        dr.eval(total)

    def _display(self, image: mi.Float) -> NDArray[np.float32]:
        return display(np.array(image).reshape(BATCH, RESOLUTION, RESOLUTION, 4))


def weights(
    positions: NDArray, faces: NDArray, error: NDArray, visible: NDArray
) -> NDArray[np.float64]:
    """(F,) factors for the importance of faces from the image error collected on each: error per
    area, averaged over ``RINGS`` rings, relative to the median of the visible faces."""
    f, area, vertices = welded_areas(positions, faces)
    for _ in range(RINGS):
        error, area = (around(x, f, vertices)[f].mean(axis=1) / 6 for x in (error, area))
    density = error / np.maximum(area, 1e-30)
    middle = np.median(density[visible]) if visible.any() else 0.0
    if middle <= 0:
        return np.ones(len(faces))
    return np.clip((density / middle) ** POWER, LOWEST, HIGHEST)
