"""Maps as packed texels: their encoding, the mip pyramid that the renderer reads, and the parts of
a latent that are made of them.

Colours are stored as the square root of linear values, so that a step of the optimiser means about
the same to the eye in dark and in light regions. Normals are stored with any length, and mean unit
ones, as in a file; mip levels are means of those. Everything else is stored as it is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.latent.parameter import Parameter
from appearance_opt.latent.parts import Part
from appearance_opt.render.material import CHANNELS, COLORS, MaterialMaps, TexelLayer
from appearance_opt.render.texture import CLAMP, Pyramid, downsample, pyramid_layout

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from appearance_opt.latent.parameter import Rates

TEXELS, FIXED_TEXELS = "texels", "fixed texels"
"""Names of the parts: the maps that are fitted, and those that are not."""

BOUNDS = {
    **dict.fromkeys(COLORS, (0.0, 1.0)),
    "roughness": (0.08, 1.0),
    "metalness": (0.0, 1.0),
    "normal_x": (-1.0, 1.0),
    "normal_y": (-1.0, 1.0),
    "normal_z": (0.05, 1.0),
    "displacement": (-1.0, 1.0),
    "opacity": (0.0, 1.0),
}
OPACITY = "opacity"
NORMALS = ("normal_x", "normal_y", "normal_z")
MAX_LEVELS = 7
"""Levels of a fitted pyramid: no view minifies an atlas by more than 2^6."""


class TexelCodec:
    """Shape and encoding of one packed, square, clamped texture of ``size`` texels (a power of
    two), in a pyramid of at most ``levels``."""

    def __init__(self, channels: tuple[str, ...], size: int, levels: int = MAX_LEVELS) -> None:
        self.channels = channels
        self.size = size
        self.packed = 1 << (len(channels) - 1).bit_length()
        self.layout = pyramid_layout([(size, size)], self.packed, [CLAMP], levels)
        self._template = Pyramid.of(self.layout, mi.Float(0))
        self._normal = (
            [channels.index(name) for name in NORMALS] if set(NORMALS) <= set(channels) else []
        )
        self._is_color = [c in COLORS for c in channels] + [False] * (self.packed - len(channels))

    def encode(self, maps: Mapping[str, NDArray | float]) -> mi.Float:
        """Stored values of maps in natural units: channel name -> (size, size), or a number for all
        texels."""
        out = np.zeros((self.size, self.size, self.packed), np.float32)
        for k, name in enumerate(self.channels):
            low, high = BOUNDS[name]
            value = np.clip(maps[name], low, high)
            out[..., k] = np.sqrt(value) if name in COLORS else value
        return mi.Float(out.ravel())

    def layer(self, stored: mi.Float) -> TexelLayer:
        """Pyramid of the stored values, ready for the renderer. Not differentiated: see
        ``pull_back``."""
        sizes, offsets = self.layout.sizes[0], self.layout.offsets[0]
        with dr.suspend_grad():
            texels = dr.empty(mi.Float, self.layout.texel_count * self.packed)
            if len(sizes) == 1:
                texels = _flat(list(self._decoded(self._rows(stored))))
            else:
                level = self._finest_levels(stored, texels)
            for size, offset in zip(sizes[1:], offsets[2:], strict=False):
                level = downsample(level, size, self.packed)
                place = dr.arange(mi.UInt32, dr.width(level)) + offset * self.packed
                dr.scatter(texels, level, place, mode=dr.ReduceMode.Permute)
            dr.eval(texels)
        return TexelLayer(self.channels, self._template.with_texels(texels))

    def _finest_levels(self, stored: mi.Float, texels: mi.Float) -> mi.Float:
        """Write the decoded values and their means over 2 x 2 into the pyramid ``texels``, and
        return those means: in one pass over the memory, which is what takes the time."""
        half = self.size // 2
        i = dr.arange(mi.UInt32, half * half)
        y = i // half
        first = 2 * (y * self.size + (i - y * half))
        corners = []
        for place in (first, first + 1, first + self.size, first + self.size + 1):
            rows = dr.gather(mi.ArrayXf, stored, place, shape=(self.packed, half * half))
            corners.append(self._decoded(rows))
            dr.scatter(texels, corners[-1], place, mode=dr.ReduceMode.Permute)
        mean = sum(corners) * 0.25
        dr.scatter(texels, mean, i + self.layout.offsets[0][1], mode=dr.ReduceMode.Permute)
        return _flat(list(mean))

    def pull_back(self, gradient: mi.Float, stored: mi.Float) -> mi.Float:
        """Gradient for the stored values from the gradient of all levels of the pyramid: each level
        hands a quarter of its gradient to its four children, then the encoding's chain rule."""
        sizes, offsets = self.layout.sizes[0], self.layout.offsets[0]
        total = None
        for (width, height), offset in reversed(list(zip(sizes, offsets, strict=True))):
            count = width * height
            i = dr.arange(mi.UInt32, count)
            own = dr.gather(mi.ArrayXf, gradient, i + offset, shape=(self.packed, count))
            if total is not None:
                y = i // width
                parent = (y // 2) * ((width + 1) // 2) + (i - y * width) // 2
                own += 0.25 * dr.gather(mi.ArrayXf, total, parent, shape=(self.packed, count))
            if width != self.size:
                total = _flat(list(own))
        texel = self._rows(stored)
        rows = [g * (2 * t) if c else g for g, t, c in zip(own, texel, self._is_color, strict=True)]
        if self._normal:
            n, g = (mi.Vector3f(*(v[k] for k in self._normal)) for v in (texel, rows))
            # the part along the normal does nothing; rounding would leave some, of which Adam makes
            # whole steps
            inverse = dr.rcp(dr.squared_norm(n))
            g = (g - n * (dr.dot(n, g) * inverse)) * dr.sqrt(inverse)
            for k, value in zip(self._normal, g, strict=True):
                rows[k] = value
        return _flat(rows)

    def to_maps(self, stored: mi.Float) -> dict[str, NDArray[np.float32]]:
        """Natural values on the host: channel name -> (size, size)."""
        texels = np.array(stored).reshape(self.size, self.size, self.packed)
        if self._normal:
            texels[..., self._normal] /= np.linalg.norm(
                texels[..., self._normal], axis=-1, keepdims=True
            )
        return {
            n: texels[..., k] ** 2 if n in COLORS else texels[..., k]
            for k, n in enumerate(self.channels)
        }

    def per_channel(self, values: Mapping[str, float]) -> mi.Float:
        """One number per packed channel (0 for padding)."""
        return mi.Float(
            [values[c] for c in self.channels] + [0.0] * (self.packed - len(self.channels))
        )

    def _decoded(self, rows: mi.ArrayXf) -> mi.ArrayXf:
        """Natural values of stored texels: linear colours, unit normals."""
        out = [dr.square(t) if c else t for t, c in zip(rows, self._is_color, strict=True)]
        if self._normal:
            n = mi.Vector3f(*(rows[k] for k in self._normal))
            for k, value in zip(self._normal, n * dr.rsqrt(dr.squared_norm(n)), strict=True):
                out[k] = value
        return mi.ArrayXf(out)

    def _rows(self, stored: mi.Float) -> mi.ArrayXf:
        n = self.size * self.size
        return dr.gather(mi.ArrayXf, stored, dr.arange(mi.UInt32, n), shape=(self.packed, n))


def _flat(rows: list[mi.Float]) -> mi.Float:
    """Interleave channels into packets."""
    n = dr.width(rows[0])
    out = dr.empty(mi.Float, n * len(rows))
    dr.scatter(out, mi.ArrayXf(rows), dr.arange(mi.UInt32, n), mode=dr.ReduceMode.Permute)
    return out


def maps_of(values: Mapping[str, NDArray | float]) -> MaterialMaps:
    """Maps of one atlas for the renderer: of each channel an image (size, size), or a number, in
    natural units."""
    images = {n: np.asarray(values[n]) for n in CHANNELS if n in values and np.ndim(values[n])}
    codec = TexelCodec(tuple(images), len(next(iter(images.values()))))
    constants = {n: float(v) for n, v in values.items() if not np.ndim(v)}
    return MaterialMaps((codec.layer(codec.encode(images)),), constants)


class PackedMaps(Part):
    """Maps in one atlas, whose at most ``levels`` mip levels are means of its texels. ``images``:
    natural values, channel name -> (size, size)."""

    def __init__(
        self, name: str, images: Mapping[str, NDArray], fitted: bool, levels: int = MAX_LEVELS
    ) -> None:
        channels = tuple(images)
        self.codec = codec = TexelCodec(channels, len(images[channels[0]]), levels)
        stored = codec.encode(images)
        if not fitted:
            super().__init__(name, None, codec.layer(stored))
            return
        low, high = (codec.per_channel({n: BOUNDS[n][k] for n in channels}) for k in (0, 1))
        super().__init__(name, Parameter(name, stored, codec.packed, mi.Float(0), low, high))

    def decode(self, stored: mi.Float) -> TexelLayer:
        return self.codec.layer(stored)

    def track(self, decoded: TexelLayer) -> TexelLayer:
        texels = mi.Float(decoded.pyramid.texels)
        dr.enable_grad(texels)
        return decoded.with_texels(texels)

    def pull_back(self, tracked: TexelLayer, stored: mi.Float) -> mi.Float:
        return self.codec.pull_back(dr.grad(tracked.pyramid.texels), stored)

    def fixed(self) -> tuple:
        return (self.codec, self.constant)


class Texels(PackedMaps):
    """Maps of the material. Those that are fitted and those that are not are parts of their own:
    the latter have no gradient and no moments."""

    def __init__(
        self, images: Mapping[str, NDArray], fitted: bool, levels: int = MAX_LEVELS
    ) -> None:
        super().__init__(TEXELS if fitted else FIXED_TEXELS, images, fitted, levels)
        self.channels = self.codec.channels
        self._start = None if self.parameter is None else self.parameter.value
        self._images = {} if fitted else {n: v.astype(np.float32) for n, v in images.items()}

    def layers(self, decoded: TexelLayer) -> tuple[TexelLayer, ...]:
        return (decoded,)

    def set_rates(self, rates: Rates) -> None:
        assert self.parameter is not None
        per_channel = {n: _rate_of(n, rates) for n in self.channels}
        self.parameter.rate = self.codec.per_channel(per_channel)

    def export(self) -> dict[str, NDArray[np.float32]]:
        if self.parameter is None:
            return dict(self._images)
        return self.codec.to_maps(self.parameter.value)

    def changed(self) -> NDArray[np.bool_]:
        """(size, size) texels of fitted maps that differ from those of the start."""
        assert self.parameter is not None
        differs = np.array(self.parameter.value) != np.array(self._start)
        return differs.reshape(self.codec.size, self.codec.size, -1).any(axis=-1)


def _rate_of(channel: str, rates: Rates) -> float:
    if channel in NORMALS:
        return rates.normal
    return rates.base_color if channel in COLORS else rates.material
