"""Textures drawn anew: what their pixels are at other texture coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Texture, Wrap

MAX_TEXELS = 1 << 25
"""Texels of a resampled texture at most."""

BAND = 1 << 20
"""Texels resampled at once."""


@dataclass(frozen=True)
class Resampled:
    """Textures under one transform. ``uvs``: (V, 2) of each mesh; ``textures``: by field name;
    ``what``: what they now share, and what that costs; ``keeps_tangents``: do the meshes' tangents
    still fit the normal map?"""

    uvs: list[NDArray[np.float32]]
    textures: dict[str, Texture]
    what: str = "common texture coordinates"
    keeps_tangents: bool = True


def bilinear_grid(texture: Texture, u: NDArray, v: NDArray) -> NDArray:
    """Stored values (V, U, C) at all pairs of texture coordinates of an upright grid: what
    ``bilinear`` gives, at the price of copying texels where they are met at their middles."""
    height, width = texture.pixels.shape[:2]
    out: NDArray | None = None
    for row, down in _taps(v, height, texture.wrap[1]):
        for column, across in _taps(u, width, texture.wrap[0]):
            texels = texture.pixels[row[:, None], column]
            if (down == 1).all() and (across == 1).all():
                return texels
            part = texels * (down[:, None, None] * across[:, None])
            out = part if out is None else out + part
    assert out is not None
    return out


def _taps(
    at: NDArray, size: int, mode: Wrap
) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """(numbers of texels, their weights) along one axis: of both neighbours, or of one where none
    lies between."""
    # the rounding of a transform there and back must not mix neighbours
    at = np.round(at * size - 0.5, 6)
    corner = np.floor(at)
    fraction = at - corner
    first = corner.astype(np.int64)
    taps = [(_wrap(first, size, mode), 1 - fraction)]
    return taps + [(_wrap(first + 1, size, mode), fraction)] if fraction.any() else taps


def bilinear(texture: Texture, uv: NDArray) -> NDArray[np.float64]:
    """Stored values (N, C) at texture coordinates, wrapped as the texture says."""
    height, width = texture.pixels.shape[:2]
    # the rounding of a transform there and back must not mix neighbours
    at = np.round(uv * (width, height) - 0.5, 6)
    corner = np.floor(at)
    fraction = at - corner
    out = np.zeros((len(uv), texture.pixels.shape[2]))
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - fraction[:, 0]) * np.abs(1 - dy - fraction[:, 1])
            column = _wrap(corner[:, 0].astype(np.int64) + dx, width, texture.wrap[0])
            row = _wrap(corner[:, 1].astype(np.int64) + dy, height, texture.wrap[1])
            out += weight[:, None] * texture.pixels[row, column]
    return out


def _wrap(index: NDArray[np.int64], size: int, mode: Wrap) -> NDArray[np.int64]:
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "repeat":
        return index % size
    folded = index % (2 * size)
    return np.minimum(folded, 2 * size - 1 - folded)
