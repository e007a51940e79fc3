"""Drawn patterns: signed distances to strokes and shapes in one repeat, sampled at any
resolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Stencil:
    """``distance``: (h, w) float32, signed distances (negative inside) in widths of the repeat,
    over x in [0, 1) (periodic) and y in [0, 1] (row 0 at y = 0)."""

    distance: NDArray[np.float32]

    def sample(self, u: NDArray, t: NDArray, repeats: int) -> NDArray[np.float32]:
        """Bilinear lookup at (len(t), len(u)) points; u covers ``repeats`` repeats."""
        height, width = self.distance.shape
        x = (u * repeats) % 1.0 * width - 0.5
        y = np.clip(t * height - 0.5, 0.0, height - 1.0)
        column, row = (
            np.floor(x).astype(np.intp),
            np.minimum(np.floor(y).astype(np.intp), height - 2),
        )
        fx, fy = (x - column).astype(np.float32), (y - row).astype(np.float32)[:, None]
        lines = self.distance[row] * (1 - fy) + self.distance[row + 1] * fy
        return lines[:, column % width] * (1 - fx) + lines[:, (column + 1) % width] * fx


def repeat_grid(width: int, aspect: float) -> tuple[NDArray, NDArray]:
    """Pixel centres (x, y), each (h, w), of one repeat: x in [-0.5, 0.5], y in [-aspect/2,
    aspect/2]; ``aspect`` is height over width."""
    height = max(2, round(width * aspect))
    x = (np.arange(width) + 0.5) / width - 0.5
    y = ((np.arange(height) + 0.5) / height - 0.5) * aspect
    return np.broadcast_to(x, (height, width)), np.broadcast_to(y[:, None], (height, width))


def stroke_distance(
    x: NDArray, y: NDArray, curves: list[NDArray], widths: list[NDArray]
) -> NDArray[np.float32]:
    """Distance to thick curves: min over points of |p - point| - half width. The curves, (N, 2)
    dense points with (N,) half widths, are repeated to the left and to the right."""
    from scipy.spatial import cKDTree

    points, radius = np.concatenate(curves), np.concatenate(widths)
    points = np.concatenate([points + (shift, 0.0) for shift in (-1.0, 0.0, 1.0)])
    distance, index = cKDTree(points).query(np.stack([x.ravel(), y.ravel()], axis=1))
    return (distance - np.tile(radius, 3)[index]).reshape(x.shape).astype(np.float32)


def polyline(corners: list[tuple[float, float]], step: float = 0.002) -> NDArray:
    """Points (N, 2) every ``step`` along straight pieces."""
    p = np.asarray(corners, np.float64)
    pieces = [
        a + (b - a) * np.linspace(0, 1, max(2, int(np.ceil(np.linalg.norm(b - a) / step))))[:, None]
        for a, b in zip(p[:-1], p[1:], strict=True)
    ]
    return np.concatenate(pieces)


def spiral(
    centre: tuple[float, float], outer: float, turns: float, start: float, hand: int
) -> NDArray:
    """Points (N, 2) of a spiral that curls in from radius ``outer`` at angle ``start`` (radians),
    counter-clockwise for hand = 1. The radius shrinks as (1 - t)^1.25 to a tenth."""
    t = np.linspace(0.0, 1.0, 400)
    radius = outer * (0.1 + 0.9 * (1 - t) ** 1.25)
    angle = start + hand * 2 * np.pi * turns * t
    return np.stack(
        [centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)], axis=1
    )


def leaf(
    base: tuple[float, float], tip: tuple[float, float], width: float
) -> tuple[NDArray, NDArray]:
    """A teardrop as a stroke of varying half width: points (N, 2), half widths (N,)."""
    t = np.linspace(0.0, 1.0, 60)
    points = np.asarray(base) + t[:, None] * (np.asarray(tip) - np.asarray(base))
    return points, width * np.sin(np.pi * t**0.7) ** 0.8 + 1e-4


def ring(radius: NDArray, angle: NDArray, centre: tuple[float, float] = (0.0, 0.0)) -> NDArray:
    """Closed polar curve: points (N, 2)."""
    return np.stack(
        [centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)], axis=1
    )
