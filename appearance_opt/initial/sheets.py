"""Sheets that lie back to back, each seen from its own side only: leaves, pages, signs.

Welded, their two sides share every vertex: the normals of both cancel there, and a chart of the
atlas could run from one side over the rim onto the other. So each side gets vertices of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from appearance_opt.asset.normals import accumulate, unit
from appearance_opt.asset.sides import culled
from appearance_opt.initial.edges import Sides, sides_of
from appearance_opt.render.upload import ACROSS

FOLDED = -0.95
"""Cosine of normals below which faces look away from each other."""


@dataclass(frozen=True)
class Separated:
    """``positions`` (V, 3) and ``faces`` (F, 3): of a mesh whose sheets share no vertex with what
    is at their backs; ``behind`` (F,): faces of such sheets of which those at their backs are
    none."""

    positions: NDArray
    faces: NDArray
    behind: NDArray[np.bool_]


def separate(positions: NDArray, faces: NDArray, single: NDArray[np.bool_] | None) -> Separated:
    """A welded mesh with a vertex more wherever faces that are seen from one side only (``single``
    (F,), None for none) meet others that look the opposite way, without an edge that leads from the
    ones to the others."""
    one_way, nothing = culled(positions, faces, single), np.zeros(len(faces), bool)
    if one_way is None:
        return Separated(positions, faces, nothing)
    corners = np.asarray(positions, np.float64)[faces]
    normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    fan = _fans(faces, normals, one_way)
    towards = np.zeros((int(fan.max()) + 1, 3))
    accumulate(towards, fan, np.repeat(normals, 3, axis=0))
    towards = unit(towards)
    vertex = faces.ravel()
    # of the fans around a vertex that look away from the first of them
    own = np.flatnonzero(np.repeat(one_way, 3))
    at = np.full(len(positions), -1, np.int64)
    at[vertex[own[::-1]]] = fan[own[::-1]]
    away = np.zeros(len(vertex), bool)
    cosine = np.sum(towards[at[vertex[own]]] * towards[fan[own]], axis=1)
    split = np.zeros(len(positions), bool)
    split[vertex[own[cosine < FOLDED]]] = True
    away[own] = split[vertex[own]] & (cosine < 0)
    if not away.any():
        return Separated(positions, faces, nothing)
    copied, number = np.unique(vertex[away], return_inverse=True)
    out = vertex.copy()
    out[away] = len(positions) + number.ravel()
    # which of two sides is taken out does not matter, as long as it is never both
    second = one_way & split[faces].any(axis=1) & (normals @ np.array(ACROSS) < 0)
    return Separated(
        np.concatenate([positions, positions[copied]]),
        out.reshape(-1, 3).astype(faces.dtype),
        second,
    )


def _fans(faces: NDArray, normals: NDArray, one_way: NDArray) -> NDArray[np.int32]:
    """(3 F,) fan of each corner: faces around a vertex from each of which edges lead to the next,
    over no fold."""
    s: Sides = sides_of(faces.astype(np.int64))
    first, _, _ = s.corners(faces)
    edge = np.repeat(np.arange(len(s.start)), s.uses)
    joined = []
    for step in range(1, int(s.uses.max())):
        a = np.flatnonzero(edge[:-step] == edge[step:])
        b = a + step
        f, g = s.face[a], s.face[b]
        on = (
            (first[a] != first[b])
            & (np.sum(normals[f] * normals[g], axis=1) > FOLDED)
            & one_way[f]
            & one_way[g]
        )
        a, b = a[on], b[on]
        ends = [
            (3 * s.face[k] + s.corner[k], 3 * s.face[k] + (s.corner[k] + 1) % 3) for k in (a, b)
        ]
        joined += [(ends[0][0], ends[1][1]), (ends[0][1], ends[1][0])]
    rows, columns = (
        np.concatenate([j[k] for j in joined]) if joined else np.empty(0, np.int64) for k in (0, 1)
    )
    size = 3 * len(faces)
    return connected_components(
        coo_matrix((np.ones(len(rows)), (rows, columns)), (size, size)), directed=False
    )[1]
