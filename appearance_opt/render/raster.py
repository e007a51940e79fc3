"""Primary visibility without rays: triangles are drawn onto the pixels.

Every triangle visits its pixels, row by row. Where it covers the sample, the bits of its depth and
its number go into the image as one number of 64 bits, of which the least stays: that of the nearest
triangle. Edge functions are homogeneous (Olano and Greer 1997, Triangle Scan Conversion using 2D
Homogeneous Coordinates), so that triangles that cross the plane of the camera need no clipping.
Needs no BVH, and less time than tracing rays on a CPU with fewer than ``MOST_PER_PIXEL`` triangles
to a pixel (docs/performance.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt import backend
from appearance_opt.render.camera import camera_of
from appearance_opt.render.passing import MISS
from appearance_opt.render.samples import Samples

if TYPE_CHECKING:
    from appearance_opt.render.pixels import Batch, Grid
    from appearance_opt.render.surface import Surface

MOST_PER_PIXEL = 4
"""Triangles per pixel from which rays are faster."""

LANES = 1 << 16
"""Triangles of small meshes are shared by several threads, which take turns in their rows, up to
this many in all."""

SLACK = 1e-6
"""Rounding of edge functions, in parts of the sum of their terms: no sample falls between two
triangles."""

NOTHING = 0xFFFFFFFFFFFFFFFF


def drawing_is_faster(surface: Surface, grid: Grid) -> bool:
    """Tell whether drawing the surface is faster than tracing rays. Not known of GPUs, which have
    hardware for rays."""
    triangles = dr.width(surface.faces) // 4
    return mi.variant() == backend.CPU and triangles <= MOST_PER_PIXEL * grid.resolution**2


def draw_grid(
    surface: Surface, batch: Batch, dx: mi.Float, dy: mi.Float
) -> tuple[Samples, mi.Float]:
    """Find what the surface shows at the offset (dx, dy) in every pixel, and its depth (see
    ``rays.trace_grid``). Of triangles at exactly the same depth the first is seen."""
    grid = batch.grid
    projected = _project(surface.vertices, batch)
    dr.eval(projected)
    image = _draw(projected, surface, grid, dx, dy)
    dr.eval(image)
    nearest = dr.gather(mi.UInt64, image, grid.index)
    triangle = mi.UInt32(nearest & 0xFFFFFFFF)
    depth = dr.reinterpret_array(mi.Float, mi.UInt32(nearest >> 32))
    samples = Samples(grid.view, mi.Float(grid.column) + dx, mi.Float(grid.row) + dy, triangle)
    return samples, dr.select(triangle != MISS, depth, dr.inf)


def _project(vertices: mi.Float, batch: Batch) -> mi.Float:
    """(views * V * 4) packets: position in pixels (x, y) times depth, depth, 0."""
    count, views = dr.width(vertices) // 8, batch.grid.views
    i = dr.arange(mi.UInt32, views * count)
    view = i // count
    p = dr.gather(mi.ArrayXf, vertices, i - view * count, shape=(8, views * count))
    camera = camera_of(batch.records, view)
    v = mi.Point3f(p[0], p[1], p[2]) - camera.eye
    depth = dr.dot(v, camera.forward)
    half = 0.5 * batch.grid.size
    scale = half / dr.squared_norm(camera.right)
    x = dr.fma(dr.dot(v, camera.right), scale, half * depth)
    y = dr.fma(dr.dot(v, camera.down), scale, half * depth)
    out = dr.empty(mi.Float, views * count * 4)
    dr.scatter(out, mi.ArrayXf([x, y, depth, mi.Float(0)]), i, mode=dr.ReduceMode.Permute)
    return out


def _draw(
    projected: mi.Float, surface: Surface, grid: Grid, dx: mi.Float, dy: mi.Float
) -> mi.UInt64:
    """(pixels,) the bits of the nearest depth, above the number of the triangle there; ``NOTHING``
    where none is."""
    faces, views, rows = surface.faces, grid.views, grid.rows
    triangles, stride = dr.width(faces) // 4, dr.width(projected) // 4 // views
    shares = max(1, min(16, LANES // max(views * triangles, 1)))
    count = views * triangles * shares
    i = dr.arange(mi.UInt32, count)
    share, drawn = i % shares, i // shares
    view = drawn // triangles
    triangle = drawn - view * triangles
    face = dr.gather(mi.ArrayXu, faces, triangle, shape=(4, count))
    p = [
        dr.gather(mi.ArrayXf, projected, view * stride + face[k], shape=(4, count))
        for k in range(3)
    ]
    (x0, x1), (y0, y1), somewhere = _bounds(p, dx, dy, mi.Float(rows) - 1)
    # seen from the first pixel: numbers are small there, and keep their digits
    v = [mi.Vector3f(q[0] - (x0 + dx) * q[2], q[1] - (y0 + dy) * q[2], q[2]) for q in p]
    edges = [dr.cross(v[1], v[2]), dr.cross(v[2], v[0]), dr.cross(v[0], v[1])]
    volume = dr.dot(v[0], edges[0])
    if surface.culled is not None:
        # to the right, down and forward are axes like x, y and z: the volume of a front is negative
        somewhere &= (volume < 0) | ~dr.gather(mi.Bool, surface.culled, triangle)
    edges = [dr.select(volume < 0, -e, e) for e in edges]
    wide, high = x1 - x0, y1 - y0
    slack = [
        -SLACK * (dr.abs(e.x) * (wide + 1) + dr.abs(e.y) * (high + 1) + dr.abs(e.z)) for e in edges
    ]
    whole, volume = edges[0] + edges[1] + edges[2], dr.abs(volume)
    image = dr.full(mi.UInt64, NOTHING, grid.pixels)

    steep = [dr.select(e.x == 0, mi.Float(0), -1 / e.x) for e in edges]

    def span(y: mi.Float) -> tuple[mi.Float, mi.Float]:
        """First and last column of a row between the edges, give or take a hundredth of a pixel."""
        left, right = mi.Float(0), mi.Float(wide)
        for e, least, factor in zip(edges, slack, steep, strict=True):
            x = (dr.fma(e.y, y, e.z) - least) * factor
            left = dr.select(e.x > 0, dr.fmax(left, x), left)
            right = dr.select(e.x < 0, dr.fmin(right, x), right)
        return dr.ceil(left - 0.01), dr.floor(right + 0.01)

    def visit(x: mi.Float, y: mi.Float, end: mi.Float, drawing: mi.Bool) -> tuple:
        inverse = dr.fma(whole.x, x, dr.fma(whole.y, y, whole.z))
        covered = drawing & (x <= end) & (inverse > 0)
        for e, least in zip(edges, slack, strict=True):
            covered &= dr.fma(e.x, x, dr.fma(e.y, y, e.z)) >= least
        key = (mi.UInt64(dr.reinterpret_array(mi.UInt32, volume / inverse)) << 32) | mi.UInt64(
            triangle
        )
        pixel = (view * rows + mi.UInt32(y0 + y)) * rows + mi.UInt32(x0 + x)
        dr.scatter_reduce(dr.ReduceOp.Min, image, key, pixel, covered)
        after = x + 1 > end
        y = dr.select(after, y + shares, y)
        start, stop = span(y)
        return dr.select(after, start, x + 1), y, dr.select(after, stop, end), drawing & (y <= high)

    first = mi.Float(share)
    drawing = somewhere & (volume > 0) & (first <= high)
    start, stop = span(first)
    dr.while_loop((start, first, stop, drawing), lambda x, y, end, drawing: drawing, visit)
    return image


def _bounds(
    p: list[mi.ArrayXf], dx: mi.Float, dy: mi.Float, last: mi.Float
) -> tuple[tuple[mi.Float, mi.Float], tuple[mi.Float, mi.Float], mi.Bool]:
    """((first, last column), (first, last row), is there any?) of the pixels up to number ``last``
    that triangles may cover: all if a vertex is behind the camera, none if all are. ``p``: packets
    of ``_project``."""
    behind = [q[2] <= 0 for q in p]
    crossing = behind[0] | behind[1] | behind[2]

    def span(values: list[mi.Float], offset: mi.Float) -> tuple[mi.Float, mi.Float]:
        # a thousandth of a pixel more than is needed: positions are rounded
        low = dr.fmin(dr.fmin(values[0], values[1]), values[2]) - 1e-3
        high = dr.fmax(dr.fmax(values[0], values[1]), values[2]) + 1e-3
        low, high = dr.select(crossing, 0, low - offset), dr.select(crossing, last, high - offset)
        return dr.fmax(dr.ceil(low), 0), dr.fmin(dr.floor(high), last)

    columns, rows = (span([q[k] / q[2] for q in p], offset) for k, offset in ((0, dx), (1, dy)))
    some = (columns[0] <= columns[1]) & (rows[0] <= rows[1]) & ~(behind[0] & behind[1] & behind[2])
    return columns, rows, some
