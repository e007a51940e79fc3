"""How much of each face do outside observers see?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.asset.normals import weld
from appearance_opt.initial.stacks import coincident
from appearance_opt.render import rays
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, Grid

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.render.passing import Scene
    from appearance_opt.views import Sampler

MARGIN = 2
"""Rings of faces around the visible ones that count as visible, too: a face smaller than a pixel
can be missed by every ray."""

HIDDEN, FLOOR = 1e-4, 0.05
"""Importance of faces that nobody sees, and the least importance of those that somebody does."""


def pixel_counts(
    scene: Scene,
    faces: int,
    sampler: Sampler,
    views: int,
    resolution: int = 256,
    batch: int = 8,
) -> NDArray[np.int64]:
    """(faces,) number of pixels in which each face was seen over ``views`` random views."""
    total = dr.zeros(mi.UInt32, faces)
    grid = Grid(batch, resolution)
    for k in range(-(-views // batch)):
        hits, _ = rays.trace_grid(scene, Batch(sampler.draw(k, batch).records(), grid))
        seen = hits.triangle != MISS
        dr.scatter_reduce(
            dr.ReduceOp.Add, total, mi.UInt32(1), dr.select(seen, hits.triangle, 0), seen
        )
        dr.eval(total)
    return np.array(total).astype(np.int64)


def importance(
    positions: NDArray, faces: NDArray, counts: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(importance (F,) in (0, 1], visible (F,)) from the pixels in which faces were seen.

    Importance is pixels per area, averaged over the faces around each vertex and relative to the
    best seen part of the surface, so that recesses and undersides get a smaller share of the
    triangles.
    """
    f, area, n = welded_areas(positions, faces)
    visible = counts > 0
    for _ in range(MARGIN):
        near = np.zeros(n, bool)
        near[f[visible].ravel()] = True
        visible = near[f].any(axis=1)
    density = around(counts.astype(np.float64), f, n) / np.maximum(around(area, f, n), 1e-30)
    density = density[f].mean(axis=1)
    best = np.quantile(density[visible], 0.9) if visible.any() else 1.0
    return np.where(visible, np.clip(density / max(best, 1e-30), FLOOR, 1.0), HIDDEN), visible


def welded_areas(positions: NDArray, faces: NDArray) -> tuple[NDArray, NDArray[np.float64], int]:
    """(faces over welded vertices (F, 3), their areas (F,), number of welded vertices). Faces that
    coincide share the area of their place, as they share the pixels that show it."""
    first, place = weld(np.asarray(positions))
    f = place[faces]
    p = np.asarray(positions, np.float64)[first]
    area = 0.5 * np.linalg.norm(np.cross(p[f[:, 1]] - p[f[:, 0]], p[f[:, 2]] - p[f[:, 0]]), axis=1)
    copies, of_place = coincident(f)
    if len(copies):
        area[copies] /= np.bincount(of_place)[of_place]
    return f, area, len(p)


def around(values: NDArray, faces: NDArray, count: int) -> NDArray:
    """Sum over the faces around each vertex."""
    return sum((np.bincount(faces[:, k], values, count) for k in range(3)), np.zeros(count))
