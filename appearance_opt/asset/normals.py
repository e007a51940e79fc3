"""Vertex normals: one definition for loading, baking, fitting and export."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def weld(positions: NDArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Vertices at exactly the same place made one: (index of one representative per place, place of
    each vertex)."""
    rows = np.ascontiguousarray(positions + 0.0)  # + 0 turns -0 into 0
    keys = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
    _, first, place = np.unique(keys, return_index=True, return_inverse=True)
    return first, place.ravel()


def apart(rows: NDArray, mesh_of: NDArray | None) -> NDArray:
    """Rows (N, K) that are equal only within one mesh: with its number, below 2^24, as another
    column."""
    return (
        rows
        if mesh_of is None
        else np.concatenate([rows, mesh_of[:, None].astype(rows.dtype)], axis=1)
    )


CANCELLED = 1e-6
"""Unit vectors cancel when the length of their weighted sum is at most this share of the weights:
rounding leaves 1e-7 in single precision."""


def vertex_normals(positions: NDArray, faces: NDArray, welded: bool = False) -> NDArray[np.float32]:
    """Angle-weighted unit normals (V, 3) (Thuermer and Wuethrich 1998).

    Vertices at the same place share their normal, so that UV seams do not show; pass ``welded``
    when there are none. A vertex that no face with area uses, or whose faces' normals cancel, gets
    +Z.
    """
    out = summed_normals(positions, faces, welded)
    out[~np.any(out, axis=1)] = (0.0, 0.0, 1.0)
    return out


def summed_normals(
    positions: NDArray, faces: NDArray, welded: bool = False, mesh_of: NDArray | None = None
) -> NDArray[np.float32]:
    """The same, but zero where there is no such normal. ``mesh_of`` (V,): vertices of different
    meshes share nothing."""
    p = np.asarray(positions, np.float64)
    place = np.arange(len(p)) if welded else weld(apart(positions, mesh_of))[1]
    corners = [p[faces[:, k]] for k in range(3)]
    normal = unit(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
    total = np.zeros((int(place.max()) + 1 if len(place) else 0, 4))
    for k in range(3):
        angle = corner_angle(corners[(k + 1) % 3] - corners[k], corners[(k + 2) % 3] - corners[k])
        accumulate(
            total,
            place[faces[:, k]],
            np.concatenate([normal, np.ones((len(normal), 1))], 1) * angle[:, None],
        )
    summed, weight = total[:, :3], total[:, 3]
    summed[np.linalg.norm(summed, axis=1) <= CANCELLED * weight] = 0
    return unit(summed)[place].astype(np.float32)


def split_where_cancelled(
    positions: NDArray, faces: NDArray, normals: NDArray
) -> tuple[NDArray[np.intp], NDArray[np.int32], NDArray[np.float32]]:
    """(vertex that each new vertex comes from, faces, normals) without zero normals (see
    ``summed_normals``): where the two sides of a sheet share their vertices, each corner gets one
    of its own with the normal of its face."""
    lost = ~np.any(normals, axis=1)
    index = np.arange(len(positions))
    face, corner = np.nonzero(lost[faces])
    normals = np.where(lost[:, None], np.array((0, 0, 1), np.float32), normals)
    if not len(face):
        return index, faces, normals
    a, b, c = (np.asarray(positions, np.float64)[faces[face, k]] for k in range(3))
    own = unit(np.cross(b - a, c - a))
    own[~np.any(own, axis=1)] = (0.0, 0.0, 1.0)
    split = faces.astype(np.int32)
    split[face, corner] = len(positions) + np.arange(len(face))
    return (
        np.concatenate([index, faces[face, corner]]),
        split,
        np.concatenate([normals, own]).astype(np.float32),
    )


def edge_basis(normals: NDArray, edges: NDArray) -> tuple[NDArray, NDArray]:
    """Unit vectors x, y (N, 3), perpendicular to unit ``normals`` as z: x along the projection of
    ``edges`` (N, 3)."""
    z = np.asarray(normals, np.float64)
    x = unit(edges - z * np.sum(z * edges, axis=1, keepdims=True))
    return x, np.cross(z, x)


def unit(v: NDArray) -> NDArray:
    """v / |v|; zero where v is zero."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.divide(v, length, out=np.zeros_like(v), where=length > 0)


def corner_angle(a: NDArray, b: NDArray) -> NDArray:
    """Angle between vectors (N, 3), accurate for small and large ones; 0 if one is zero."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))


def accumulate(total: NDArray, index: NDArray, values: NDArray) -> None:
    """total[index] += values, rows that repeat included (bincount is far faster than
    ``np.add.at``)."""
    for c in range(values.shape[1]):
        total[:, c] += np.bincount(index, values[:, c], len(total))
