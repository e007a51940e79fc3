"""Walks over the mesh, from what one sample of the image sees towards its neighbour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render.boundary.neighbours import FineGrid, Neighbours, neighbours
from appearance_opt.render.boundary.silhouettes import edges_of, gather_edges, is_silhouette
from appearance_opt.render.camera import camera_of, project
from appearance_opt.render.passing import MISS
from appearance_opt.render.samples import Samples, join_arrays
from appearance_opt.render.surface import vertex_position

if TYPE_CHECKING:
    from appearance_opt.render.drawn import Shown
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.pixels import Batch

LONGEST = 32
"""Triangles between a sample and where a walk ends, at most."""


@dataclass
class Between:
    """What lies between neighbouring samples. ``outlines``: those with a silhouette between them,
    and the number of its edge; ``meeting``: those whose sheets go on under each other. None without
    any."""

    outlines: tuple[Neighbours, mi.UInt32] | None = None
    meeting: Neighbours | None = None


def search(shown: Shown, hits: Samples, depth: mi.Float, fine: FineGrid, run: Run) -> Between:
    """Find what lies between ``hits``, one sample in every pixel of the finer grid."""
    assert edges_of(shown).around is not None, "walks need edges of ``edge_list.walkable``"
    every = neighbours(hits, depth, fine.samples.grid)
    if every is None:
        return Between()
    edge, covers = run(walk, shown, fine.samples, every)
    kept = dr.compress(edge != MISS)
    outlines = [(every.keep(kept), dr.gather(mi.UInt32, edge, kept))]
    # the front sheet goes on under the back sample without being seen there: the back sheet lies
    # before it
    under = dr.compress(
        (covers != MISS) & (every.back.triangle != MISS) & (covers != every.back.triangle)
    )
    out = Between()
    if dr.width(under):
        other = every.keep(under).swapped()
        edge, returns = run(walk, shown, fine.samples, other)
        kept = dr.compress(edge != MISS)
        outlines.append((other.keep(kept), dr.gather(mi.UInt32, edge, kept)))
        kept = dr.compress((returns != MISS) & (returns != other.back.triangle))
        if dr.width(kept):
            out.meeting = other.keep(kept).swapped()
    outlines = [o for o in outlines if o[0].width]
    if len(outlines) == 1:
        out.outlines = outlines[0]
    elif outlines:
        (one, first), (other, second) = outlines
        out.outlines = one.join(other), join_arrays([first, second])
    return out


def walk(shown: Shown, batch: Batch, pairs: Neighbours) -> tuple[mi.UInt32, mi.UInt32]:
    """Return (silhouette edge, triangle): where the lines from front to back samples leave the
    sheet that the front sample sees. From triangle to triangle, each left by the last of its edges
    along the line. Either a silhouette is met before the back sample, which is an edge if it is one
    of this kind of pair's (steeper than 45 degrees for those beside each other, flatter for the
    others), or the sheet covers the back sample, with that triangle; what is not there is MISS."""
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
