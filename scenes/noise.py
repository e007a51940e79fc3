"""Procedural noise on product grids: u runs around (periodic, [0, 1)), s along ([0, 1]).

All the scenes' sheets are grids of (len(s), len(u)) points, so that noise is separable in its
lattice weights: four gathers per axis, whatever the number of pixels. Seeds give the same numbers
everywhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BSPLINE_RMS = 151.0 / 315.0
"""RMS of cubic B-spline weights over a cell: brings interpolated white noise back to unit variance
(per axis, the mean of the sum of squared weights)."""


def lattice_noise(u: NDArray, s: NDArray, cells: tuple[int, int], seed: int) -> NDArray[np.float32]:
    """Gaussian lattice values under a cubic B-spline: (len(s), len(u)), mean 0, variance about 1.

    ``cells``: lattice cells around and along. Periodic in u (Perlin's lattice noise, with values in
    place of gradients; Lewis 1989)."""
    around, along = cells
    values = np.random.default_rng(seed).standard_normal((along + 3, around)).astype(np.float32)
    row, row_weights = _taps(s * along)
    column, column_weights = _taps(u * around)
    lines = sum(values[np.clip(row + k, 0, along + 2)] * row_weights[k][:, None] for k in range(4))
    out = sum(lines[:, (column + k) % around] * column_weights[k] for k in range(4))
    return (out / np.float32(_BSPLINE_RMS)).astype(np.float32)


def _taps(x: NDArray) -> tuple[NDArray[np.intp], list[NDArray[np.float32]]]:
    """First lattice index and the four uniform cubic B-spline weights at lattice coordinates x."""
    index = np.floor(x).astype(np.intp)
    f = (x - index).astype(np.float32)
    weights = [
        (1 - f) ** 3 / 6,
        (3 * f**3 - 6 * f**2 + 4) / 6,
        (-3 * f**3 + 3 * f**2 + 3 * f + 1) / 6,
        f**3 / 6,
    ]
    return index, weights


def fractal_noise(
    u: NDArray, s: NDArray, cells: tuple[int, int], octaves: int, seed: int, gain: float = 0.5
) -> NDArray[np.float32]:
    """Sum of ``octaves`` lattice noises, each twice as fine and ``gain`` times as strong: variance
    1."""
    total = np.zeros((len(s), len(u)), np.float32)
    amplitude, energy = 1.0, 0.0
    for k in range(octaves):
        total += np.float32(amplitude) * lattice_noise(
            u, s, (cells[0] << k, cells[1] << k), seed + k
        )
        energy += amplitude**2
        amplitude *= gain
    return total / np.float32(np.sqrt(energy))


def cellular_noise(
    u: NDArray, s: NDArray, cells: tuple[int, int], seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Distances to the nearest and to the second nearest point of a jittered grid, in cells
    (Worley 1996): two (len(s), len(u)) arrays. Periodic in u."""
    around, along = cells
    jitter = np.random.default_rng(seed).random((2, along + 2, around)).astype(np.float32)
    x, y = (u * around).astype(np.float32), (s * along).astype(np.float32)
    column, row = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    nearest = np.full((len(s), len(u)), np.inf, np.float32)
    second = nearest.copy()
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            r, c = np.clip(row + dy + 1, 0, along + 1)[:, None], ((column + dx) % around)[None]
            px = jitter[0][r, c] + (column + dx - x).astype(np.float32)[None]
            py = jitter[1][r, c] + (row + dy - y).astype(np.float32)[:, None]
            d = px * px + py * py
            second = np.minimum(second, np.maximum(nearest, d))
            nearest = np.minimum(nearest, d)
    return np.sqrt(nearest), np.sqrt(second)


def smoothstep(low: float, high: float, x: NDArray) -> NDArray:
    """0 below ``low``, 1 above ``high`` (or the reverse where high < low), cubic between."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)
