"""Attributes of vertices as normalised integers (KHR_mesh_quantization; glTF 2.0, 3.6.2.2).

Errors are bounded: positions move by at most half a step of 1/65535 of the largest extent along
each axis, texture coordinates by half of 1/65535, colours by half of 1/65535 of their range of
[0, 1]; normals and tangents turn by less than 0.1 degrees (16 bits: less than 0.01).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

STEPS = 65535
"""Of an unsigned integer of 16 bits."""

NORMAL_BITS = 12
"""Of each coordinate of octahedral normals and tangents: less than 0.06 degrees."""


@dataclass(frozen=True)
class Grid:
    """Positions as integers: ``low + scale * integer / 65535``, with one ``scale`` for all axes, so
    that the node that undoes it leaves normals alone."""

    low: tuple[float, float, float]
    scale: float

    @classmethod
    def around(cls, positions: Sequence[NDArray]) -> Grid:
        """The grid of several meshes: vertices in one place stay in one place."""
        low = np.min([p.min(axis=0) for p in positions], axis=0).astype(np.float64)
        high = np.max([p.max(axis=0) for p in positions], axis=0).astype(np.float64)
        x, y, z = low.tolist()
        return cls((x, y, z), float((high - low).max()) or 1.0)

    def integers(self, positions: NDArray) -> NDArray[np.uint16]:
        """(V, 3)"""
        share = (positions.astype(np.float64) - self.low) / self.scale
        return np.round(np.clip(share, 0, 1) * STEPS).astype(np.uint16)


def normalized(values: NDArray) -> NDArray[np.uint16] | None:
    """Texture coordinates or colours (V, width) as integers; None if some lie outside of [0, 1]."""
    if values.size and (values.min() < 0 or values.max() > 1):
        return None
    return np.round(values.astype(np.float64) * STEPS).astype(np.uint16)
