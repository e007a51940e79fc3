"""One differentiable batch of images: forward now, gradients when the caller knows dLoss/dImage.

Between the two stands the loss, which is a function of whole pixels. So the backward pass shades
the same samples again, with gradients, and pulls back

    sum over samples  weight * <dLoss/dI(pixel), colour>                      (interior)
  + sum over silhouette points  length * <dLoss/dI(pixel), c_in - c_out> n.x  (visibility),

everything but the surface's buffers held fixed. The image itself is never differentiated.

Most pixels hold no silhouette, and a few samples: their colour is the mean of these. When the loss
is a sum over pixels, ``render(..., defer=True)`` leaves them out, and ``direct`` shades them, takes
the loss and goes back in one kernel: half the work.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render import coverage, intersections, pairs, rays, silhouette
from appearance_opt.render.freezing import traced
from appearance_opt.render.intersections import Intersections
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, Grid, pixel_index
from appearance_opt.render.quality import Quality
from appearance_opt.render.samples import Samples, Weighted, Whole, concat, join_arrays
from appearance_opt.render.shading import shade
from appearance_opt.render.silhouette import EdgeSamples
from appearance_opt.render.visibility import see_grid

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.render.drawn import Drawn, Shown
    from appearance_opt.render.freezing import Run


DEFERRED = 4
"""Samples per pixel up to which pixels are deferred: the kernel shades each of them in code of its
own."""


@dataclass
class RenderedBatch:
    """A rendered batch and what its backward pass needs.

    ``image``: (pixels * 4) premultiplied linear radiance and coverage, without the deferred pixels.
    ``averaged``: the covered camera rays that are averaged in it; ``deferred``: those that are not
    in the image yet, all of their pixels; None without any. ``crossed``: indices of the pixels that
    a silhouette crosses; ``edges``: its visible points, None without any; ``contrast``: c_in -
    c_out at them, premultiplied RGB and coverage. ``intersections``, ``intersections_contrast``:
    the same where surfaces run into each other, None unless pairs or ``Quality.intersections`` look
    for that.
    """

    batch: Batch
    image: mi.Float
    averaged: Weighted | None
    deferred: Whole | None
    crossed: mi.UInt32 | None
    edges: EdgeSamples | None
    contrast: mi.ArrayXf | None
    intersections: Intersections | None = None
    intersections_contrast: mi.ArrayXf | None = None

    def complete(self) -> mi.Bool | None:
        """(pixels,) which pixels of the image are not deferred; None if none is."""
        if self.deferred is None:
            return None
        out = dr.full(mi.Bool, True, self.batch.grid.pixels)
        dr.scatter(out, mi.Bool(False), self.deferred.pixel)
        return out


def render(
    drawn: Drawn,
    batch: Batch,
    quality: Quality,
    seed: int,
    run: Run = traced,
    defer: bool = False,
) -> RenderedBatch:
    """Forward pass, without gradients (``drawn`` is read detached). With ``defer``, pixels of few
    samples that no silhouette crosses are not shaded but left to ``direct``. ``run``: how its
    stages are called (see ``freezing``)."""
    with dr.suspend_grad():
        edges, met, filtered = None, None, quality.sample_width
        if quality.visibility == "pairs" and drawn.edges is not None:
            found = pairs.paired_samples(drawn, batch, quality, defer, run)
            averaged, deferred, crossed = found.averaged, found.deferred, found.crossed
            edges, met, filtered = (
                found.edges,
                found.intersections,
                quality.sample_width / isqrt(quality.samples),
            )
        else:
            if (
                quality.visibility == "edges"
                and drawn.edges is not None
                and quality.edge_density > 0
            ):
                edges = silhouette.sample_edges(drawn, batch, quality.edge_density, seed, run)
                if quality.intersections:
                    met = pairs.find_intersections(drawn, batch, isqrt(quality.samples), run)
            crossing = [b.pixel for b in (edges, met) if b is not None]
            averaged, deferred, crossed = _camera_samples(
                drawn, batch, crossing, quality, defer, run
            )
        width = dr.opaque(mi.Float, filtered)
        # pairs blend what few rays miss; elsewhere the silhouette's line knows it
        corrected = quality.edge_samples if quality.visibility == "edges" else None
        image, contrast, met_contrast = run(
            _averages, drawn.shown, batch, averaged, edges, met, width, corrected
        )
        dr.eval(image, contrast, met_contrast)
    return RenderedBatch(
        batch, image, averaged, deferred, crossed, edges, contrast, met, met_contrast
    )


def _averages(
    shown: Shown,
    batch: Batch,
    averaged: Weighted | None,
    edges: EdgeSamples | None,
    met: Intersections | None,
    width: mi.Float,
    corrected: int | None,
) -> tuple[mi.Float, mi.ArrayXf | None, mi.ArrayXf | None]:
    """(image without the deferred pixels, contrast at the silhouette points, and where surfaces
    meet). ``width`` of the texture filter of contrasts in pixels; ``corrected``: rays per pixel of
    which the image corrects the coverage."""
    image = dr.zeros(mi.Float, batch.grid.pixels * 4)
    if averaged is not None:
        w = averaged.weight
        c = shade(shown, batch, averaged.samples, averaged.width)
        value = mi.ArrayXf([c.x * w, c.y * w, c.z * w, w])
        dr.scatter_reduce(dr.ReduceOp.Add, image, value, averaged.pixel, mode=dr.ReduceMode.Local)
    contrast, met_contrast = (
        None if b is None else _contrast(shown, batch, b.inside, b.outside, width)
        for b in (edges, met)
    )
    if edges is not None and corrected is not None:
        dr.eval(image, contrast)
        missed = coverage.correction(edges, contrast, corrected, batch.grid)
        image = coverage.add_missed(image, missed)
    return image, contrast, met_contrast


def direct(
    rendered: RenderedBatch,
    shown: Shown,
    pixel_loss: Callable[[mi.Color3f, mi.UInt32], mi.Float],
) -> mi.Float | None:
    """Loss of each deferred pixel, differentiable: ``pixel_loss(radiance, pixel)`` of its radiance
    (all deferred pixels are fully covered). None without any."""
    if rendered.deferred is None:
        return None
    d = rendered.deferred
    colors = [shade(shown, rendered.batch, r, d.width) for r in d.rays]
    return pixel_loss(sum(colors[1:], colors[0]) * (1 / len(colors)), d.pixel)


def surrogate(rendered: RenderedBatch, shown: Shown, image_gradient: mi.Float) -> list[mi.Float]:
    """Arrays whose sums have the loss's derivative, for ``image_gradient`` = dLoss/dImage (pixels *
    4).

    Only their gradients mean anything: pass them to ``backward``. They are not summed here, as a
    sum would evaluate them and make the backward pass shade once more. Empty when the batch is.
    """
    terms, batch = [], rendered.batch
    if rendered.averaged is not None:
        a = rendered.averaged
        color = shade(shown, batch, a.samples, a.width)
        g = _pixel(image_gradient, a.pixel)
        terms.append(dr.fma(g[0], color.x, dr.fma(g[1], color.y, g[2] * color.z)) * a.weight)
    if shown.edges is None or not dr.grad_enabled(shown.surface.vertices):
        return terms
    if (points := rendered.edges) is not None:
        jump = _jump(image_gradient, points.pixel, rendered.contrast)
        terms.append(jump * points.length * silhouette.motion(shown, batch, points))
    if (met := rendered.intersections) is not None:
        jump = _jump(image_gradient, met.pixel, rendered.intersections_contrast)
        terms.append(jump * met.area * intersections.motion(shown, batch, met))
    return terms


def backward(terms: list[mi.Float]) -> None:
    """Propagate the gradient of the sum of all entries of all arrays, in one traversal."""
    moving = [t for t in terms if dr.grad_enabled(t)]
    for term in moving:
        dr.set_grad(term, 1.0)
        dr.enqueue(dr.ADMode.Backward, term)
    if moving:
        dr.traverse(dr.ADMode.Backward)


def _camera_samples(
    drawn: Drawn,
    batch: Batch,
    crossing: list[mi.UInt32],
    quality: Quality,
    defer: bool,
    run: Run,
) -> tuple[Weighted | None, Whole | None, mi.UInt32 | None]:
    """Covered camera rays, (averaged, deferred): ``samples`` in each pixel, ``edge_samples`` in
    those of ``crossing``, where a boundary passes; and these pixels, each once."""
    grid = batch.grid
    on_edge = dr.zeros(mi.Bool, grid.pixels)
    for pixels in crossing:
        dr.scatter(on_edge, mi.Bool(True), pixels)
    dr.eval(on_edge)
    pixel = grid.index
    on_edge = dr.gather(mi.Bool, on_edge, pixel)
    dr.eval(on_edge, pixel)

    def rays_in(places: mi.UInt32, count: int) -> tuple[Samples, mi.Bool]:
        return rays.trace_pixels(drawn.scene, batch, places, count, run)

    if quality.samples == 1:
        seen = see_grid(drawn, batch, 0.5, 0.5, run)
        fine, covered = seen.samples, seen.hit & ~on_edge
    else:
        fine, covered = rays_in(dr.compress(~on_edge), quality.samples)
    deferred, others = None, covered
    if defer and quality.samples <= DEFERRED:
        deferred, others = _whole_pixels(fine, covered, grid, quality)
    parts, weights, crossed = [], [], None
    if others is not None:
        parts, weights = [fine.keep(dr.compress(others))], [1 / quality.samples]
    if crossing:
        places = dr.compress(on_edge)
        crossed = dr.gather(mi.UInt32, pixel, places)
        fine, covered = rays_in(places, quality.edge_samples)
        parts.append(fine.keep(dr.compress(covered)))
        weights.append(1 / quality.edge_samples)
    return _merge_weighted(parts, weights, grid, quality.sample_width), deferred, crossed


def _whole_pixels(
    fine: Samples, covered: mi.Bool, grid: Grid, quality: Quality
) -> tuple[Whole | None, mi.Bool | None]:
    """(the pixels whose rays are all ``covered``, which other rays are: None of one per pixel).
    ``fine``: as from ``rays.trace_pixels``."""
    count, others = quality.samples, None
    if count == 1:
        first = dr.compress(covered)
    else:
        whole = dr.full(mi.Bool, True, dr.width(covered) // count)
        start = dr.arange(mi.UInt32, dr.width(whole)) * count
        for k in range(count):
            whole &= dr.gather(mi.Bool, covered, start + k)
        dr.eval(whole)
        first = dr.compress(whole) * count
        others = covered & ~dr.gather(
            mi.Bool, whole, dr.arange(mi.UInt32, dr.width(covered)) // count
        )
    if dr.width(first) == 0:
        return None, others
    every = [fine.keep(first + k) for k in range(count)]
    pixel = pixel_index(every[0], grid.rows)
    width = quality.point_width if count == 1 else quality.sample_width * count**-0.5
    dr.eval(every, pixel)
    return Whole(every, pixel, dr.opaque(mi.Float, width)), others


def _merge_weighted(
    parts: list[Samples], weights: list[float], grid: Grid, width_of_one: float
) -> Weighted | None:
    """Lists of samples as one; each list has its weight."""
    there = [(p, w) for p, w in zip(parts, weights, strict=True) if dr.width(p.triangle)]
    if not there:
        return None
    samples = concat([p for p, _ in there])
    weight = join_arrays([dr.full(mi.Float, w, dr.width(p.triangle)) for p, w in there])
    pixel = pixel_index(samples, grid.rows)
    dr.eval(samples, weight, pixel)
    return Weighted(samples, pixel, weight, dr.sqrt(weight) * dr.opaque(mi.Float, width_of_one))


def _contrast(
    shown: Shown, batch: Batch, inside: Samples, outside: Samples, width: mi.Float
) -> mi.ArrayXf:
    """c_in - c_out of samples on the two sides of boundaries: premultiplied RGB and coverage."""

    def seen(side: Samples) -> mi.ArrayXf:
        covered = side.triangle != MISS
        hits = Samples(side.view, side.x, side.y, dr.select(covered, side.triangle, 0))
        color = shade(shown, batch, hits, width) & covered
        return mi.ArrayXf([color.x, color.y, color.z, dr.select(covered, mi.Float(1), 0)])

    return seen(inside) - seen(outside)


def _jump(image_gradient: mi.Float, pixel: mi.UInt32, contrast: mi.ArrayXf | None) -> mi.Float:
    """<dLoss/dI(pixel), c_in - c_out>: what the loss loses where a boundary moves by a pixel."""
    assert contrast is not None
    g, c = _pixel(image_gradient, pixel), contrast
    return dr.fma(g[0], c[0], dr.fma(g[1], c[1], dr.fma(g[2], c[2], g[3] * c[3])))


def _pixel(image: mi.Float, index: mi.UInt32) -> mi.ArrayXf:
    return dr.gather(mi.ArrayXf, image, index, shape=(4, dr.width(index)))
