"""A first, coarse round for meshes far finer than what is asked for: vertices in one cell of a grid
become one.

After Lindstrom 2000, *Out-of-core simplification of large polygonal models*: each cell's vertex is
placed where the quadrics of the faces around its vertices are least. It takes one pass over the
mesh, a tenth of the time of rounds of edge collapses, and keeps neither topology nor thin gaps
below a cell. What is left is decimated as usual.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.normals import unit
from appearance_opt.initial import quadrics

VERTICES_PER_CELL = 1.5
"""Cells that a surface of as many cell sides squared passes through, about: it crosses them at any
angle."""

PULL = 1e-2
"""How strongly vertices are drawn to the mean of their cell where quadrics are nearly flat."""


def cluster(
    positions: NDArray, faces: NDArray, vertices: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """About ``vertices`` vertices at the most for a mesh of more; coarser parts stay as they are.

    ``positions`` (V, 3), ``faces`` (F, 3): any triangle soup. Returns positions, faces, and for
    each of these the first of the given faces that it comes from. Faces over the same corners are
    one, if they turn the same way.
    """
    p = np.asarray(positions, np.float64)
    corners = [p[faces[:, k]] for k in range(3)]
    cross = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    low = p.min(axis=0)
    side = max(
        (VERTICES_PER_CELL * area.sum() / vertices) ** 0.5,
        float(np.ptp(p, axis=0).max()) / (1 << 20),
        1e-300,
    )
    cell = np.floor((p - low) / side).astype(np.int64)
    key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
    keys, place = np.unique(key, return_inverse=True)
    place, count = place.ravel(), len(keys)
    new = place[faces]
    summed = np.stack([np.bincount(place, p[:, k], count) for k in range(3)], axis=1)
    mean = summed / np.bincount(place, minlength=count)[:, None]
    # in units of a cell around its mean, where rounding does not matter
    total = np.zeros((count, quadrics.SIZE))
    normal = unit(cross)
    for k in range(3):
        q = quadrics.of_planes(normal, (corners[k] - mean[new[:, k]]) / side, area)
        for column in range(quadrics.SIZE):
            total[:, column] += np.bincount(new[:, k], q[:, column], count)
    best = quadrics.minimize(total, np.zeros((count, 3)), PULL)
    out = mean + side * np.clip(best, -1, 1)
    kept = np.flatnonzero(
        (new[:, 0] != new[:, 1]) & (new[:, 1] != new[:, 2]) & (new[:, 2] != new[:, 0])
    )
    kept = kept[_first_of_each(new[kept], count)]
    used, compact = np.unique(new[kept], return_inverse=True)
    return out[used], compact.reshape(-1, 3), kept


def _first_of_each(faces: NDArray, count: int) -> NDArray[np.int64]:
    """Indices of faces (F, 3), the first of those with the same corners in the same sense, in
    order."""
    turn = np.argmin(faces, axis=1)[:, None]
    a, b, c = np.take_along_axis(faces, (turn + np.arange(3)) % 3, axis=1).T
    pair = a * count + b
    _, pair = np.unique(pair, return_inverse=True)
    return np.sort(np.unique(pair.ravel() * count + c, return_index=True)[1])
