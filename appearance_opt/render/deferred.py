"""The deferred renderer: visibility -> samples -> attributes -> material -> light -> pixels.

Every stage is a pure function of device arrays. ``shade`` is differentiable in the surface's
buffers and the texels; visibility is not (see ``silhouette`` for its derivative). The scene, in
which rays are traced, and the surface, which is drawn and shaded, are the same mesh at the same
place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render import brdf, material, outlines, raster, rays
from appearance_opt.render.freezing import traced
from appearance_opt.render.material import MaterialMaps
from appearance_opt.render.math import at_least
from appearance_opt.render.pixels import Grid, pixel_index
from appearance_opt.render.rays import Samples
from appearance_opt.render.surface import Surface, interpolate

if TYPE_CHECKING:
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.passing import Scene

NEAREST_LIGHT = 1e-3
"""Distance below which a light gets no brighter (the object's radius is 1 in a fit): a point light
that touches a surface is infinitely bright there."""


def shade(
    surface: Surface,
    maps: MaterialMaps,
    records: mi.Float,
    samples: Samples,
    resolution: mi.Float,
    width: mi.Float,
) -> mi.Color3f:
    """Radiance towards the camera at each sample (all must be hits). Linear RGB. ``width``: width
    of a sample in pixels, which selects the mip level."""
    camera = rays.camera_of(records, samples.view)
    hit = interpolate(surface, camera, samples, resolution, width)
    sample = material.evaluate(maps, hit)
    if sample.unlit is True:
        return sample.base_color
    normal = material.shading_normal(hit, sample)
    to_light = camera.light - hit.position
    squared_distance = at_least(dr.squared_norm(to_light), NEAREST_LIGHT**2)
    to_light *= dr.rsqrt(squared_distance)
    irradiance = camera.intensity / squared_distance
    lit = brdf.reflect(sample, normal, hit.to_viewer, to_light) * irradiance
    return lit if sample.unlit is False else dr.select(sample.unlit, sample.base_color, lit)


@dataclass(frozen=True)
class Drawing:
    """What is drawn, and from where. ``records``: see ``Views.records``; ``size``, ``rows``: see
    ``Grid``."""

    surface: Surface
    maps: MaterialMaps
    records: mi.Float
    size: mi.Float
    rows: mi.UInt32


def render_image(
    scene: Scene,
    surface: Surface,
    maps: MaterialMaps,
    records: mi.Float,
    grid: Grid,
    samples: int,
    width: float | None = None,
    run: Run = traced,
) -> mi.Float:
    """A whole batch of images with ``samples`` samples in every pixel, without gradients. Textures
    are filtered over ``width`` pixels; by default over the whole pixel where it has one sample, and
    by the samples alone where it has several: mip levels of normal maps are flatter than what they
    stand for, and shine in other places. ``run``: how its stages are called (see ``freezing``).

    Returns (pixels * 4) premultiplied linear radiance and coverage. One sample of all pixels at a
    time, so that memory does not grow with ``samples``.
    """
    drawing = Drawing(surface, maps, records, grid.size, grid.rows)
    width = filter_width(samples) if width is None else width
    image = dr.zeros(mi.Float, grid.pixels * 4)
    for dx, dy in rays.sub_pixel_offsets(samples):
        hits, _, covered = _seen(scene, drawing, grid, dx, dy, run)
        # one sample per pixel in each pass: no two threads meet
        mode = dr.ReduceMode.NoConflicts
        image = _add_shaded(image, drawing, hits, covered, 1 / samples, width, mode, run)
    return image


def filter_width(samples: int) -> float:
    """Width in pixels over which textures are filtered where nothing else is asked for; see
    ``render_image``."""
    return 1.0 if samples == 1 else 0.0


def render_pair(
    scene: Scene,
    surface: Surface,
    maps: MaterialMaps,
    records: mi.Float,
    grid: Grid,
    samples: int,
    width: float,
    run: Run = traced,
) -> tuple[mi.Float, mi.Float]:
    """(average, points): two images of the same views. ``points`` is what the ray through the
    middle of each pixel sees, textures filtered over ``width`` pixels; ``average`` is the same away
    from outlines, and the mean of ``samples`` rays at them. Costs a fraction of ``samples`` full
    images. ``run``: as in ``render_image``."""
    drawing = Drawing(surface, maps, records, grid.size, grid.rows)
    hits, depth, covered = _seen(scene, drawing, grid, 0.5, 0.5, run)
    points, mode = dr.zeros(mi.Float, grid.pixels * 4), dr.ReduceMode.NoConflicts
    points = _add_shaded(points, drawing, hits, covered, 1.0, width, mode, run)
    average, outlined = run(_without_outlines, points, hits, depth, grid.rows, grid.pixels)
    dr.eval(average, outlined)
    index = dr.compress(outlined)
    if dr.width(index):
        at = grid.view, grid.column, grid.row, index
        fine, hit = rays.trace_pixels(scene, records, *at, samples, grid.size, run)
        mode = dr.ReduceMode.Local
        average = _add_shaded(
            average, drawing, fine, dr.compress(hit), 1 / samples, samples**-0.5, mode, run
        )
    return average, points


def _seen(
    scene: Scene, drawing: Drawing, grid: Grid, dx: float, dy: float, run: Run
) -> tuple[Samples, mi.Float, mi.UInt32]:
    """(what every pixel shows at the offset (dx, dy), its depth, indices of those that show
    anything)."""
    hits, depth, hit = visible(scene, drawing.surface, drawing.records, grid, dx, dy, run)
    return hits, depth, dr.compress(hit)


def visible(
    scene: Scene, surface: Surface, records: mi.Float, grid: Grid, dx: float, dy: float, run: Run
) -> tuple[Samples, mi.Float, mi.Bool]:
    """(what every pixel shows at the offset (dx, dy), its depth, does it show anything?). By rays
    through ``scene`` or by drawing ``surface``, the same mesh, whichever is faster."""
    at = (
        grid.view,
        grid.column,
        grid.row,
        dr.opaque(mi.Float, dx),
        dr.opaque(mi.Float, dy),
        grid.size,
    )
    if raster.drawing_is_faster(surface, grid):
        mesh = surface.vertices, surface.faces, records
        hits, depth = run(
            raster.visible, *mesh, *at, grid.rows, grid.views, grid.pixels, surface.culled
        )
    else:
        hits, depth = run(_traced_at, scene, records, *at)
    hit = hits.triangle != rays.MISS
    dr.eval(hits, depth, hit)
    return hits, depth, hit


def _traced_at(
    scene: Scene,
    records: mi.Float,
    view: mi.UInt32,
    column: mi.UInt32,
    row: mi.UInt32,
    dx: mi.Float,
    dy: mi.Float,
    size: mi.Float,
) -> tuple[Samples, mi.Float]:
    return rays.trace_depth(scene, records, view, mi.Float(column) + dx, mi.Float(row) + dy, size)


def _without_outlines(
    points: mi.Float, hits: Samples, depth: mi.Float, rows: mi.UInt32, pixels: int
) -> tuple[mi.Float, mi.Bool]:
    """(the image ``points`` with zeros in the pixels at outlines, whether the pixel of each of
    ``hits`` is one)."""
    pixel = pixel_index(hits, rows)
    far = dr.select(hits.triangle == rays.MISS, mi.Float(outlines.NOTHING), depth)
    outlined = outlines.find(far, pixel, rows, pixels)
    image = dr.select(
        dr.gather(mi.Bool, outlined, dr.arange(mi.UInt32, pixels * 4) // 4), 0, points
    )
    return image, dr.gather(mi.Bool, outlined, pixel)


def _add_shaded(
    image: mi.Float,
    drawing: Drawing,
    hits: Samples,
    index: mi.UInt32,
    weight: float,
    width: float,
    mode: dr.ReduceMode,
    run: Run,
) -> mi.Float:
    """An image (pixels * 4) and the radiance and coverage of the hits at the positions ``index`` of
    the list, each ``weight`` of its pixel."""
    if dr.width(index) == 0:
        return image
    out = run(
        _accumulate,
        image,
        drawing,
        hits,
        index,
        dr.opaque(mi.Float, weight),
        dr.opaque(mi.Float, width),
        mode,
    )
    dr.eval(out)
    return out


def _accumulate(
    image: mi.Float,
    drawing: Drawing,
    hits: Samples,
    index: mi.UInt32,
    weight: mi.Float,
    width: mi.Float,
    mode: dr.ReduceMode,
) -> mi.Float:
    some = rays.keep(hits, index)
    color = shade(drawing.surface, drawing.maps, drawing.records, some, drawing.size, width)
    value = mi.ArrayXf([color.x * weight, color.y * weight, color.z * weight, weight])
    out = mi.Float(image)
    dr.scatter_reduce(dr.ReduceOp.Add, out, value, pixel_index(some, drawing.rows), mode=mode)
    return out
