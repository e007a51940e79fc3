"""Vertex normals: one definition for loading, baking, fitting and export."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def weld(positions: NDArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Vertices at exactly the same place made one: (index of one representative per place, place of each
    vertex)."""
    rows = np.ascontiguousarray(positions + 0.0)  # + 0 turns -0 into 0
    keys = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
    _, first, place = np.unique(keys, return_index=True, return_inverse=True)
    return first, place.ravel()


def vertex_normals(positions: NDArray, faces: NDArray, welded: bool = False) -> NDArray[np.float32]:
    """Angle-weighted unit normals (V, 3) (Thuermer and Wuethrich 1998).

    Vertices at the same place share their normal, so that UV seams do not show; pass ``welded`` when
    there are none. A vertex that no face with area uses gets +Z.
    """
    p = np.asarray(positions, np.float64)
    place = np.arange(len(p)) if welded else weld(positions)[1]
    corners = [p[faces[:, k]] for k in range(3)]
    normal = unit(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
    total = np.zeros((int(place.max()) + 1 if len(place) else 0, 3))
    for k in range(3):
        angle = corner_angle(corners[(k + 1) % 3] - corners[k], corners[(k + 2) % 3] - corners[k])
        accumulate(total, place[faces[:, k]], normal * angle[:, None])
    out = unit(total)[place]
    out[~np.any(out, axis=1)] = (0.0, 0.0, 1.0)
    return out.astype(np.float32)


def unit(v: NDArray) -> NDArray:
    """v / |v|; zero where v is zero."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.divide(v, length, out=np.zeros_like(v), where=length > 0)


def corner_angle(a: NDArray, b: NDArray) -> NDArray:
    """Angle between vectors (N, 3), accurate for small and large ones; 0 if one is zero."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))


def accumulate(total: NDArray, index: NDArray, values: NDArray) -> None:
    """total[index] += values, rows that repeat included (bincount is far faster than ``np.add.at``)."""
    for c in range(values.shape[1]):
        total[:, c] += np.bincount(index, values[:, c], len(total))
