"""Quadric error metrics (Garland and Heckbert 1997), vectorised over many faces or edges.

A quadric is the polynomial x^T A x + 2 b^T x + c, stored as 10 numbers: A's upper triangle
(xx, xy, xz, yy, yz, zz), b (3), c. Quadrics of summed constraints add.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SIZE = 10
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def of_planes(normals: NDArray, points: NDArray, weights: NDArray) -> NDArray:
    """Weighted squared distance to planes with unit ``normals`` (N, 3) through ``points``: (N,
    10)."""
    offset = -np.sum(normals * points, axis=1)
    out = np.empty((len(normals), SIZE))
    for k, (i, j) in enumerate(_UPPER):
        out[:, k] = normals[:, i] * normals[:, j]
    out[:, 6:9] = normals * offset[:, None]
    out[:, 9] = offset**2
    return out * weights[:, None]


def of_points(points: NDArray, weights: NDArray) -> NDArray:
    """Weighted squared distance to points (N, 3): (N, 10)."""
    out = np.zeros((len(points), SIZE))
    out[:, (0, 3, 5)] = 1.0
    out[:, 6:9] = -points
    out[:, 9] = np.sum(points**2, axis=1)
    return out * weights[:, None]


def evaluate(q: NDArray, x: NDArray) -> NDArray:
    """Value of quadrics (N, 10) at points (N, 3); rounding below zero is cut off."""
    a = (
        q[:, 0] * x[:, 0] ** 2
        + q[:, 3] * x[:, 1] ** 2
        + q[:, 5] * x[:, 2] ** 2
        + 2
        * (q[:, 1] * x[:, 0] * x[:, 1] + q[:, 2] * x[:, 0] * x[:, 2] + q[:, 4] * x[:, 1] * x[:, 2])
    )
    return np.maximum(a + 2 * np.sum(q[:, 6:9] * x, axis=1) + q[:, 9], 0.0)


def minimize(q: NDArray, toward: NDArray, pull: float = 1e-3) -> NDArray:
    """Points (N, 3) of least value. Where a quadric leaves a direction free (flat or straight
    neighbourhoods) the point nearest to ``toward`` is taken: a pull of ``pull`` times A's trace."""
    weight = pull * (q[:, 0] + q[:, 3] + q[:, 5]) + 1e-300
    xx, xy, xz, yy, yz, zz = (
        q[:, 0] + weight,
        q[:, 1],
        q[:, 2],
        q[:, 3] + weight,
        q[:, 4],
        q[:, 5] + weight,
    )
    r = weight[:, None] * toward - q[:, 6:9]
    # Cramer's rule with the symmetric adjugate
    c00, c01, c02 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    c11, c12, c22 = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * c00 + xy * c01 + xz * c02
    ok = determinant > 0
    inverse = 1 / np.where(ok, determinant, 1)
    x = np.stack(
        [
            (c00 * r[:, 0] + c01 * r[:, 1] + c02 * r[:, 2]) * inverse,
            (c01 * r[:, 0] + c11 * r[:, 1] + c12 * r[:, 2]) * inverse,
            (c02 * r[:, 0] + c12 * r[:, 1] + c22 * r[:, 2]) * inverse,
        ],
        axis=1,
    )
    return np.where(ok[:, None] & np.isfinite(x), x, toward)
