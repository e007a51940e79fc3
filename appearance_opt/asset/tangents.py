"""Tangent bases as MikkTSpace makes them (Mikkelsen 2008), vectorised."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.normals import accumulate, apart, corner_angle, unit


def split_and_tangents(
    positions: NDArray,
    normals: NDArray,
    uvs: NDArray,
    faces: NDArray,
    mesh_of: NDArray | None = None,
) -> tuple[NDArray[np.intp], NDArray[np.int32], NDArray[np.float32]]:
    """Tangents of a mesh with texture coordinates; or of several in common arrays, where
    ``mesh_of`` (V,) says which vertex belongs to which.

    Per face corner, the direction of growing u is projected on the plane of the vertex normal,
    normalised, weighted by the corner's angle in that plane and summed over the corners that share
    position, normal, UV and handedness. Vertices whose corners differ in handedness (a mirrored UV
    seam through them) are split.

    Returns (vertex_index (R,): input vertex of each output vertex; faces (F, 3); tangents (R, 4)).
    Faces without UV area inherit from their neighbours; a vertex with no usable face gets some unit
    tangent.
    """
    mirrored, usable, along_u = _per_face(positions, uvs, faces)
    vertex_index, new_faces = _split(faces, mirrored, len(positions))
    n = np.asarray(normals, np.float64)[vertex_index]
    own = None if mesh_of is None else mesh_of[vertex_index]
    group, groups = _groups(
        positions[vertex_index], normals[vertex_index], uvs[vertex_index], new_faces, mirrored, own
    )
    p = np.asarray(positions, np.float64)
    total = np.zeros((groups, 3))
    for k in range(3):
        normal = n[new_faces[:, k]]
        here, after, before = (p[faces[:, (k + j) % 3]] for j in range(3))
        angle = corner_angle(_in_plane(after - here, normal), _in_plane(before - here, normal))
        tangent = unit(_in_plane(along_u, normal)) * (angle * usable)[:, None]
        accumulate(total, group[new_faces[:, k]], tangent)
    tangents = unit(unit(total)[group])
    lost = ~np.any(tangents, axis=1)
    tangents[lost] = any_tangent(n[lost])
    sign = np.ones(len(vertex_index))
    # v grows downward: a mapping that is not mirrored has its bitangent against growing v
    sign[new_faces.ravel()] = np.repeat(np.where(mirrored, -1.0, 1.0), 3)
    return (
        vertex_index,
        new_faces,
        np.concatenate([tangents, sign[:, None]], axis=1).astype(np.float32),
    )


def any_tangent(normals: NDArray) -> NDArray:
    """Some unit vector (N, 3) perpendicular to each normal."""
    axis = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    return unit(np.cross(normals, axis))


def _per_face(positions: NDArray, uvs: NDArray, faces: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """(mirrored, has UV area, direction of growing u) of each face."""
    p, t = np.asarray(positions, np.float64)[faces], np.asarray(uvs, np.float64)[faces]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    d1, d2 = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    determinant = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    along_u = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) * np.sign(determinant)[:, None]
    return determinant > 0, np.abs(determinant) > 1e-20, along_u


def _split(
    faces: NDArray, mirrored: NDArray, count: int
) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Vertices duplicated where faces of both handednesses meet."""
    key = faces.astype(np.int64) * 2 + mirrored[:, None]
    used, new = np.unique(key, return_inverse=True)
    return (used // 2).astype(np.intp), new.reshape(faces.shape).astype(np.int32)


def _groups(
    positions: NDArray,
    normals: NDArray,
    uvs: NDArray,
    faces: NDArray,
    mirrored: NDArray,
    mesh_of: NDArray | None,
) -> tuple[NDArray[np.intp], int]:
    """Vertices of a mesh that are equal in all attributes and handedness share a tangent."""
    hand = np.zeros(len(positions), np.float32)
    hand[faces.ravel()] = np.repeat(mirrored, 3)
    rows = np.concatenate([positions, normals, uvs, hand[:, None]], axis=1).astype(np.float32) + 0.0
    rows = np.ascontiguousarray(apart(rows, mesh_of))
    keys = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
    unique, group = np.unique(keys, return_inverse=True)
    return group.ravel(), len(unique)


def _in_plane(v: NDArray, n: NDArray) -> NDArray:
    return v - n * np.sum(n * v, axis=1, keepdims=True)
