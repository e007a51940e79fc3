"""The deferred renderer: visibility -> samples -> attributes -> material -> light -> pixels.

Every stage is a pure function of device arrays. ``shade`` and ``resolve`` are differentiable in the
surface's buffers and the texels; visibility is not (see ``silhouette`` for its derivative).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from appearance_opt.render import brdf, material, rays
from appearance_opt.render.material import MaterialMaps
from appearance_opt.render.rays import Samples
from appearance_opt.render.surface import Surface, interpolate


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
    squared_distance = dr.squared_norm(to_light)
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
    filtered = dr.opaque(mi.Float, samples**-0.5 if width is None else width)
    image = dr.zeros(mi.Float, grid.pixels * 4)
    weight = dr.opaque(mi.Float, 1 / samples)
    for dx, dy in rays.sub_pixel_offsets(samples):
        x = mi.Float(grid.column) + dr.opaque(mi.Float, dx)
        y = mi.Float(grid.row) + dr.opaque(mi.Float, dy)
        hits = rays.trace(scene, records, grid.view, x, y, grid.size)
        dr.eval(hits)
        index = dr.compress(hits.triangle != rays.MISS)
        if dr.width(index) == 0:
            continue
        hits = rays.keep(hits, index)
        color = shade(surface, maps, records, hits, grid.size, filtered)
        value = mi.ArrayXf([color.x * weight, color.y * weight, color.z * weight, weight])
        # one sample per pixel in each pass: no two threads meet
        dr.scatter_reduce(dr.ReduceOp.Add, image, value, pixel_index(hits, grid.rows), mode=dr.ReduceMode.NoConflicts)
        dr.eval(image)
    return image
