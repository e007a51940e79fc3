"""The deferred renderer: visibility -> samples -> attributes -> material -> light -> pixels.

Every stage is a pure function of device arrays. ``shade`` and ``resolve`` are differentiable in the
surface's buffers and the texels; visibility is not (see ``silhouette`` for its derivative).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from appearance_opt.render import brdf, material, rays
from appearance_opt.render.material import MaterialMaps
from appearance_opt.render.math import at_least
from appearance_opt.render.rays import Samples
from appearance_opt.render.surface import Surface, interpolate

NEAREST_LIGHT = 1e-3
"""Distance below which a light gets no brighter (the object's radius is 1 in a fit): a point light that touches a
surface is infinitely bright there."""


class Grid:
    """The pixels of a batch of square images, on the device, tile by tile (see ``rays.TILE``).

    ``size``, ``rows``: the resolution as opaque numbers, so that another one compiles no new kernel.
    ``view``, ``column``, ``row``: of every pixel. Made once and reused by every step.
    """

    def __init__(self, views: int, resolution: int) -> None:
        self.views = views
        self.resolution = resolution
        self.size = dr.opaque(mi.Float, resolution)
        self.rows = dr.opaque(mi.UInt32, resolution)
        self.view, self.column, self.row = rays.pixel_grid(views, resolution)
        dr.eval(self.view, self.column, self.row)
        self._finer: dict[int, Grid] = {}

    def finer(self, factor: int) -> Grid:
        """``factor`` squared points in every pixel, as a grid of their own; made when first asked for."""
        if factor == 1:
            return self
        if factor not in self._finer:
            self._finer[factor] = Grid(self.views, self.resolution * factor)
        return self._finer[factor]

    @property
    def pixels(self) -> int:
        """Pixels of the whole batch."""
        return self.views * self.resolution * self.resolution


def shade(
    surface: Surface, maps: MaterialMaps, records: mi.Float, samples: Samples, resolution: mi.Float, width: mi.Float
) -> mi.Color3f:
    """Radiance towards the camera at each sample (all must be hits). Linear RGB. ``width``: width of a
    sample in pixels, which selects the mip level."""
    camera = rays.camera_of(records, samples.view)
    hit = interpolate(surface, camera, samples, resolution, width)
    sample = material.evaluate(maps, hit)
    normal = material.shading_normal(hit, sample)
    to_light = camera.light - hit.position
    squared_distance = at_least(dr.squared_norm(to_light), NEAREST_LIGHT**2)
    to_light *= dr.rsqrt(squared_distance)
    irradiance = camera.intensity / squared_distance
    return brdf.reflect(sample, normal, hit.to_viewer, to_light) * irradiance


def pixel_index(samples: Samples, resolution: mi.UInt32) -> mi.UInt32:
    """Index of the pixel of each sample in the batch: (view, row, column), row major."""
    column, row = mi.UInt32(samples.x), mi.UInt32(samples.y)
    return (samples.view * resolution + row) * resolution + column


def render_image(
    scene: mi.Scene,
    surface: Surface,
    maps: MaterialMaps,
    records: mi.Float,
    grid: Grid,
    samples: int,
    width: float | None = None,
) -> mi.Float:
    """A whole batch of images with ``samples`` samples in every pixel, without gradients. Textures are filtered
    over ``width`` pixels (the share of a sample).

    Returns (pixels * 4) premultiplied linear radiance and coverage. One sample of all pixels at a time,
    so that memory does not grow with ``samples``.
    """
    filtered = samples**-0.5 if width is None else width
    image = dr.zeros(mi.Float, grid.pixels * 4)
    for dx, dy in rays.sub_pixel_offsets(samples):
        x = mi.Float(grid.column) + dr.opaque(mi.Float, dx)
        y = mi.Float(grid.row) + dr.opaque(mi.Float, dy)
        hits = rays.trace(scene, records, grid.view, x, y, grid.size)
        dr.eval(hits)
        covered = rays.keep(hits, dr.compress(hits.triangle != rays.MISS))
        # one sample per pixel in each pass: no two threads meet
        _add_shaded(image, surface, maps, records, grid, covered, samples, filtered, dr.ReduceMode.NoConflicts)
    return image


DISCONTINUITY = 1.02
"""Ratio of depths between neighbouring pixels from which an outline may pass between them."""

OUTLINE_REACH = 2
"""Pixels around an outline that are sampled finely: where a fitted shape's outline may lie meanwhile."""


def render_pair(
    scene: mi.Scene,
    surface: Surface,
    maps: MaterialMaps,
    records: mi.Float,
    grid: Grid,
    samples: int,
    width: float,
) -> tuple[mi.Float, mi.Float]:
    """(average, points): two images of the same views. ``points`` is what the ray through the middle of each pixel
    sees, textures filtered over ``width`` pixels; ``average`` is the same away from outlines, and the mean of
    ``samples`` rays near them. Costs a fraction of ``samples`` full images."""
    hits, depth = rays.trace_depth(
        scene, records, grid.view, mi.Float(grid.column) + 0.5, mi.Float(grid.row) + 0.5, grid.size
    )
    dr.eval(hits, depth)
    points = dr.zeros(mi.Float, grid.pixels * 4)
    covered = rays.keep(hits, dr.compress(hits.triangle != rays.MISS))
    _add_shaded(points, surface, maps, records, grid, covered, 1, width, dr.ReduceMode.NoConflicts)
    near_outline = _near_outlines(hits, depth, grid)
    average = dr.select(dr.gather(mi.Bool, near_outline, dr.arange(mi.UInt32, grid.pixels * 4) // 4), 0, points)
    dr.eval(average)
    pixel = (grid.view * grid.rows + grid.row) * grid.rows + grid.column
    index = dr.compress(dr.gather(mi.Bool, near_outline, pixel))
    if dr.width(index):
        fine = rays.trace_pixels(scene, records, grid.view, grid.column, grid.row, index, samples, grid.size)
        _add_shaded(average, surface, maps, records, grid, fine, samples, samples**-0.5, dr.ReduceMode.Local)
    return average, points


def _near_outlines(hits: Samples, depth: mi.Float, grid: Grid) -> mi.Bool:
    """(pixels,) pixels with a jump in depth, or a border of the object, within ``OUTLINE_REACH``: where the largest
    depth of a square of pixels exceeds the smallest, each found along rows first, then along columns."""
    far = dr.select(hits.triangle == rays.MISS, mi.Float(1e30), depth)
    image = dr.zeros(mi.Float, grid.pixels)
    dr.scatter(image, far, pixel_index(hits, grid.rows), mode=dr.ReduceMode.Permute)
    i = dr.arange(mi.UInt32, grid.pixels)
    line = i // grid.rows
    column, row = i - line * grid.rows, line % grid.rows
    nearest = farthest = image
    for place, stride in ((column, mi.UInt32(1)), (row, grid.rows)):
        dr.eval(nearest, farthest)
        least, most = nearest, farthest
        for away in range(1, OUTLINE_REACH + 1):
            after, before = (place + away < grid.rows, i + away * stride), (place >= away, i - away * stride)
            for inside, neighbour in (after, before):
                at = dr.select(inside, neighbour, i)
                least = dr.fmin(least, dr.gather(mi.Float, nearest, at))
                most = dr.fmax(most, dr.gather(mi.Float, farthest, at))
        nearest, farthest = least, most
    near_outline = farthest > DISCONTINUITY * nearest
    dr.eval(near_outline)
    return near_outline


def _add_shaded(
    image: mi.Float,
    surface: Surface,
    maps: MaterialMaps,
    records: mi.Float,
    grid: Grid,
    hits: Samples,
    samples: int,
    width: float,
    mode: dr.ReduceMode,
) -> None:
    """Add the radiance and coverage of hits, each 1 / ``samples`` of its pixel, to an image (pixels * 4)."""
    if dr.width(hits.triangle) == 0:
        return
    color = shade(surface, maps, records, hits, grid.size, dr.opaque(mi.Float, width))
    w = dr.opaque(mi.Float, 1 / samples)
    value = mi.ArrayXf([color.x * w, color.y * w, color.z * w, w])
    dr.scatter_reduce(dr.ReduceOp.Add, image, value, pixel_index(hits, grid.rows), mode=mode)
    dr.eval(image)
