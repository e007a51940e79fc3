"""The usual estimator: camera rays, more of them in pixels that a boundary crosses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render import rays
from appearance_opt.render.boundary.edges import Edges
from appearance_opt.render.boundary.estimator import Estimator, Finder, Seen, changed_pixels
from appearance_opt.render.pixels import pixel_index
from appearance_opt.render.samples import Samples, Weighted, Whole, concat, join_arrays
from appearance_opt.render.visibility import see_grid

if TYPE_CHECKING:
    from appearance_opt.render.drawn import Drawn
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.pixels import Batch, Grid
    from appearance_opt.render.sampling import Sampling


@dataclass(frozen=True)
class CameraRays(Estimator):
    """``finders``: what looks for boundaries (without any, visibility has no gradient);
    ``samples``: camera rays in each pixel that a boundary crosses, spread over its area."""

    finders: tuple[Finder, ...] = (Edges(),)
    samples: int = 8

    @property
    def walks(self) -> bool:
        return any(f.walks for f in self.finders)

    def see(self, drawn: Drawn, batch: Batch, sampling: Sampling, seed: int, run: Run) -> Seen:
        """See ``Estimator``."""
        found = [f.find(drawn, batch, sampling, seed, run) for f in self.finders]
        boundaries = [b for b in found if b is not None]
        grid, index = batch.grid, batch.grid.index
        on_edge = changed_pixels([b.pixel for b in boundaries], grid.pixels)
        on_edge = dr.gather(mi.Bool, on_edge, index)
        dr.eval(on_edge, index)
        if sampling.samples == 1:
            seen = see_grid(drawn, batch, 0.5, 0.5, run)
            fine, covered = seen.samples, seen.hit & ~on_edge
        else:
            places = dr.compress(~on_edge)
            fine, covered = rays.trace_pixels(drawn.scene, batch, places, sampling.samples, run)
        whole, others = None, covered
        if sampling.samples <= sampling.defer:
            whole, others = _whole_pixels(fine, covered, grid, sampling)
        parts, weights, crossed = [], [], None
        if others is not None:
            parts, weights = [fine.keep(dr.compress(others))], [1 / sampling.samples]
        if boundaries:
            places = dr.compress(on_edge)
            crossed = dr.gather(mi.UInt32, index, places)
            fine, covered = rays.trace_pixels(drawn.scene, batch, places, self.samples, run)
            parts.append(fine.keep(dr.compress(covered)))
            weights.append(1 / self.samples)
        averaged = _merge_weighted(parts, weights, grid, sampling.sample_width)
        width = dr.opaque(mi.Float, sampling.sample_width)
        return Seen(averaged, whole, crossed, width, self.samples, boundaries)


def _whole_pixels(
    fine: Samples, covered: mi.Bool, grid: Grid, sampling: Sampling
) -> tuple[Whole | None, mi.Bool | None]:
    """(the pixels whose rays are all ``covered``, which other rays are: None of one per pixel).
    ``fine``: as from ``rays.trace_pixels``."""
    count, others = sampling.samples, None
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
    width = sampling.point_width if count == 1 else sampling.sample_width * count**-0.5
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
