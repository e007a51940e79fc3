"""The derivative of visibility, another way: pair antialiasing.

Where neighbouring samples see different surfaces, the boundary between their centres is looked for,
and where it crosses the segment between them decides how much of the one is blended into the pixel
of the other:

    d < 1/2:  I(front) += (1/2 - d) (c_back - c_front),        d > 1/2:  I(back) += (d - 1/2) (c_front - c_back),

with d the distance of the crossing from the front sample, in units of the samples' distance (Laine
et al. 2020, Modular Primitives for High-Performance Differentiable Rendering, section 3.6). Pairs
beside each other look at boundaries steeper than 45 degrees only, pairs above each other at the
flatter ones: each counts once. Either way dI/dd = c_front - c_back, so that a pair is one
silhouette point, in the middle of the edge's piece between two rows of samples, of that piece's
length: the backward pass is that of ``silhouette``. The gradient is that of the blended image, to
rounding.

Two things go beyond the paper. We do not stop at the triangle that the front sample sees but walk
on over the mesh to the silhouette (``walk``), since triangles beside an outline are seen edge-on
and thinner than a pixel. And where two sheets both cover both samples they run into each other,
which is a boundary without an edge (``intersections``). What lies between the samples without being
seen by one of them is missed still: the gradient is too short where parts are thinner than the
samples' distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render import intersections, rays
from appearance_opt.render.camera import camera_of, project
from appearance_opt.render.freezing import traced
from appearance_opt.render.intersections import Intersections
from appearance_opt.render.math import clamp
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, pixel_index
from appearance_opt.render.samples import Samples, Weighted, Whole, concat, join_arrays
from appearance_opt.render.silhouette import EdgeSamples, edges_of, gather_edges
from appearance_opt.render.silhouette_walk import Neighbours, choose, neighbours, walk

if TYPE_CHECKING:
    from appearance_opt.render.drawn import Drawn, Shown
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.quality import Quality


@dataclass
class Pairs:
    """What pairs do to a batch. ``edges``, ``intersections``: the boundaries, ``inside`` the front
    samples and ``pixel`` the pixel that changes. Of all of them: ``receiver``, the index of the
    sample in that pixel; ``pixel``; ``giver``, the other sample; ``weight``, its share in [0,
    1/2]."""

    edges: EdgeSamples | None
    intersections: Intersections | None
    receiver: mi.UInt32
    pixel: mi.UInt32
    giver: Samples
    weight: mi.Float


@dataclass
class Paired:
    """A batch with pairs: the rays that are ``averaged``, those that are ``deferred``, the pixels
    that pairs changed (``crossed``), and the moving boundaries."""

    averaged: Weighted | None
    deferred: Whole | None
    crossed: mi.UInt32 | None
    edges: EdgeSamples | None = None
    intersections: Intersections | None = None


@dataclass
class _Fine:
    """The grid of ``samples``: ``per_axis`` squared in every pixel of ``image``."""

    samples: Batch
    image: Batch
    per_axis: int

    @classmethod
    def of(cls, batch: Batch, per_axis: int) -> _Fine:
        return cls(Batch(batch.records, batch.grid.finer(per_axis)), batch, per_axis)

    def coarse(self, samples: Samples) -> Samples:
        """Positions in pixels of the image, from those of the samples' grid."""
        if self.per_axis == 1:
            return samples
        scale = dr.opaque(mi.Float, 1 / self.per_axis)
        return Samples(samples.view, samples.x * scale, samples.y * scale, samples.triangle)


def paired_samples(
    drawn: Drawn, batch: Batch, quality: Quality, defer: bool, run: Run = traced
) -> Paired:
    """Camera rays on a regular grid, with what pairs move between pixels. Pixels of a single ray
    that no pair changes are deferred with ``defer``. No gradients. The edges must be ``walkable``;
    ``run``: see ``freezing``."""
    fine = _Fine.of(batch, isqrt(quality.samples))
    hits, depth = run(rays.trace_grid, drawn.scene, fine.samples)
    dr.eval(hits, depth)
    found = find_pairs(drawn.shown, hits, depth, fine, run)
    received = dr.zeros(mi.Float, fine.samples.grid.pixels)
    if found is not None:
        dr.scatter_reduce(dr.ReduceOp.Add, received, found.weight, found.receiver)
    averaged, deferred = _weights(hits, received, found, fine, quality, defer)
    if found is None:
        return Paired(averaged, deferred, None)
    dr.eval(found.pixel)
    changed = dr.zeros(mi.Bool, batch.grid.pixels)
    dr.scatter(changed, mi.Bool(True), found.pixel)
    return Paired(averaged, deferred, dr.compress(changed), found.edges, found.intersections)


def find_intersections(
    drawn: Drawn, batch: Batch, per_axis: int, run: Run = traced
) -> Intersections | None:
    """Where surfaces run into each other, found between ``per_axis`` squared rays in every pixel,
    and nothing else of what pairs find: for other estimators of the derivative at silhouettes. None
    without any."""
    fine = _Fine.of(batch, per_axis)
    hits, depth = run(rays.trace_grid, drawn.scene, fine.samples)
    dr.eval(hits, depth)
    found = find_pairs(drawn.shown, hits, depth, fine, run)
    return None if found is None else found.intersections


def _weights(
    hits: Samples,
    received: mi.Float,
    found: Pairs | None,
    fine: _Fine,
    quality: Quality,
    defer: bool,
) -> tuple[Weighted | None, Whole | None]:
    """Every covered sample in its own pixel, less what it receives, and the givers in the pixels of
    the receivers."""
    own = hits.keep(dr.compress(hits.triangle != MISS))
    if dr.width(own.triangle) == 0:
        return None, None
    share = dr.gather(mi.Float, received, pixel_index(own, fine.samples.grid.rows))
    rows = fine.image.grid.rows
    deferred = None
    if defer and fine.per_axis == 1:
        alone = dr.compress(share == 0)
        if dr.width(alone):
            points = own.keep(alone)
            deferred = Whole(
                [points], pixel_index(points, rows), dr.opaque(mi.Float, quality.point_width)
            )
        changed = dr.compress(share > 0)
        own, share = own.keep(changed), dr.gather(mi.Float, share, changed)
    parts = []
    if dr.width(own.triangle):
        own = fine.coarse(own)
        parts.append((own, pixel_index(own, rows), 1 - share))
    given = dr.compress(found.giver.triangle != MISS) if found is not None else mi.UInt32()
    if found is not None and dr.width(given):
        giver = fine.coarse(found.giver.keep(given))
        parts.append(
            (
                giver,
                dr.gather(mi.UInt32, found.pixel, given),
                dr.gather(mi.Float, found.weight, given),
            )
        )
    if not parts:
        return None, deferred
    samples, pixels, weights = zip(*parts, strict=True)
    every, pixel = concat(list(samples)), join_arrays(list(pixels))
    weight = join_arrays(list(weights)) * dr.opaque(mi.Float, 1 / quality.samples)
    dr.eval(every, pixel, weight)
    return Weighted(
        every, pixel, weight, dr.opaque(mi.Float, quality.sample_width / fine.per_axis)
    ), deferred


def find_pairs(
    shown: Shown, hits: Samples, depth: mi.Float, fine: _Fine, run: Run = traced
) -> Pairs | None:
    """The pairs among ``hits``, one sample in every pixel of the finer grid. None without any."""
    assert edges_of(shown).around is not None, "pairs walk over the mesh: use walkable edges"
    every = neighbours(hits, depth, fine.samples.grid)
    if every is None:
        return None
    edge, covers = run(walk, shown, fine.samples, every)
    kept = dr.compress(edge != MISS)
    outlines = [(every.keep(kept), dr.gather(mi.UInt32, edge, kept))]
    # the front sheet goes on under the back sample without being seen there: the back sheet lies
    # before it
    under = dr.compress(
        (covers != MISS) & (every.back.triangle != MISS) & (covers != every.back.triangle)
    )
    met = None
    if dr.width(under):
        other = every.keep(under).swapped()
        edge, returns = run(walk, shown, fine.samples, other)
        kept = dr.compress(edge != MISS)
        outlines.append((other.keep(kept), dr.gather(mi.UInt32, edge, kept)))
        kept = dr.compress((returns != MISS) & (returns != other.back.triangle))
        if dr.width(kept):
            met = intersections.find(shown, fine.samples, other.keep(kept).swapped())
    parts: list[tuple] = []
    points = None
    outlines = [o for o in outlines if o[0].width]
    if outlines:
        pairs, edge = (
            outlines[0]
            if len(outlines) == 1
            else (
                outlines[0][0].join(outlines[1][0]),
                join_arrays([outlines[0][1], outlines[1][1]]),
            )
        )
        points, d = _outline_points(shown, edge, pairs, fine)
        points.pixel, *blended = _blend(pairs, d, fine)
        parts.append((points.pixel, *blended))
    if met is not None:
        met.area = dr.opaque(mi.Float, 1 / fine.per_axis**2)
        met.pixel, *blended = _blend(
            Neighbours(met.inside, met.outside, met.horizontal), met.position, fine
        )
        parts.append((met.pixel, *blended))
        met.inside, met.outside = fine.coarse(met.inside), fine.coarse(met.outside)
        dr.eval(met)
    if not parts:
        return None
    pixel, receiver, weight = (join_arrays([p[k] for p in parts]) for k in range(3))
    return Pairs(points, met, receiver, pixel, concat([p[3] for p in parts]), weight)


def _blend(
    pairs: Neighbours, d: mi.Float, fine: _Fine
) -> tuple[mi.UInt32, mi.UInt32, mi.Float, Samples]:
    """(pixel that changes, index of its sample, share of the other sample, that sample) for
    crossings at ``d``."""
    in_front = d < 0.5
    receiver = choose(in_front, pairs.front, pairs.back)
    out = (
        pixel_index(fine.coarse(receiver), fine.image.grid.rows),
        pixel_index(receiver, fine.samples.grid.rows),
        dr.abs(d - 0.5),
        choose(in_front, pairs.back, pairs.front),
    )
    dr.eval(out)
    return out


def _outline_points(
    shown: Shown, edge: mi.UInt32, pairs: Neighbours, fine: _Fine
) -> tuple[EdgeSamples, mi.Float]:
    """(silhouette points without their pixels, distances from the front samples): where ``edge``
    crosses segments."""
    front, back, horizontal = pairs.front, pairs.back, pairs.horizontal
    ends, batch = gather_edges(shown, edge), fine.samples
    camera = camera_of(batch.records, front.view)
    ax, ay, _ = project(camera, ends.a, batch.grid.size)
    bx, by, _ = project(camera, ends.b, batch.grid.size)
    a_across, b_across = dr.select(horizontal, ay, ax), dr.select(horizontal, by, bx)
    line = dr.select(horizontal, front.y, front.x)
    position = clamp((line - a_across) / (b_across - a_across), 0, 1)
    at = dr.lerp(dr.select(horizontal, ax, ay), dr.select(horizontal, bx, by), position)
    sign = dr.select(horizontal, back.x - front.x, back.y - front.y)
    d = clamp((at - dr.select(horizontal, front.x, front.y)) * sign, 0, 1)
    nx, ny = ay - by, bx - ax
    scale = dr.rsqrt(dr.fma(nx, nx, ny * ny))
    along = dr.select(horizontal, nx, ny) * scale
    scale = dr.select(along * sign > 0, scale, -scale)
    points = EdgeSamples(
        edge=edge,
        view=front.view,
        position=position,
        pixel=mi.UInt32(0),
        # of the piece between two rows of samples
        length=dr.rcp(dr.abs(along)) * dr.opaque(mi.Float, 1 / fine.per_axis),
        normal_x=nx * scale,
        normal_y=ny * scale,
        inside=fine.coarse(front),
        outside=fine.coarse(back),
    )
    dr.eval(points, d)
    return points, d
