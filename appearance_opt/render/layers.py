"""Images of surfaces that are seen through others: the layers along each ray, blended from the eye
on.

Every material keeps back a share of what lies behind it, its coverage: that of cut-outs is 0 or 1.
A ray that is not kept back altogether goes on behind what it met. Colours are blended with the
"over" operator (Porter and Duff 1984), in linear radiance, so that coverage in the image becomes
fractional. Without gradients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render import deferred, rays
from appearance_opt.render.freezing import traced
from appearance_opt.render.material import TexelLayer
from appearance_opt.render.passing import MISS, meet
from appearance_opt.render.pixels import Grid, pixel_index
from appearance_opt.render.surface import interpolate

if TYPE_CHECKING:
    from appearance_opt.render.deferred import Drawing
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.material import MaterialMaps
    from appearance_opt.render.passing import Scene
    from appearance_opt.render.rays import Samples
    from appearance_opt.render.surface import Hit, Surface

MOST = 128
"""Layers that a ray is followed through, empty parts of cut-outs included. What lies behind is not
drawn: the light that is left counts as background."""

LEAST = 1 / 1024
"""Share of a ray that is not worth following: a quarter of an 8-bit step."""

CHANNELS = ("coverage", "cutoff")
"""Channels of the maps of coverage. Where there is a cutoff (not negative), coverage is tested
against it."""


@dataclass(frozen=True)
class Coverage:
    """What each material of a surface keeps back: ``layer`` with the ``CHANNELS``."""

    layer: TexelLayer

    def at(self, hit: Hit) -> mi.Float:
        """Share in [0, 1] at each hit."""
        share, cutoff = self.layer.at(hit)[:2]
        if hit.alpha is not None:
            share *= hit.alpha
        return dr.select(cutoff < 0, share, dr.select(share >= cutoff, mi.Float(1), mi.Float(0)))


def render_image(
    scene: Scene,
    surface: Surface,
    maps: MaterialMaps,
    coverage: Coverage,
    records: mi.Float,
    grid: Grid,
    samples: int,
    width: float | None = None,
    run: Run = traced,
) -> mi.Float:
    """``deferred.render_image`` of a surface that is seen through. Memory grows neither with
    ``samples`` nor with the layers; rays whose light is used up take no part in further layers."""
    drawing = deferred.Drawing(surface, maps, records, grid.size, grid.rows)
    width = deferred.filter_width(samples) if width is None else width
    weight, filtered = dr.opaque(mi.Float, 1 / samples), dr.opaque(mi.Float, width)
    image = dr.zeros(mi.Float, grid.pixels * 4)
    for dx, dy in rays.sub_pixel_offsets(samples):
        hits, depth, hit = deferred.visible(scene, surface, records, grid, dx, dy, run)
        light = dr.ones(mi.Float, dr.width(depth))
        dr.eval(light)
        for _ in range(MOST):
            going = dr.compress(hit & (light >= LEAST))
            if dr.width(going) == 0:
                break
            hits, depth, light = _taken(going, hits, depth, light)
            share = run(_kept_back, drawing, coverage, hits, light, filtered)
            dr.eval(share)
            image = _blend(image, drawing, hits, share, weight, filtered, run)
            light = light - share
            left = dr.compress(light >= LEAST)
            if dr.width(left) == 0:
                break
            hits, depth, light = _taken(left, hits, depth, light)
            hits, depth = run(_behind, scene, records, hits, depth, grid.size)
            hit = hits.triangle != MISS
            dr.eval(hits, depth, hit)
    return image


def _taken(
    index: mi.UInt32, hits: Samples, depth: mi.Float, light: mi.Float
) -> tuple[Samples, mi.Float, mi.Float]:
    """Those at the positions ``index`` of the lists."""
    out = (
        rays.keep(hits, index),
        dr.gather(mi.Float, depth, index),
        dr.gather(mi.Float, light, index),
    )
    dr.eval(out)
    return out


def _kept_back(
    drawing: Drawing, coverage: Coverage, hits: Samples, light: mi.Float, width: mi.Float
) -> mi.Float:
    """What hits keep back of the ``light`` of their rays."""
    camera = rays.camera_of(drawing.records, hits.view)
    return coverage.at(interpolate(drawing.surface, camera, hits, drawing.size, width)) * light


def _blend(
    image: mi.Float,
    drawing: Drawing,
    hits: Samples,
    share: mi.Float,
    weight: mi.Float,
    width: mi.Float,
    run: Run,
) -> mi.Float:
    """The image with a layer of hits, one at most per pixel: only those are shaded that keep
    anything back."""
    index = dr.compress(share > 0)
    if dr.width(index) == 0:
        return image
    image = run(_accumulate, image, drawing, hits, index, share, weight, width)
    dr.eval(image)
    return image


def _accumulate(
    image: mi.Float,
    drawing: Drawing,
    hits: Samples,
    index: mi.UInt32,
    share: mi.Float,
    weight: mi.Float,
    width: mi.Float,
) -> mi.Float:
    some = rays.keep(hits, index)
    color = deferred.shade(
        drawing.surface, drawing.maps, drawing.records, some, drawing.size, width
    )
    part = dr.gather(mi.Float, share, index) * weight
    out = mi.Float(image)
    value = mi.ArrayXf([color.x * part, color.y * part, color.z * part, part])
    pixel = pixel_index(some, drawing.rows)
    dr.scatter_reduce(dr.ReduceOp.Add, out, value, pixel, mode=dr.ReduceMode.NoConflicts)
    return out


def _behind(
    scene: Scene, records: mi.Float, hits: Samples, depth: mi.Float, size: mi.Float
) -> tuple[Samples, mi.Float]:
    """(what the rays of hits meet next, its depth)."""
    camera = rays.camera_of(records, hits.view)
    d = rays.direction(camera, hits.x, hits.y, size)
    length = dr.norm(d)
    met = meet(scene, mi.Ray3f(camera.eye, d / length), after=depth * length, coherent=True)
    return rays.Samples(hits.view, hits.x, hits.y, met.triangle), met.t / length
