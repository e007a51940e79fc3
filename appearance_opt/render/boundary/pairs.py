"""The derivative of visibility, another way: pair antialiasing.

Where neighbouring samples see different surfaces, the boundary between their centres is looked for,
and where it crosses the segment between them decides how much of the one is blended into the pixel
of the other:

    d < 1/2:  I(front) += (1/2 - d) (c_back - c_front),
    d > 1/2:  I(back)  += (d - 1/2) (c_front - c_back),

with d the distance of the crossing from the front sample, in units of the samples' distance (Laine
et al. 2020, Modular Primitives for High-Performance Differentiable Rendering, section 3.6). Pairs
beside each other look at boundaries steeper than 45 degrees only, pairs above each other at the
flatter ones: each counts once. Either way dI/dd = c_front - c_back, so that a pair is one
silhouette point, in the middle of the edge's piece between two rows of samples, of that piece's
length: the backward pass is that of ``edges``. The gradient is that of the blended image, to
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

from appearance_opt.render.boundary.edges import EdgePoints
from appearance_opt.render.boundary.estimator import Boundary, Estimator, Seen, changed_pixels
from appearance_opt.render.boundary.intersections import crossings
from appearance_opt.render.boundary.neighbours import Blend, FineGrid, Neighbours
from appearance_opt.render.boundary.silhouette_walk import search
from appearance_opt.render.boundary.silhouettes import gather_edges
from appearance_opt.render.camera import camera_of, project
from appearance_opt.render.math import clamp
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import pixel_index
from appearance_opt.render.samples import Samples, Weighted, Whole, concat, join_arrays

if TYPE_CHECKING:
    from appearance_opt.render.drawn import Drawn, Shown
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.pixels import Batch
    from appearance_opt.render.sampling import Sampling


@dataclass(frozen=True)
class Pairs(Estimator):
    """Camera rays on a regular grid, with what moves between the pixels of neighbours that see
    different surfaces. Pixels have a square number of samples."""

    @property
    def walks(self) -> bool:
        return True

    def check(self, sampling: Sampling) -> None:
        """See ``Estimator``."""
        count = sampling.samples
        if isqrt(count) ** 2 != count:
            raise ValueError(f"pairs need a square number of samples per pixel, not {count}")

    def see(self, drawn: Drawn, batch: Batch, sampling: Sampling, seed: int, run: Run) -> Seen:
        """See ``Estimator``. Pixels of a single ray that no pair changes can be deferred."""
        shown, fine = drawn.shown, FineGrid.of(batch, isqrt(sampling.samples))
        hits, depth = fine.trace(drawn.scene, run)
        found = search(shown, hits, depth, fine, run)
        boundaries: list[Boundary] = []
        blends = []
        if found.outlines is not None:
            pairs, edge = found.outlines
            points, d = _edge_points(shown, edge, pairs, fine)
            blends.append(Blend.of(pairs, d, fine))
            points.pixel = blends[-1].pixel
            boundaries.append(points)
        met = None if found.meeting is None else crossings(shown, fine, found.meeting)
        if met is not None:
            boundaries.append(met[0])
            blends.append(met[1])
        received = dr.zeros(mi.Float, fine.samples.grid.pixels)
        moved, crossed = None, None
        if blends:
            moved = Blend.join(blends)
            dr.scatter_reduce(dr.ReduceOp.Add, received, moved.weight, moved.receiver)
        averaged, whole = _weights(hits, received, moved, fine, sampling)
        if moved is not None:
            crossed = dr.compress(changed_pixels([moved.pixel], batch.grid.pixels))
        width = dr.opaque(mi.Float, sampling.sample_width / fine.per_axis)
        return Seen(averaged, whole, crossed, width, None, boundaries)


def _weights(
    hits: Samples,
    received: mi.Float,
    moved: Blend | None,
    fine: FineGrid,
    sampling: Sampling,
) -> tuple[Weighted | None, Whole | None]:
    """Every covered sample in its own pixel, less what it receives, and the givers in the pixels of
    the receivers."""
    own = hits.keep(dr.compress(hits.triangle != MISS))
    if dr.width(own.triangle) == 0:
        return None, None
    share = dr.gather(mi.Float, received, pixel_index(own, fine.samples.grid.rows))
    rows = fine.image.grid.rows
    whole = None
    if fine.per_axis == 1 <= sampling.defer:
        alone = dr.compress(share == 0)
        if dr.width(alone):
            points = own.keep(alone)
            whole = Whole(
                [points], pixel_index(points, rows), dr.opaque(mi.Float, sampling.point_width)
            )
        changed = dr.compress(share > 0)
        own, share = own.keep(changed), dr.gather(mi.Float, share, changed)
    parts = []
    if dr.width(own.triangle):
        own = fine.coarse(own)
        parts.append((own, pixel_index(own, rows), 1 - share))
    given = dr.compress(moved.giver.triangle != MISS) if moved is not None else mi.UInt32()
    if moved is not None and dr.width(given):
        giver = fine.coarse(moved.giver.keep(given))
        parts.append(
            (
                giver,
                dr.gather(mi.UInt32, moved.pixel, given),
                dr.gather(mi.Float, moved.weight, given),
            )
        )
    if not parts:
        return None, whole
    samples, pixels, weights = zip(*parts, strict=True)
    every, pixel = concat(list(samples)), join_arrays(list(pixels))
    weight = join_arrays(list(weights)) * dr.opaque(mi.Float, 1 / sampling.samples)
    dr.eval(every, pixel, weight)
    return Weighted(
        every, pixel, weight, dr.opaque(mi.Float, sampling.sample_width / fine.per_axis)
    ), whole


def _edge_points(
    shown: Shown, edge: mi.UInt32, pairs: Neighbours, fine: FineGrid
) -> tuple[EdgePoints, mi.Float]:
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
    points = EdgePoints(
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
