"""The edges of a mesh, each with the faces beside it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass
class EdgeList:
    """Edges of a mesh: packets (a, b, opposite vertex, other opposite vertex), ``count`` of them.
    An edge with one face, or more than two, has b in place of the other opposite vertex: it counts
    as a silhouette from everywhere.

    ``around``: for walks over the mesh (see ``walkable``), packets (three vertices, 0, three edges,
    0, three neighbours, 0) per face; edge k runs from vertex k to the next, and the neighbour lies
    beyond it (the face itself where there is not exactly one).

    ``sides``: for faces that are not to be seen from behind, sums of the following bits per edge;
    None without any. Of the face with the first opposite vertex: 1 if it is culled, 2 if it runs
    from a to b by its winding; of that with the other one: 4 and 8. Where an edge has more than two
    faces none of them is culled here: some are seen.

    ``creased``: edges at which two faces with different normals meet: what is seen jumps there, as
    at a silhouette; None without any.
    """

    packets: mi.UInt32
    count: int
    around: mi.UInt32 | None = None
    sides: mi.UInt32 | None = None
    creased: mi.Bool | None = None


def edge_list(
    faces: NDArray, culled: NDArray | None = None, normals: NDArray | None = None
) -> EdgeList:
    """List all edges of a welded mesh (F, 3). ``culled`` (F,): see ``Surface.culled``. ``normals``
    (F, 3): numbers of the normals at the corners, where a vertex has several."""
    low, high, opposite, order, heads, uses = _sorted_edges(faces)
    second = np.minimum(heads + 1, len(low) - 1)
    other = np.where(uses == 2, opposite[second], high[heads])
    packets = np.stack([low[heads], high[heads], opposite[heads], other], axis=1).astype(np.uint32)
    sides = None
    if culled is not None:
        corner, face = np.divmod(order, len(faces))
        bits = np.where(culled[face], 1, 0) + np.where(faces[face, corner] == low, 2, 0)
        bits = np.where(uses <= 2, bits[heads], 0) + np.where(uses == 2, 4 * bits[second], 0)
        sides = mi.UInt32(bits.astype(np.uint32))
    creased = None
    if normals is not None:
        corner, face = np.divmod(order, len(faces))
        start, end = normals[face, corner], normals[face, (corner + 1) % 3]
        runs_up = faces[face, corner] == low
        at_low, at_high = np.where(runs_up, start, end), np.where(runs_up, end, start)
        apart = (at_low[heads] != at_low[second]) | (at_high[heads] != at_high[second])
        creased = mi.Bool(apart & (uses == 2))
    return EdgeList(mi.UInt32(packets.ravel()), len(heads), sides=sides, creased=creased)


def walkable(edges: EdgeList, faces: NDArray) -> EdgeList:
    """Return the same edges of the same faces (F, 3), with what lies around each face."""
    _, _, _, order, heads, uses = _sorted_edges(faces)
    count = len(faces)
    face, edge = order % count, np.repeat(np.arange(len(heads)), uses)
    partner = np.where(uses == 2, 2 * heads + 1, 0)[edge] - np.arange(len(order))
    beyond = np.where(uses[edge] == 2, face[np.clip(partner, 0, len(order) - 1)], face)
    out = np.zeros((count, 3, 4), np.uint32)
    out[:, 0, :3] = faces
    out[face, 1, order // count] = edge
    out[face, 2, order // count] = beyond
    return replace(edges, around=mi.UInt32(out.ravel()))


def _sorted_edges(faces: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray, NDArray]:
    """The three edges of all faces, those that coincide side by side: lower, higher and opposite
    vertex (3 F), where each comes from (k F + face for the edge after corner k); and where each
    edge begins in that list, and how often it is there (E)."""
    corners = np.asarray(faces, np.int64)
    start, end, opposite = (
        corners.T.ravel(),
        corners[:, [1, 2, 0]].T.ravel(),
        corners[:, [2, 0, 1]].T.ravel(),
    )
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    low, high, opposite = low[order], high[order], opposite[order]
    first = np.ones(len(low), bool)
    first[1:] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    heads = np.flatnonzero(first)
    return low, high, opposite, order, heads, np.diff(np.append(heads, len(low)))
