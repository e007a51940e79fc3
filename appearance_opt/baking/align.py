"""Translation and uniform scale that bring one asset onto another."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.normals import unit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset

POINTS, DENSE = 4_000, 80_000
"""Points on the still and on the moving surface."""

ITERATIONS = 30
KEPT = 0.8
"""Share of the pairs, nearest first, that count: what only one of the two has pulls at nothing."""


def align(moving: Asset, still: Asset) -> tuple[Asset, float, NDArray[np.float64]]:
    """(the moving asset in its new place, scale, translation): x -> scale * x + translation.

    Starts from the bounding boxes; then iterated closest points with point-to-plane distances (Chen
    and Medioni 1991), trimmed (Chetverikov et al. 2002). Rotation is never changed.
    """
    from scipy.spatial import cKDTree

    origin = np.array(still.origin)
    moving_origin = np.array(moving.origin) - origin
    # near the still one, where numbers are small
    (a0, a1), (b0, b1) = (np.array(asset.bounds()) - origin for asset in (moving, still))
    scale = float(np.linalg.norm(b1 - b0)) / max(float(np.linalg.norm(a1 - a0)), 1e-300)
    shift = (b0 + b1) / 2 - scale * (a0 + a1) / 2
    size = float(np.linalg.norm(b1 - b0))
    target, _ = _surface_points(still, POINTS, 1)
    source, normals = _surface_points(moving, DENSE, 2)
    source = source + moving_origin
    tree = cKDTree(source)
    for _ in range(ITERATIONS):
        distance, nearest = tree.query((target - shift) / scale)
        keep = np.argsort(distance)[: int(KEPT * len(target))]
        q, n, x = source[nearest[keep]], normals[nearest[keep]], target[keep]
        # growth about the middle of the points, and a shift, in units of the object's size
        middle = q.mean(axis=0)
        matrix = np.concatenate(
            [np.sum(n * (q - middle), axis=1, keepdims=True) * scale / size, n], axis=1
        )
        residual = np.sum(n * (x - scale * q - shift), axis=1) / size
        step = np.linalg.lstsq(matrix, residual, rcond=1e-6)[0]
        growth = float(np.clip(step[0], -0.2, 0.2))
        shift = shift + step[1:] * size - scale * growth * middle
        scale *= 1 + growth
        if np.abs(step).max() < 1e-9:
            break
    points = [
        (m.positions.astype(np.float64) + moving_origin) * scale + shift for m in moving.meshes
    ]
    placed = [p.astype(np.float32) for p in points]
    meshes = tuple(replace(m, positions=p) for m, p in zip(moving.meshes, placed, strict=True))
    return replace(moving, meshes=meshes, origin=still.origin), scale, shift + (1 - scale) * origin


def _surface_points(
    asset: Asset, count: int, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(count, 3) points spread evenly over the surface, and the normals of their triangles."""
    p = np.concatenate([m.positions[m.faces] for m in asset.meshes]).astype(np.float64)
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    area = np.linalg.norm(cross, axis=1)
    rng = np.random.default_rng(seed)
    at = (np.arange(count) + rng.random(count)) / count * area.sum()
    face = np.minimum(np.searchsorted(np.cumsum(area), at), len(p) - 1)
    u, v = rng.random((2, count))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u)[:, None], np.where(over, 1 - v, v)[:, None]
    a, b, c = (p[face, k] for k in range(3))
    return a + u * (b - a) + v * (c - a), unit(cross[face])
