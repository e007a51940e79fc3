"""Primary visibility by rays: which triangle does each camera ray hit? Not differentiated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render import lattice
from appearance_opt.render.camera import camera_of, direction
from appearance_opt.render.freezing import traced
from appearance_opt.render.passing import MISS, meet
from appearance_opt.render.samples import Samples

if TYPE_CHECKING:
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.passing import Scene
    from appearance_opt.render.pixels import Batch


def trace(scene: Scene, batch: Batch, view: mi.UInt32, x: mi.Float, y: mi.Float) -> Samples:
    """Find what camera rays through pixel positions (x, y) of the given views see."""
    return trace_depth(scene, batch, view, x, y)[0]


def trace_depth(
    scene: Scene, batch: Batch, view: mi.UInt32, x: mi.Float, y: mi.Float
) -> tuple[Samples, mi.Float]:
    """Find the same, and the depth of the hits along ``forward`` (infinite for a miss)."""
    camera = camera_of(batch.records, view)
    d = direction(camera, x, y, batch.grid.size)
    inverse_length = dr.rsqrt(dr.squared_norm(d))
    met = meet(scene, mi.Ray3f(camera.eye, d * inverse_length), coherent=True)
    return Samples(view, x, y, met.triangle), met.t * inverse_length


def trace_grid(
    scene: Scene, batch: Batch, dx: mi.Float | float = 0.5, dy: mi.Float | float = 0.5
) -> tuple[Samples, mi.Float]:
    """Find the same of one ray in every pixel, at the offset (dx, dy): by default through its
    middle."""
    grid = batch.grid
    return trace_depth(scene, batch, grid.view, mi.Float(grid.column) + dx, mi.Float(grid.row) + dy)


def trace_pixels(
    scene: Scene, batch: Batch, index: mi.UInt32, count: int, run: Run = traced
) -> tuple[Samples, mi.Bool]:
    """Trace ``count`` rays in each of the pixels at the positions ``index`` of the grid, those of a
    pixel one after the other, and whether each hits."""
    if dr.width(index) == 0:
        return Samples(mi.UInt32(), mi.Float(), mi.Float(), mi.UInt32()), mi.Bool()
    ray = dr.arange(mi.UInt32, dr.width(index) * count)
    dr.eval(ray)  # its length varies: it is no part of what is recorded
    fine, covered = run(_in_pixels, scene, batch, index, ray, count)
    dr.eval(fine, covered)  # or the mask and the triangles would each trace them
    return fine, covered


def _in_pixels(
    scene: Scene, batch: Batch, index: mi.UInt32, ray: mi.UInt32, count: int
) -> tuple[Samples, mi.Bool]:
    """What each ray hits, and whether it hits: ``ray`` counts through ``count`` rays in every
    pixel."""
    view, x, y = positions_in_pixels(batch, index, ray, count)
    hits = trace(scene, batch, view, x, y)
    return hits, hits.triangle != MISS


def positions_in_pixels(
    batch: Batch, index: mi.UInt32, ray: mi.UInt32, count: int
) -> tuple[mi.UInt32, mi.Float, mi.Float]:
    """(view, x, y) of rays: ``ray`` counts through ``count`` of them in every pixel at the
    positions ``index`` of the grid."""
    k = ray // count
    at = dr.gather(mi.UInt32, index, k)
    odd = 2 * (ray - k * count) + 1  # as in ``sub_pixel_offsets``
    scale = 1 / (2 * count)
    x = mi.Float(dr.gather(mi.UInt32, batch.grid.column, at)) + mi.Float(odd) * scale
    y = (
        mi.Float(dr.gather(mi.UInt32, batch.grid.row, at))
        + mi.Float(odd * lattice.generator(count) % (2 * count)) * scale
    )
    return dr.gather(mi.UInt32, batch.grid.view, at), x, y
