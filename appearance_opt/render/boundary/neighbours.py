"""Neighbouring samples that see different surfaces, and what lies between them moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render import rays
from appearance_opt.render.outlines import NOTHING
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, Grid, pixel_index
from appearance_opt.render.samples import Samples, concat, join_arrays

if TYPE_CHECKING:
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.passing import Scene


@dataclass
class FineGrid:
    """The grid of ``samples``: ``per_axis`` squared in every pixel of ``image``."""

    samples: Batch
    image: Batch
    per_axis: int

    @classmethod
    def of(cls, batch: Batch, per_axis: int) -> FineGrid:
        """A grid in the pixels of a batch."""
        return cls(Batch(batch.records, batch.grid.finer(per_axis)), batch, per_axis)

    def trace(self, scene: Scene, run: Run) -> tuple[Samples, mi.Float]:
        """Find what the ray of every sample hits, and its depth."""
        hits, depth = run(rays.trace_grid, scene, self.samples)
        dr.eval(hits, depth)
        return hits, depth

    def coarse(self, samples: Samples) -> Samples:
        """Return positions in pixels of the image, from those of the samples' grid."""
        if self.per_axis == 1:
            return samples
        scale = dr.opaque(mi.Float, 1 / self.per_axis)
        return Samples(samples.view, samples.x * scale, samples.y * scale, samples.triangle)


@dataclass
class Neighbours:
    """Samples beside each other (``horizontal``) or above each other that see different triangles:
    ``front`` the nearer one, by depth, and ``back``."""

    front: Samples
    back: Samples
    horizontal: mi.Bool

    def keep(self, index: mi.UInt32) -> Neighbours:
        """Take those at the given positions of the list."""
        kept = dr.gather(mi.Bool, self.horizontal, index)
        return Neighbours(self.front.keep(index), self.back.keep(index), kept)

    def swapped(self) -> Neighbours:
        """Look from the other side."""
        return Neighbours(self.back, self.front, self.horizontal)

    def join(self, other: Neighbours) -> Neighbours:
        """Both lists, one after the other."""
        horizontal = join_arrays([mi.UInt32(self.horizontal), mi.UInt32(other.horizontal)]) == 1
        return Neighbours(
            concat([self.front, other.front]), concat([self.back, other.back]), horizontal
        )

    @property
    def width(self) -> int:
        return dr.width(self.horizontal)


def neighbours(hits: Samples, depth: mi.Float, fine: Grid) -> Neighbours | None:
    """Find all neighbours among ``hits``, one in every pixel of ``fine``, that see different
    triangles. None without."""
    index = pixel_index(hits, fine.rows)
    triangles, depths = dr.empty(mi.UInt32, fine.pixels), dr.empty(mi.Float, fine.pixels)
    dr.scatter(triangles, hits.triangle, index, mode=dr.ReduceMode.Permute)
    dr.scatter(
        depths,
        dr.select(hits.triangle == MISS, mi.Float(NOTHING), depth),
        index,
        mode=dr.ReduceMode.Permute,
    )
    dr.eval(triangles, depths)
    found = []
    for horizontal in (True, False):
        inside = (fine.column if horizontal else fine.row) + 1 < fine.rows
        step = mi.UInt32(1) if horizontal else fine.rows
        other = dr.gather(mi.UInt32, triangles, index + step, inside)
        found.append(dr.compress(inside & (other != hits.triangle)))
    there = [k for k in (0, 1) if dr.width(found[k])]
    if not there:
        return None
    one = concat([hits.keep(found[k]) for k in there])
    horizontal = join_arrays([dr.full(mi.UInt32, k == 0, dr.width(found[k])) for k in there]) == 1
    dr.eval(one, horizontal)
    at = pixel_index(one, fine.rows)
    beyond = at + dr.select(horizontal, 1, fine.rows)
    x, y = dr.select(horizontal, one.x + 1, one.x), dr.select(horizontal, one.y, one.y + 1)
    other = Samples(one.view, x, y, dr.gather(mi.UInt32, triangles, beyond))
    first = dr.gather(mi.Float, depths, at) <= dr.gather(mi.Float, depths, beyond)
    out = Neighbours(choose(first, one, other), choose(first, other, one), horizontal)
    dr.eval(out.front, out.back)
    return out


def choose(condition: mi.Bool, one: Samples, other: Samples) -> Samples:
    """Take ``one`` where the condition holds, else ``other``, of the same views."""
    fields = [
        dr.select(condition, getattr(one, f), getattr(other, f)) for f in ("x", "y", "triangle")
    ]
    return Samples(one.view, *fields)


@dataclass
class Blend:
    """What moves between pixels where something passes between neighbours: the ``pixel`` that
    changes, ``receiver``, the index of its sample, ``giver``, the other sample, and its ``weight``
    in [0, 1/2]."""

    pixel: mi.UInt32
    receiver: mi.UInt32
    weight: mi.Float
    giver: Samples

    @classmethod
    def of(cls, pairs: Neighbours, d: mi.Float, fine: FineGrid) -> Blend:
        """For crossings at the distance ``d`` from the front samples."""
        in_front = d < 0.5
        receiver = choose(in_front, pairs.front, pairs.back)
        out = cls(
            pixel_index(fine.coarse(receiver), fine.image.grid.rows),
            pixel_index(receiver, fine.samples.grid.rows),
            dr.abs(d - 0.5),
            choose(in_front, pairs.back, pairs.front),
        )
        dr.eval(out)
        return out

    @classmethod
    def join(cls, parts: list[Blend]) -> Blend:
        """Lists one after the other."""
        pixel, receiver, weight = (
            join_arrays([getattr(p, f) for p in parts]) for f in ("pixel", "receiver", "weight")
        )
        return cls(pixel, receiver, weight, concat([p.giver for p in parts]))
