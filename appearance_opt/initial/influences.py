"""Skinning weights of a light mesh from those of a heavy one: at the closest point that faces the
same way.

The closest point alone may lie on another limb: an arm beside the torso, lips, fingers. What faces
another way is another part.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.influences import trim
from appearance_opt.asset.normals import unit
from appearance_opt.asset.rig import Skin

if TYPE_CHECKING:
    from numpy.typing import NDArray

CANDIDATES = 24
"""Triangles whose exact distance is looked at, by the distance of their middles; and again as many
around the nearest vertices."""

ALIKE = 0.3
"""Cosine between normals from which on surfaces face the same way."""

TURNED = 8.0
"""A point that faces another way counts as so many times farther away: it is taken only where
nothing else is near."""


def transfer_influences(
    positions: NDArray, normals: NDArray, heavy: NDArray, faces: NDArray, skin: Skin, bones: int
) -> Skin:
    """The influences of points (V, 3) with unit normals (V, 3) on a heavy mesh: ``heavy`` (N, 3)
    positions, ``faces`` (F, 3), its ``skin`` on so many ``bones``. All weights of the corners of
    the triangle are taken, by barycentric coordinates."""
    triangle, corners = closest_points(positions, normals, heavy, faces)
    weights = np.zeros((len(positions), bones), np.float32)
    rows = np.arange(len(positions))
    for k in range(3):
        vertex = faces[triangle, k]
        for place in range(skin.bones.shape[1]):
            share = corners[:, k] * skin.weights[vertex, place]
            np.add.at(weights, (rows, skin.bones[vertex, place]), share)
    most = max(int((weights > 0).sum(axis=1).max(initial=1)), 1)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :most]
    kept = np.take_along_axis(weights, order, axis=1)
    kept /= np.maximum(kept.sum(axis=1, keepdims=True), 1e-30)
    return trim(Skin(order.astype(np.int32), kept))


def closest_points(
    positions: NDArray, normals: NDArray, heavy: NDArray, faces: NDArray
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(triangle (V,), barycentric coordinates (V, 3)) of the closest point that faces the way of
    the ``normals``."""
    from scipy.spatial import cKDTree

    heavy = np.asarray(heavy, np.float64)
    points = np.asarray(positions, np.float64)
    near = _candidates(points, heavy, faces, cKDTree)
    corners = heavy[faces]
    facing = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    best = np.full(len(points), np.inf)
    triangle = np.zeros(len(points), np.int64)
    coordinates = np.tile([1.0, 0.0, 0.0], (len(points), 1))
    for column in near.T:
        at, where = _closest_on_triangles(points, corners[column])
        distance = np.sum((at - points) ** 2, axis=1)
        alike = np.sum(facing[column] * normals, axis=1) >= ALIKE
        distance = np.where(alike, distance, distance * TURNED**2 + 1e-18)
        nearer = distance < best
        best[nearer], triangle[nearer] = distance[nearer], column[nearer]
        coordinates[nearer] = where[nearer]
    return triangle, coordinates


def _candidates(points: NDArray, heavy: NDArray, faces: NDArray, tree: type) -> NDArray[np.int64]:
    """(V, C) triangles near each point: by their middles, and around the nearest vertices."""
    count = min(CANDIDATES, len(faces))
    _, by_middle = tree(heavy[faces].mean(axis=1)).query(points, k=count)
    by_middle = np.asarray(by_middle).reshape(len(points), count)
    used = np.unique(faces)
    _, nearest = tree(heavy[used]).query(points, k=min(CANDIDATES // 6, len(used)))
    nearest = used[np.asarray(nearest).reshape(len(points), -1)]
    order = np.argsort(faces.ravel(), kind="stable")
    sorted_corner = faces.ravel()[order]
    first = np.searchsorted(sorted_corner, nearest)
    around = []
    for step in range(6):  # a vertex has about six triangles
        at = np.minimum(first + step, len(order) - 1)
        same = sorted_corner[at] == nearest
        around.append(np.where(same, order[at] // 3, order[np.minimum(first, len(order) - 1)] // 3))
    return np.concatenate([by_middle, *around], axis=1)


def _closest_on_triangles(p: NDArray, corners: NDArray) -> tuple[NDArray, NDArray]:
    """(points (N, 3), barycentric coordinates (N, 3)) of triangles (N, 3, 3) closest to points (N,
    3): the projection where it lies inside, else the nearest of the three edges."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    u, v, w = b - a, c - a, p - a
    uu, uv, vv = (np.sum(x * y, axis=1) for x, y in ((u, u), (u, v), (v, v)))
    wu, wv = np.sum(w * u, axis=1), np.sum(w * v, axis=1)
    area = uu * vv - uv * uv
    safe = np.where(area > 0, area, 1.0)
    s, t = (vv * wu - uv * wv) / safe, (uu * wv - uv * wu) / safe
    inside = (area > 0) & (s >= 0) & (t >= 0) & (s + t <= 1)
    best = np.stack([1 - s - t, s, t], axis=1)
    least = np.where(inside, np.sum((w - s[:, None] * u - t[:, None] * v) ** 2, axis=1), np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        start, along = corners[:, i], corners[:, j] - corners[:, i]
        length = np.sum(along * along, axis=1)
        share = np.sum((p - start) * along, axis=1) / np.where(length > 0, length, 1.0)
        share = np.clip(share, 0.0, 1.0)
        distance = np.sum((start + share[:, None] * along - p) ** 2, axis=1)
        here = np.zeros_like(best)
        here[:, i], here[:, j] = 1 - share, share
        nearer = distance < least
        best[nearer], least[nearer] = here[nearer], distance[nearer]
    return np.einsum("nk,nkc->nc", best, corners), best
