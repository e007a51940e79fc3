"""Edges of a triangle mesh, and the faces at them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Sides:
    """The 3 F sides of faces, grouped by the edge that they lie on: an edge may have any number of
    faces. Each array is sorted by edge; ``start``: (E,) where each edge begins in the others.

    ``face``: the face of a side; ``corner``: the corner of that face where the side starts, so that
    it ends at the next one and the opposite corner comes after that.
    """

    face: NDArray[np.int64]
    corner: NDArray[np.int64]
    start: NDArray[np.int64]

    @property
    def uses(self) -> NDArray[np.int64]:
        """(E,) number of faces at each edge."""
        return np.diff(np.append(self.start, len(self.face)))

    def corners(self, faces: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """(first, last, opposite) vertex of each side."""
        side = 3 * self.face + self.corner
        return (
            faces.ravel()[side],
            faces[:, [1, 2, 0]].ravel()[side],
            faces[:, [2, 0, 1]].ravel()[side],
        )


def sides_of(faces: NDArray) -> Sides:
    """The sides of faces (F, 3), by edge; those of one edge in the order of their faces."""
    n = len(faces)
    key = keys(faces.ravel(), faces[:, [1, 2, 0]].ravel())
    order = np.argsort(key, kind="stable")
    key = key[order]
    start = np.flatnonzero(np.concatenate([[n > 0], key[1:] != key[:-1]]))
    return Sides(order // 3, order % 3, start)


def edges_of(faces: NDArray) -> tuple[NDArray, NDArray]:
    """(E, 2) unique edges and the number of faces at each."""
    start, end = faces.T.ravel(), faces[:, [1, 2, 0]].T.ravel()
    unique, uses = np.unique(keys(start, end), return_counts=True)
    return np.stack([unique >> 32, unique & 0xFFFFFFFF], axis=1), uses


def keys(a: NDArray, b: NDArray) -> NDArray[np.int64]:
    """One number per undirected edge: the smaller vertex above the larger one."""
    return (np.minimum(a, b).astype(np.int64) << 32) | np.maximum(a, b)


def touching(marked: NDArray[np.bool_], faces: NDArray) -> NDArray[np.bool_]:
    """(F,) faces with a marked vertex."""
    return marked[faces[:, 0]] | marked[faces[:, 1]] | marked[faces[:, 2]]
