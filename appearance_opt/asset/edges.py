"""Where the faces of a surface meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.normals import unit

MANY = 64
"""Pairs of faces at one edge up to which the best are looked for. At others, which are stacks of
hundreds, pairs follow the order of the file."""


@dataclass(frozen=True)
class Edges:
    """Pairs of faces that run along an edge in opposite directions, as those of one surface do.

    Where an edge has several faces, those are paired whose normals differ least, each once at most:
    the two sides of a sheet that is modelled as two sheets back to back each keep together.

    ``ends`` (E, 2): places at which an edge ends; ``faces`` (E, 2); ``corners`` (E, 2, 2): for both
    ends, the corners (3 * face + number) of the two faces there; ``cosine`` (E,): of the angle
    between their normals, 0 without one; ``several`` (E,): has the edge another pair? ``normals``
    (F, 3): unit normals of the faces, zero without area.
    """

    ends: NDArray[np.int64]
    faces: NDArray[np.int64]
    corners: NDArray[np.int64]
    cosine: NDArray[np.float64]
    several: NDArray[np.bool_]
    normals: NDArray[np.float64]

    @classmethod
    def of(cls, positions: NDArray, faces: NDArray) -> Edges:
        """Those of ``faces`` (F, 3) at ``positions`` (P, 3), all different."""
        p = np.asarray(positions, np.float64)
        a, b, c = (p[faces[:, k]] for k in range(3))
        normals = unit(np.cross(b - a, c - a))
        start = np.asarray(faces, np.int64).ravel()
        end = np.roll(faces, -1, axis=1).astype(np.int64).ravel()
        key = np.minimum(start, end) * len(p) + np.maximum(start, end)
        one, other = _pairs(key, start, end, normals)
        after_one, after_other = one // 3 * 3 + (one + 1) % 3, other // 3 * 3 + (other + 1) % 3
        corners = np.stack([one, after_other, after_one, other], axis=1).reshape(-1, 2, 2)
        found = key[one]
        several = np.zeros(len(found), bool)
        several[1:] = found[1:] == found[:-1]
        several[:-1] |= several[1:]
        between = np.stack([one // 3, other // 3], axis=1)
        cosine = _cosines(normals, between[:, 0], between[:, 1])
        return cls(
            np.stack([start[one], end[one]], axis=1), between, corners, cosine, several, normals
        )


def _cosines(normals: NDArray, one: NDArray, other: NDArray) -> NDArray[np.float64]:
    return np.clip(np.sum(normals[one] * normals[other], axis=1), -1, 1)


def _pairs(
    key: NDArray, start: NDArray, end: NDArray, normals: NDArray
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Half edges of opposite directions, (E,) and (E,), in the order of their ``key``. ``start``,
    ``end``: of half edges, three for each face."""
    forward, backward = np.flatnonzero(start < end), np.flatnonzero(start > end)
    forward = forward[np.argsort(key[forward], kind="stable")]
    backward = backward[np.argsort(key[backward], kind="stable")]
    first, second = key[forward], key[backward]
    begin, stop = (np.searchsorted(second, first, side=side) for side in ("left", "right"))
    rank = np.arange(len(first)) - np.searchsorted(first, first)
    # the k-th that runs one way meets the k-th that runs the other way
    match = begin + rank
    paired = match < stop
    one, other = forward[paired], backward[match[paired]]
    # where there is a choice, the best
    uses = np.searchsorted(first, first, side="right") - np.searchsorted(first, first)
    choices = uses * (stop - begin)
    choose = np.flatnonzero((choices > 1) & (choices <= MANY))
    if not len(choose):
        return one, other
    count = (stop - begin)[choose]
    k = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    one_of, other_of = (
        np.repeat(forward[choose], count),
        backward[np.repeat(begin[choose], count) + k],
    )
    best = _best(key[one_of], one_of, other_of, _cosines(normals, one_of // 3, other_of // 3))
    kept = ~np.isin(one, forward[choose])
    one, other = (
        np.concatenate([one[kept], one_of[best]]),
        np.concatenate([other[kept], other_of[best]]),
    )
    order = np.argsort(key[one], kind="stable")
    return one[order], other[order]


def _best(key: NDArray, one: NDArray, other: NDArray, cosine: NDArray) -> NDArray[np.int64]:
    """Which of the pairs of half edges (N,) to take, each half edge once: of those of one ``key``
    those of the largest cosine first."""
    left = np.lexsort((-cosine, key))
    taken = np.zeros(int(max(one.max(), other.max())) + 1, bool)
    chosen = []
    while len(left):
        leads = left[np.diff(key[left], prepend=-1) != 0]
        chosen.append(leads)
        taken[one[leads]] = taken[other[leads]] = True
        left = left[~(taken[one[left]] | taken[other[left]])]
    return np.concatenate(chosen)
