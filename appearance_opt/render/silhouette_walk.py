"""Walks over the mesh, from what one sample of the image sees towards its neighbour."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from appearance_opt.render.camera import camera_of, project
from appearance_opt.render.drawn import Shown
from appearance_opt.render.outlines import NOTHING
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, Grid, pixel_index
from appearance_opt.render.samples import Samples, concat, join_arrays
from appearance_opt.render.silhouette import edges_of, gather_edges, is_silhouette
from appearance_opt.render.surface import vertex_position

LONGEST = 32
"""Triangles between a sample and where a walk ends, at most."""


@dataclass
class Neighbours:
    """Samples beside each other (``horizontal``) or above each other that see different triangles:
    ``front`` the nearer one, by depth, and ``back``."""

    front: Samples
    back: Samples
    horizontal: mi.Bool

    def keep(self, index: mi.UInt32) -> Neighbours:
        """Those at the given positions of the list."""
        kept = dr.gather(mi.Bool, self.horizontal, index)
        return Neighbours(self.front.keep(index), self.back.keep(index), kept)

    def swapped(self) -> Neighbours:
        """Seen from the other side."""
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
    """All neighbours among ``hits``, one in every pixel of ``fine``, that see different triangles.
    None without."""
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
    """``one`` where the condition holds, else ``other``, of the same views."""
    fields = [
        dr.select(condition, getattr(one, f), getattr(other, f)) for f in ("x", "y", "triangle")
    ]
    return Samples(one.view, *fields)


def walk(shown: Shown, batch: Batch, pairs: Neighbours) -> tuple[mi.UInt32, mi.UInt32]:
    """(silhouette edge, triangle): where the lines from front to back samples leave the sheet that
    the front sample sees. From triangle to triangle, each left by the last of its edges along the
    line. Either a silhouette is met before the back sample, which is an edge if it is one of this
    kind of pair's (steeper than 45 degrees for those beside each other, flatter for the others), or
    the sheet covers the back sample, with that triangle; what is not there is MISS."""
    around = edges_of(shown).around
    front, back, horizontal = pairs.front, pairs.back, pairs.horizontal
    count = pairs.width
    start_along, line = (
        dr.select(horizontal, front.x, front.y),
        dr.select(horizontal, front.y, front.x),
    )
    sign = dr.select(horizontal, back.x - front.x, back.y - front.y)

    def visit(
        face: mi.UInt32, walking: mi.Bool, steps: mi.UInt32, found: mi.UInt32, covers: mi.UInt32
    ) -> tuple:
        here = dr.gather(mi.ArrayXu, around, face, walking, shape=(12, count))
        camera = camera_of(batch.records, front.view)
        projected = [
            project(camera, vertex_position(shown.surface, here[k]), batch.grid.size)
            for k in range(3)
        ]
        walking &= (projected[0][2] > 0) & (projected[1][2] > 0) & (projected[2][2] > 0)
        along = [dr.select(horizontal, p[0], p[1]) for p in projected]
        across = [dr.select(horizontal, p[1], p[0]) for p in projected]
        furthest, leaves, beyond = mi.Float(-1e30), mi.UInt32(MISS), mi.UInt32(face)
        ours = mi.Bool(False)
        for k in range(3):
            n = (k + 1) % 3
            rise, run = across[n] - across[k], dr.abs(along[n] - along[k])
            crosses = (across[k] > line) != (across[n] > line)
            s = (line - across[k]) / dr.select(crosses, rise, 1)
            t = (dr.lerp(along[k], along[n], s) - start_along) * sign
            last = crosses & (t > furthest)
            furthest, leaves = dr.select(last, t, furthest), dr.select(last, here[4 + k], leaves)
            beyond = dr.select(last, here[8 + k], beyond)
            # at 45 degrees the edge belongs to the pairs beside each other
            ours = dr.select(
                last, dr.select(horizontal, run <= dr.abs(rise), run < dr.abs(rise)), ours
            )
        walking &= leaves != MISS
        covers = dr.select(walking & (furthest > 1), face, covers)
        walking &= furthest <= 1
        edge = gather_edges(shown, leaves, walking)
        edge.index = dr.select(walking, leaves, 0)
        ends = walking & is_silhouette(shown, edge, camera)
        found = dr.select(ends & ours, leaves, found)
        walking &= ~ends
        return dr.select(walking, beyond, face), walking, steps + 1, found, covers

    nothing = dr.full(mi.UInt32, MISS, count)
    start = (
        mi.UInt32(front.triangle),
        front.triangle != MISS,
        dr.zeros(mi.UInt32, count),
        nothing,
        mi.UInt32(nothing),
    )
    state = dr.while_loop(start, lambda _, walking, steps, *__: walking & (steps < LONGEST), visit)
    dr.eval(state[3], state[4])
    return state[3], state[4]
