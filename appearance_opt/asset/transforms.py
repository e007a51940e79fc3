"""Affine transforms of nodes and joints in double precision: translation * rotation * scale, and
what interpolates them (column vectors; quaternions are (x, y, z, w))."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

PARALLEL = 1 - 1e-12
"""Cosine of the angle between quaternions from which on a great arc is a straight line in double
precision."""


def compose(translation: NDArray, rotation: NDArray, scale: NDArray) -> NDArray[np.float64]:
    """(..., 4, 4) translation (..., 3) * rotation, unit quaternion (..., 4), * scale (..., 3), the
    leading axes of which are broadcast."""
    given = (translation, rotation, scale)
    shape = np.broadcast_shapes(*(np.shape(v)[:-1] for v in given))
    turned = np.broadcast_to(np.asarray(rotation, np.float64), (*shape, 4))
    x, y, z, w = np.moveaxis(turned, -1, 0)
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    out = np.zeros((*shape, 4, 4))
    out[..., :3, :3] = (
        np.moveaxis(turn, (0, 1), (-2, -1)) * np.asarray(scale, np.float64)[..., None, :]
    )
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1.0
    return out


def decompose(
    matrices: NDArray,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """(translations (N, 3), rotations (N, 4), scales (N, 3), (N,) is that the whole matrix?) of (N,
    4, 4). Reflections have a negative first scale. Where shear is left out, the rotation is that of
    the orthonormalised columns."""
    m = np.asarray(matrices, np.float64).reshape(-1, 4, 4)
    linear = m[:, :3, :3].copy()
    scale = np.linalg.norm(linear, axis=1)
    scale[np.linalg.det(linear) < 0, 0] *= -1
    with np.errstate(all="ignore"):
        columns = linear / scale[:, None, :]
    columns = np.where(np.isfinite(columns), columns, 0.0)
    turn = np.stack([_nearest_rotation(c) for c in columns]) if len(m) else columns
    rotation = _quaternions(turn)
    rebuilt = compose(m[:, :3, 3], rotation, scale)
    size = np.abs(m[:, :3, :3]).max(axis=(1, 2), initial=1e-30)
    exact = np.abs(rebuilt - m)[:, :3, :3].max(axis=(1, 2)) <= 1e-6 * size
    return m[:, :3, 3].copy(), rotation, scale, exact


def _nearest_rotation(columns: NDArray) -> NDArray:
    u, _, v = np.linalg.svd(columns)
    if np.linalg.det(u @ v) < 0:
        u[:, 2] *= -1
    return u @ v


def _quaternions(r: NDArray) -> NDArray[np.float64]:
    """(N, 4) of rotations (N, 3, 3): the eigenvector of the largest eigenvalue of a symmetric
    matrix (Bar-Itzhack 2000), which is stable for every angle."""
    k = np.zeros((len(r), 4, 4))
    for row in range(3):
        for column in range(3):
            k[:, row, column] = r[:, row, column] + r[:, column, row]
    trace = np.trace(r, axis1=1, axis2=2) if len(r) else np.zeros(0)
    for axis in range(3):
        k[:, axis, axis] -= trace
    k[:, 3, 3] = trace
    for axis, (a, b) in enumerate(((2, 1), (0, 2), (1, 0))):
        k[:, axis, 3] = k[:, 3, axis] = r[:, a, b] - r[:, b, a]
    q = np.linalg.eigh(k)[1][:, :, -1] if len(r) else np.zeros((0, 4))
    return q * np.where(q[:, 3:] < 0, -1.0, 1.0)


def slerp(a: NDArray, b: NDArray, t: NDArray) -> NDArray[np.float64]:
    """(N, 4) unit quaternions a share ``t`` (N,) of the shorter great arc from a to b (N, 4) on
    (Shoemake 1985)."""
    cosine = np.sum(a * b, axis=-1)
    b = np.where(cosine[:, None] < 0, -b, b)
    cosine = np.abs(cosine)
    angle = np.arccos(np.minimum(cosine, 1.0))
    near = cosine > PARALLEL
    sine = np.where(near, 1.0, np.sin(angle))
    first = np.where(near, 1 - t, np.sin((1 - t) * angle) / sine)
    second = np.where(near, t, np.sin(t * angle) / sine)
    return normalized(first[:, None] * a + second[:, None] * b)


def normalized(q: NDArray) -> NDArray[np.float64]:
    """Quaternions (..., 4) of length one; those of length zero turn nothing."""
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    turned = q / np.where(length > 1e-30, length, 1.0)
    return np.where(length > 1e-30, turned, np.array([0.0, 0.0, 0.0, 1.0]))
