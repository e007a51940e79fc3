"""Mip pyramids of textures that no one fits: made on the host, band by band."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.render.math import LARGEST_HALF
from appearance_opt.render.texture import Pyramid, pyramid_layout

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

BAND_BYTES = 1 << 26
"""Bytes of a base level in single precision that ``build_pyramid`` holds at once."""


@dataclass(frozen=True)
class Base:
    """The base level of one material, made row by row: ``rows(start, stop)`` are its texels (stop -
    start, width, channels), float32 linear."""

    width: int
    height: int
    channels: int
    rows: Callable[[int, int], NDArray[np.float32]]

    @classmethod
    def of(cls, texels: NDArray[np.float32]) -> Base:
        """Make it of texels (H, W, channels) that are there."""
        return cls(
            texels.shape[1],
            texels.shape[0],
            texels.shape[2],
            lambda start, stop: texels[start:stop],
        )


def build_pyramid(
    bases: Sequence[Base],
    wraps: Sequence[int],
    max_levels: int = 16,
    kind: type[np.floating] = np.float32,
) -> Pyramid:
    """Build the pyramid of the textures of several materials, made on the host: of what no one
    fits. ``kind``: float32, or float16 (11 bits) for half the memory, which is what lookups wait
    for; base levels are never held in single precision then, which for a map of 8192^2 texels would
    take two gigabytes."""
    channels = bases[0].channels
    layout = pyramid_layout([(b.width, b.height) for b in bases], channels, wraps, max_levels)
    flat = np.empty((layout.texel_count, channels), kind)
    for base, offsets in zip(bases, layout.offsets, strict=True):
        level = _write_base(flat, base, offsets[0])
        for before, after in zip(offsets, offsets[1:], strict=False):
            if after == before:
                break
            _write(flat, after, level)
            level = _downsample(level)
    array = mi.Float16 if kind is np.float16 else mi.Float
    borrowed = array(flat.ravel())
    # memory of Dr.Jit's own, see ``backend.to_device``
    texels = dr.gather(array, borrowed, dr.arange(mi.UInt32, dr.width(borrowed)))
    dr.eval(texels)
    return Pyramid.of(layout, texels)


def _write_base(flat: NDArray, base: Base, offset: int) -> NDArray[np.float32]:
    """Write the base level to where it starts; the level after it, in single precision."""
    if base.width * base.height == 1:
        _write(flat, offset, base.rows(0, 1))
        return np.empty((0, 0, base.channels), np.float32)
    after = np.empty(((base.height + 1) // 2, (base.width + 1) // 2, base.channels), np.float32)
    step = max(2, BAND_BYTES // (base.width * base.channels * 4) // 2 * 2)  # pairs of rows
    for start in range(0, base.height, step):
        stop = min(start + step, base.height)
        rows = base.rows(start, stop)
        _write(flat, offset + start * base.width, rows)
        after[start // 2 : (stop + 1) // 2] = _downsample(rows)
    return after


def _downsample(texels: NDArray[np.float32]) -> NDArray[np.float32]:
    """The mean of 2 x 2 texels of (H, W, C); edges clamp. See ``texture.downsample``."""
    height, width = texels.shape[:2]
    texels = np.pad(texels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    return (
        texels[::2, ::2] + texels[::2, 1::2] + texels[1::2, ::2] + texels[1::2, 1::2]
    ) * np.float32(0.25)


def _write(flat: NDArray, offset: int, texels: NDArray[np.float32]) -> None:
    """Rows (H, W, C) of texels to where they start in the flat buffer."""
    count = texels.shape[0] * texels.shape[1]
    if flat.dtype == np.float16:
        texels = np.clip(texels, -LARGEST_HALF, LARGEST_HALF)
    flat[offset : offset + count] = texels.reshape(count, -1)
