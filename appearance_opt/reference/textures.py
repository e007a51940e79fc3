"""Textures of an asset's materials as packed texels of the renderer."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from appearance_opt.asset.alpha import coverage, kind_of
from appearance_opt.asset.packing import EMISSION, resize
from appearance_opt.render.layers import CHANNELS, Coverage
from appearance_opt.render.material import COLORS, UNLIT, MaterialMaps, TexelLayer
from appearance_opt.render.texture import CLAMP, MIRROR, REPEAT
from appearance_opt.render.texture_upload import Base, build_pyramid

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Material, Texture

_WRAP = {"repeat": REPEAT, "clamp": CLAMP, "mirror": MIRROR}
_PLAIN = ("red", "green", "blue", "roughness", "metalness")
_FULL = (*_PLAIN, "normal_x", "normal_y", "normal_z")


def material_maps(materials: list[Material]) -> MaterialMaps:
    """Maps of all materials in one pyramid of half precision, or constants when the only material
    has no texture.

    Maps of one material that differ in size are brought to the largest of them. Where none of the
    materials is lit, they have colours alone.
    """
    unlit = [m.unlit for m in materials]
    constants: dict[str, float] = {UNLIT: 1.0} if all(unlit) else {}
    some = mi.Bool(unlit) if any(unlit) and not all(unlit) else None
    textured = [m for m in materials if _textures(m)]
    if not textured and len(materials) == 1:
        only = materials[0]
        constants |= dict(
            zip(_PLAIN, (*only.base_color, only.roughness, only.metalness), strict=True)
        )
        return MaterialMaps(constants=constants)
    channels: tuple[str, ...] = (
        _FULL if any(m.normal_texture is not None for m in materials) else _PLAIN
    )
    if all(unlit):
        channels = COLORS
    # texels are packets of a power of two floats
    bases = [_pack_material(m, 4 if channels is COLORS else 8) for m in materials]
    # a material's maps share one wrap mode here: horizontal wrap of its first texture
    wraps = [_WRAP[_textures(m)[0].wrap[0]] if _textures(m) else REPEAT for m in materials]
    return MaterialMaps(
        (TexelLayer(channels, build_pyramid(bases, wraps, kind=np.float16)),), constants, some
    )


def emission_maps(materials: list[Material]) -> MaterialMaps | None:
    """The same of what the materials emit, linear RGB; None if none does."""
    if not any(m.emits for m in materials):
        return None
    if len(materials) == 1 and materials[0].emission_texture is None:
        return MaterialMaps(constants=dict(zip(EMISSION, materials[0].emission, strict=True)))
    bases = [_pack_emission(m) for m in materials]
    wraps = [
        REPEAT if m.emission_texture is None else _WRAP[m.emission_texture.wrap[0]]
        for m in materials
    ]
    return MaterialMaps((TexelLayer(EMISSION, build_pyramid(bases, wraps, kind=np.float16)),))


def coverage_maps(materials: list[Material]) -> Coverage | None:
    """What light the materials keep back; None if that is all of it."""
    if all(kind_of(m) == "opaque" for m in materials):
        return None
    textures = [coverage(m)[1] for m in materials]
    bases = [_kept_back(m) for m in materials]
    wraps = [REPEAT if t is None else _WRAP[t.wrap[0]] for t in textures]
    return Coverage(TexelLayer(CHANNELS, build_pyramid(bases, wraps, kind=np.float16)))


def _textures(m: Material) -> list[Texture]:
    return [t for t in (m.base_color_texture, m.orm_texture, m.normal_texture) if t is not None]


def _pack_emission(m: Material) -> Base:
    """Emitted linear RGB and 0."""
    size = (1, 1) if m.emission_texture is None else m.emission_texture.pixels.shape[:2]
    texture = _Rows(m.emission_texture, *size)

    def rows(start: int, stop: int) -> NDArray[np.float32]:
        out = np.zeros((stop - start, size[1], 4), np.float32)
        out[..., :3] = m.emission
        if texture.there:
            out[..., :3] *= texture.at(start, stop)[..., :3]
        return out

    return Base(size[1], size[0], 4, rows)


def _kept_back(m: Material) -> Base:
    """Coverage, and the cutoff or -1."""
    factor, given = coverage(m)
    size = (1, 1) if given is None else given.pixels.shape[:2]
    texture = _Rows(given, *size)

    def rows(start: int, stop: int) -> NDArray[np.float32]:
        out = np.empty((stop - start, size[1], 2), np.float32)
        out[..., 0] = factor
        if texture.there:
            out[..., 0] *= texture.at(start, stop)[..., 0]
        out[..., 1] = m.alpha_cutoff if kind_of(m) == "mask" else -1
        return out

    return Base(size[1], size[0], 2, rows)


class _Rows:
    """The linear values of a texture, brought to (height, width), in bands of rows: those of a
    large one are never all there at once. ``there``: is there a texture at all?"""

    def __init__(self, texture: Texture | None, height: int, width: int) -> None:
        self._texture, self._whole = texture, None
        self.there = texture is not None
        if texture is not None and texture.pixels.shape[:2] != (height, width):
            self._whole = resize(texture.linear(), height, width)

    def at(self, start: int, stop: int) -> NDArray[np.float32]:
        """(stop - start, width, C)"""
        if self._whole is not None:
            return self._whole[start:stop]
        assert self._texture is not None
        return replace(self._texture, pixels=self._texture.pixels[start:stop]).linear()


def _pack_material(m: Material, channels: int) -> Base:
    """Texels of 8 channels: base colour, roughness, metalness, tangent-space normal in [-1, 1]
    (which is along the surface's own for materials without a normal map); of 4: base colour and
    roughness."""
    shapes = [t.pixels.shape[:2] for t in _textures(m)] or [(1, 1)]
    height, width = max(s[0] for s in shapes), max(s[1] for s in shapes)
    color, orm, normal = (
        _Rows(t, height, width) for t in (m.base_color_texture, m.orm_texture, m.normal_texture)
    )

    def rows(start: int, stop: int) -> NDArray[np.float32]:
        out = np.zeros((stop - start, width, 8), np.float32)
        out[..., :3] = m.base_color
        out[..., 3] = m.roughness
        out[..., 4] = m.metalness
        out[..., 7] = 1.0
        if color.there:
            texels = color.at(start, stop)
            out[..., :3] *= texels[..., :3] if texels.shape[2] >= 3 else texels[..., :1]
        if orm.there:
            texels = orm.at(start, stop)
            out[..., 3] *= texels[..., 1]
            out[..., 4] *= texels[..., 2]
        if normal.there:
            out[..., 5:8] = normal.at(start, stop)[..., :3] * 2 - 1
            out[..., 5:7] *= m.normal_scale
        return out[..., :channels]

    return Base(width, height, channels, rows)
