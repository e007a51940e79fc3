"""Textures of an asset's materials as packed texels of the renderer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from appearance_opt.asset.alpha import coverage, kind_of
from appearance_opt.asset.packing import EMISSION, resized
from appearance_opt.render.layers import CHANNELS, Coverage
from appearance_opt.render.material import COLORS, UNLIT, MaterialMaps, TexelLayer
from appearance_opt.render.texture import CLAMP, MIRROR, REPEAT, build_pyramid

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Material, Texture

_WRAP = {"repeat": REPEAT, "clamp": CLAMP, "mirror": MIRROR}
_PLAIN = ("red", "green", "blue", "roughness", "metalness")
_FULL = (*_PLAIN, "normal_x", "normal_y", "normal_z")


def material_maps(materials: list[Material]) -> MaterialMaps:
    """Maps of all materials in one pyramid of half precision, or constants when the only material has no texture.

    Maps of one material that differ in size are brought to the largest of them. Where none of the materials is lit,
    they have colours alone.
    """
    unlit = [m.unlit for m in materials]
    constants: dict[str, float] = {UNLIT: 1.0} if all(unlit) else {}
    some = mi.Bool(unlit) if any(unlit) and not all(unlit) else None
    textured = [m for m in materials if _textures(m)]
    if not textured and len(materials) == 1:
        only = materials[0]
        constants |= dict(zip(_PLAIN, (*only.base_color, only.roughness, only.metalness), strict=True))
        return MaterialMaps(constants=constants)
    channels: tuple[str, ...] = _FULL if any(m.normal_texture is not None for m in materials) else _PLAIN
    bases = [_packed(m, channels is _FULL) for m in materials]
    if all(unlit):
        channels, bases = COLORS, [np.ascontiguousarray(b[..., :4]) for b in bases]
    # a material's maps share one wrap mode here: horizontal wrap of its first texture
    wraps = [_WRAP[_textures(m)[0].wrap[0]] if _textures(m) else REPEAT for m in materials]
    return MaterialMaps((TexelLayer(channels, build_pyramid(bases, wraps).halved()),), constants, some)


def emission_maps(materials: list[Material]) -> MaterialMaps | None:
    """The same of what the materials emit, linear RGB; None if none does."""
    if not any(m.emits for m in materials):
        return None
    if len(materials) == 1 and materials[0].emission_texture is None:
        return MaterialMaps(constants=dict(zip(EMISSION, materials[0].emission, strict=True)))
    bases, wraps = [], []
    for m in materials:
        texture = m.emission_texture
        texels = np.ones((1, 1, 3), np.float32) if texture is None else texture.linear()[..., :3]
        base = np.zeros((*texels.shape[:2], 4), np.float32)
        base[..., :3] = texels * np.array(m.emission, np.float32)
        bases.append(base)
        wraps.append(REPEAT if texture is None else _WRAP[texture.wrap[0]])
    return MaterialMaps((TexelLayer(EMISSION, build_pyramid(bases, wraps).halved()),))


def coverage_maps(materials: list[Material]) -> Coverage | None:
    """What light the materials keep back; None if that is all of it."""
    if all(kind_of(m) == "opaque" for m in materials):
        return None
    bases, wraps = [], []
    for m in materials:
        factor, texture = coverage(m)
        texels = np.ones((1, 1, 1), np.float32) if texture is None else texture.linear()
        base = np.empty((*texels.shape[:2], 2), np.float32)
        base[..., 0] = texels[..., 0] * np.float32(factor)
        base[..., 1] = m.alpha_cutoff if kind_of(m) == "mask" else -1
        bases.append(base)
        wraps.append(REPEAT if texture is None else _WRAP[texture.wrap[0]])
    return Coverage(TexelLayer(CHANNELS, build_pyramid(bases, wraps).halved()))


def _textures(m: Material) -> list[Texture]:
    return [t for t in (m.base_color_texture, m.orm_texture, m.normal_texture) if t is not None]


def _packed(m: Material, with_normals: bool) -> NDArray[np.float32]:
    """(H, W, 8) texels: base colour, roughness, metalness, tangent-space normal in [-1, 1]."""
    shapes = [t.pixels.shape[:2] for t in _textures(m)] or [(1, 1)]
    height, width = max(s[0] for s in shapes), max(s[1] for s in shapes)
    out = np.zeros((height, width, 8), np.float32)
    out[..., :3] = m.base_color
    out[..., 3] = m.roughness
    out[..., 4] = m.metalness
    out[..., 7] = 1.0 if with_normals else 0.0
    if m.base_color_texture is not None:
        texture = resized(m.base_color_texture.linear(), height, width)
        out[..., :3] *= texture[..., :3] if texture.shape[2] >= 3 else texture[..., :1]
    if m.orm_texture is not None:
        texture = resized(m.orm_texture.linear(), height, width)
        out[..., 3] *= texture[..., 1]
        out[..., 4] *= texture[..., 2]
    if m.normal_texture is not None:
        texture = resized(m.normal_texture.linear(), height, width)
        out[..., 5:8] = texture[..., :3] * 2 - 1
        out[..., 5:7] *= m.normal_scale
    return out
