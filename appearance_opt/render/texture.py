"""Mip-mapped texture lookups from one flat buffer of packed texels.

All maps of a material live in one texel of ``channels`` floats (a power of two), so that a corner
of the bilinear footprint is one packet load. Several materials, and all their mip levels, share one
buffer; a small table says where each level starts and how large it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.render.math import at_least, at_most

if TYPE_CHECKING:
    from collections.abc import Sequence


REPEAT, CLAMP, MIRROR = 0, 1, 2


class PyramidLayout:
    """Where each mip level of each material starts.

    ``sizes[m][k]`` is the (width, height) of level k of material m in texels, ``offsets[m][k]`` its
    first texel in the flat buffer. Every material lists the same number of levels (small ones
    repeat their last), so that (material, level) is one index into the table. A plain class, told
    apart by its hash: Dr.Jit visits every number in a data class whenever a recorded function is
    called.
    """

    def __init__(
        self,
        channels: int,
        sizes: tuple[tuple[tuple[int, int], ...], ...],
        offsets: tuple[tuple[int, ...], ...],
        wraps: tuple[int, ...],
    ) -> None:
        self.channels, self.sizes, self.offsets, self.wraps = channels, sizes, offsets, wraps
        self._key = channels, sizes, offsets, wraps
        self._hash = hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PyramidLayout) and self._key == other._key

    def __hash__(self) -> int:
        return self._hash

    @property
    def texel_count(self) -> int:
        """Texels of all levels of all materials."""
        (width, height), last = self.sizes[-1][-1], self.offsets[-1][-1]
        return last + width * height

    @property
    def levels(self) -> int:
        return len(self.sizes[0])

    @property
    def uniform_wrap(self) -> int | None:
        """The wrap mode that all materials share, or None."""
        return self.wraps[0] if len(set(self.wraps)) == 1 else None


def pyramid_layout(
    sizes: Sequence[tuple[int, int]], channels: int, wraps: Sequence[int], max_levels: int = 16
) -> PyramidLayout:
    """Lay out levels for materials whose base levels have the given (width, height). A level is
    half its parent, rounded up, down to 1 x 1 or ``max_levels`` levels."""
    chains = []
    for width, height in sizes:
        chain = [(width, height)]
        while chain[-1] != (1, 1) and len(chain) < max_levels:
            w, h = chain[-1]
            chain.append(((w + 1) // 2, (h + 1) // 2))
        chains.append(chain)
    levels = max(len(c) for c in chains)
    offsets, start = [], 0
    for chain in chains:
        own = []
        for w, h in chain:
            own.append(start)
            start += w * h
        offsets.append(tuple(own + [own[-1]] * (levels - len(own))))
    padded = [tuple(c + [c[-1]] * (levels - len(c))) for c in chains]
    return PyramidLayout(channels, tuple(padded), tuple(offsets), tuple(wraps))


@dataclass(frozen=True)
class Pyramid:
    """Texels on the device, with their layout. ``texels`` may carry gradients if they are in single
    precision; the rest never does. ``table`` (4 per material and level): offset, width, height,
    wrap mode."""

    layout: PyramidLayout
    texels: mi.Float | mi.Float16
    table: mi.UInt32

    @classmethod
    def of(cls, layout: PyramidLayout, texels: mi.Float) -> Pyramid:
        """Make a pyramid with the table of its layout."""
        table = np.zeros((len(layout.sizes), layout.levels, 4), np.uint32)
        for m, (sizes, offsets, wrap) in enumerate(
            zip(layout.sizes, layout.offsets, layout.wraps, strict=True)
        ):
            for k, ((w, h), offset) in enumerate(zip(sizes, offsets, strict=True)):
                table[m, k] = offset, w, h, wrap
        return cls(layout, texels, mi.UInt32(table.ravel()))

    def with_texels(self, texels: mi.Float) -> Pyramid:
        """Return the same layout around other texels (no copy of the table)."""
        return replace(self, texels=texels)

    def lookup(self, material: mi.UInt32 | None, uv: mi.Point2f, footprint: mi.Float) -> list:
        """Look up trilinearly.

        ``material``: index per sample, or None when there is only one. ``footprint``: area that a
        sample covers in UV space (a fraction of the unit square); it selects the level at which one
        texel covers that area. Differentiable in the texels and in ``uv``, not in ``footprint``.
        Returns ``channels`` arrays.
        """
        levels = self.layout.levels
        base = mi.UInt32(0) if material is None else material * levels
        if levels == 1:
            return self._bilinear(base, uv)
        width, height = self._level_size(base)
        area = at_least(dr.detach(footprint) * width * height, 1.0)
        lod = at_most(0.5 * dr.log2(area), levels - 1.001)
        lower = mi.UInt32(lod)
        fraction = lod - mi.Float(lower)
        fine = self._bilinear(base + lower, uv)
        # no reading, and no gradient to write, where the finest level is enough: half of a point
        # sample's lookups
        coarse = self._bilinear(base + lower + 1, uv, fraction > 0)
        return [dr.fma(fraction, b - a, a) for a, b in zip(fine, coarse, strict=True)]

    def _level_size(self, entry: mi.UInt32) -> tuple[mi.Float, mi.Float]:
        if len(self.layout.sizes) == 1:  # a single material: its size is a constant of the job
            w, h = self.layout.sizes[0][0]
            return mi.Float(w), mi.Float(h)
        row = dr.gather(mi.ArrayXu, self.table, entry, shape=(4, dr.width(entry)))
        return mi.Float(row[1]), mi.Float(row[2])

    def _bilinear(self, entry: mi.UInt32, uv: mi.Point2f, active: mi.Bool | bool = True) -> list:
        row = dr.gather(
            mi.ArrayXu, self.table, entry, shape=(4, max(dr.width(entry), dr.width(uv)))
        )
        offset, width, height = row[0], row[1], row[2]
        x = dr.fma(uv.x, mi.Float(width), -0.5)
        y = dr.fma(uv.y, mi.Float(height), -0.5)
        x0, y0 = dr.floor(dr.detach(x)), dr.floor(dr.detach(y))
        fx, fy = x - x0, y - y0
        ix0, iy0 = mi.Int32(x0), mi.Int32(y0)
        w, h = mi.Int32(width), mi.Int32(height)
        mode = self.layout.uniform_wrap
        wrap = mi.Int32(row[3]) if mode is None else mode
        left, right = _wrap(ix0, w, wrap), _wrap(ix0 + 1, w, wrap)
        top, bottom = mi.UInt32(_wrap(iy0, h, wrap) * w), mi.UInt32(_wrap(iy0 + 1, h, wrap) * w)
        left, right = mi.UInt32(left) + offset, mi.UInt32(right) + offset
        tl, tr = self._texel(top + left, active), self._texel(top + right, active)
        bl, br = self._texel(bottom + left, active), self._texel(bottom + right, active)
        out = []
        for a, b, c, d in zip(tl, tr, bl, br, strict=True):
            upper, lower = dr.fma(fx, b - a, a), dr.fma(fx, d - c, c)
            out.append(dr.fma(fy, lower - upper, upper))
        return out

    def _texel(self, index: mi.UInt32, active: mi.Bool | bool) -> mi.ArrayXf:
        shape = (self.layout.channels, dr.width(index))
        if isinstance(self.texels, mi.Float16):
            return mi.ArrayXf(dr.gather(mi.ArrayXf16, self.texels, index, active, shape=shape))
        # Expand: one private copy of the gradient per thread (docs/trials.md: kernels)
        return dr.gather(
            mi.ArrayXf, self.texels, index, active, mode=dr.ReduceMode.Expand, shape=shape
        )


def _wrap(i: mi.Int32, size: mi.Int32, mode: int | mi.Int32) -> mi.Int32:
    """Texel coordinate i brought into [0, size). ``mode`` is a constant when all materials share
    it."""
    if isinstance(mode, int):
        if mode == CLAMP:
            return dr.clip(i, 0, size - 1)
        if mode == REPEAT:
            return _modulo(i, size)
        period = _modulo(i, 2 * size)
        return dr.minimum(period, 2 * size - 1 - period)
    mirrored = _wrap(i, size, MIRROR)
    repeated = _wrap(i, size, REPEAT)
    return dr.select(
        mode == CLAMP, dr.clip(i, 0, size - 1), dr.select(mode == MIRROR, mirrored, repeated)
    )


def _modulo(i: mi.Int32, size: mi.Int32) -> mi.Int32:
    # floor(i / size) in floating point: integer division has no vector instruction on CPUs
    q = mi.Int32(dr.floor((mi.Float(i) + 0.5) / mi.Float(size)))
    # far from the origin q is rounded: the remainder must not leave the texture
    return dr.clip(i - q * size, 0, size - 1)


def downsample(texels: mi.Float, size: tuple[int, int], channels: int) -> mi.Float:
    """Make the next mip level of one (width, height) level: the mean of 2 x 2 texels (edges
    clamp)."""
    width, height = size
    half_w, half_h = (width + 1) // 2, (height + 1) // 2
    i = dr.arange(mi.UInt32, half_w * half_h)
    y, x = i // half_w, i % half_w
    x0, y0 = 2 * x, 2 * y
    x1, y1 = dr.minimum(x0 + 1, width - 1), dr.minimum(y0 + 1, height - 1)
    corners = [(yy, xx) for yy in (y0, y1) for xx in (x0, x1)]
    shape = (channels, half_w * half_h)
    total = sum(dr.gather(mi.ArrayXf, texels, yy * width + xx, shape=shape) for yy, xx in corners)
    out = dr.empty(mi.Float, half_w * half_h * channels)
    dr.scatter(out, total * 0.25, i, mode=dr.ReduceMode.Permute)
    return out
