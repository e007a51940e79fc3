"""Specular-glossiness materials as metallic-roughness ones (the conversion of Khronos' archived
extension KHR_materials_pbrSpecularGlossiness, "Converting between workflows").

Metalness is what makes a dielectric's 4 % and a metal's colour mix to the given specular
brightness; the base colour follows from diffuse where metalness is low, from specular where it is
high.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.packing import resize
from appearance_opt.asset.types import Texture, linear_to_srgb

DIELECTRIC = 0.04
"""Specular reflectance of a dielectric at normal incidence."""

ROWS = 256
"""Rows that are converted at a time: maps of 4096 x 4096 texels are large in single precision."""

_BRIGHTNESS = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True)
class Specular:
    """A material as the extension gives it. ``diffuse``, ``specular``: linear RGB factors;
    ``specular_texture``: sRGB specular colour, and glossiness as alpha."""

    diffuse: tuple[float, float, float] = (1.0, 1.0, 1.0)
    specular: tuple[float, float, float] = (1.0, 1.0, 1.0)
    glossiness: float = 1.0
    diffuse_texture: Texture | None = None
    specular_texture: Texture | None = None


def metallic(
    diffuse: NDArray, specular: NDArray
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(base colour (..., 3), metalness (...)) of linear diffuse and specular colours (..., 3)."""
    share = 1 - specular.max(axis=-1)
    metalness = _metalness(_brightness(diffuse), _brightness(specular), share)
    m = metalness[..., None]
    least = np.float32(1e-4)
    from_diffuse = diffuse * (share[..., None] / (1 - DIELECTRIC)) / np.maximum(1 - m, least)
    from_specular = (specular - DIELECTRIC * (1 - m)) / np.maximum(m, least)
    base = from_diffuse + (from_specular - from_diffuse) * m**2
    return np.clip(base, 0, 1).astype(np.float32), metalness.astype(np.float32)


def _brightness(color: NDArray) -> NDArray:
    return np.sqrt(np.square(color) @ _BRIGHTNESS)


def _metalness(diffuse: NDArray, specular: NDArray, share: NDArray) -> NDArray:
    b = diffuse * share / (1 - DIELECTRIC) + specular - 2 * DIELECTRIC
    root = np.sqrt(np.maximum(b * b - 4 * DIELECTRIC * (DIELECTRIC - specular), 0))
    return np.where(specular < DIELECTRIC, 0, np.clip((root - b) / (2 * DIELECTRIC), 0, 1))


def constants(material: Specular) -> tuple[tuple[float, float, float], float, float]:
    """(base colour, roughness, metalness) of a material without textures."""
    base, metalness = metallic(
        np.array(material.diffuse, np.float32), np.array(material.specular, np.float32)
    )
    return (
        (float(base[0]), float(base[1]), float(base[2])),
        1 - material.glossiness,
        float(metalness),
    )


def textures(material: Specular) -> tuple[Texture, Texture]:
    """(base colour, ORM) textures, 8 bits, of a material with at least one texture; they hold its
    factors, too. The diffuse texture's alpha becomes that of the base colour."""
    given = [t for t in (material.diffuse_texture, material.specular_texture) if t is not None]
    height, width = (max(t.pixels.shape[k] for t in given) for k in (0, 1))
    has_alpha = (
        material.diffuse_texture is not None and material.diffuse_texture.pixels.shape[2] == 4
    )
    base = np.empty((height, width, 4 if has_alpha else 3), np.uint8)
    orm = np.full((height, width, 3), 255, np.uint8)
    # textures of different sizes are brought to the larger one, each as a whole
    whole = [
        t if t is None or t.pixels.shape[:2] == (height, width) else _enlarge(t, height, width)
        for t in (material.diffuse_texture, material.specular_texture)
    ]
    for row in range(0, height, ROWS):
        band = slice(row, row + ROWS)
        diffuse, specular = (
            np.ones((1, 1, 4), np.float32)
            if t is None
            else _rgba(Texture(t.pixels[band], t.color_space))
            for t in whole
        )
        color, metalness = metallic(
            diffuse[..., :3] * np.array(material.diffuse, np.float32),
            specular[..., :3] * np.array(material.specular, np.float32),
        )
        base[band, :, :3] = np.round(255 * linear_to_srgb(color))
        if has_alpha:
            base[band, :, 3] = np.round(255 * diffuse[..., 3])
        orm[band, :, 1] = np.round(
            255 * np.clip(1 - specular[..., 3] * np.float32(material.glossiness), 0, 1)
        )
        orm[band, :, 2] = np.round(255 * metalness)
    return Texture(base, "srgb", given[0].wrap), Texture(orm, "linear", given[0].wrap)


def _rgba(texture: Texture) -> NDArray[np.float32]:
    """Linear pixels (H, W, 4); alpha is 1 without one."""
    pixels = texture.linear()
    return (
        pixels
        if pixels.shape[2] == 4
        else np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=2)
    )


def _enlarge(texture: Texture, height: int, width: int) -> Texture:
    return Texture(resize(texture.linear(), height, width), "linear", texture.wrap)
