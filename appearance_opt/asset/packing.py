"""Maps packed the way glTF does: G roughness, B metalness; emission as a factor and 8 bits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.types import Texture, linear_to_srgb

EMISSION = ("emission_red", "emission_green", "emission_blue")
"""Names of the channels of emission among those of baked maps."""


def resize(pixels: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Bilinear enlargement of (H, W, C) pixels, texel centres at (i + 0.5) / size."""
    if pixels.shape[:2] == (height, width):
        return pixels
    for axis, size in ((0, height), (1, width)):
        old = pixels.shape[axis]
        at = np.clip((np.arange(size) + 0.5) * old / size - 0.5, 0, old - 1)
        lower = np.floor(at).astype(np.intp)
        upper = np.minimum(lower + 1, old - 1)
        shape = [1, 1, 1]
        shape[axis] = size
        fraction = (at - lower).astype(np.float32).reshape(shape)
        pixels = pixels.take(lower, axis) * (1 - fraction) + pixels.take(upper, axis) * fraction
    return pixels


def pack_orm(roughness: Texture | None, metalness: Texture | None) -> Texture:
    """One (H, W, 3) texture from the first channels of two, either of which may be missing (1 then,
    so that the material's factor decides). The smaller is brought to the size of the larger; 8-bit
    maps of one size, linear ones, stay 8 bit."""
    given = [t for t in (roughness, metalness) if t is not None]
    height = max(t.pixels.shape[0] for t in given)
    width = max(t.pixels.shape[1] for t in given)
    plain = [t.pixels.dtype == np.uint8 and t.color_space == "linear" for t in given]
    if all(plain) and all(t.pixels.shape[:2] == (height, width) for t in given):
        out = np.full((height, width, 3), 255, np.uint8)
        planes = [None if t is None else t.pixels[..., 0] for t in (roughness, metalness)]
    else:
        out = np.ones((height, width, 3), np.float32)
        planes = [
            None if t is None else resize(t.linear(), height, width)[..., 0]
            for t in (roughness, metalness)
        ]
    for channel, plane in zip((1, 2), planes, strict=True):
        if plane is not None:
            out[..., channel] = plane
    return Texture(out, "linear", given[0].wrap)


def with_occlusion(orm: Texture | None, occlusion: Texture) -> Texture:
    """A texture of roughness and metalness (1 without one) with the first channel of another as its
    occlusion."""
    return _replace(_white(occlusion) if orm is None else orm, 0, occlusion)


def with_alpha(color: Texture | None, alpha: Texture) -> Texture:
    """A base colour (white without one) with the first channel of another texture as its alpha."""
    color = replace(_white(alpha), color_space="srgb") if color is None else color
    return _replace(color, 3, alpha)


def _white(like: Texture) -> Texture:
    return Texture(np.full((*like.pixels.shape[:2], 3), 255, np.uint8), "linear", like.wrap)


def _replace(texture: Texture, channel: int, source: Texture) -> Texture:
    """A texture whose ``channel`` (one more than there are, too) is the first one of another. The
    smaller of the two is brought to the size of the larger; those of one size and depth keep their
    texels."""
    height, width = (max(t.pixels.shape[k] for t in (texture, source)) for k in (0, 1))
    stored = texture.pixels.dtype == source.pixels.dtype and source.color_space == "linear"
    if stored and texture.pixels.shape[:2] == source.pixels.shape[:2]:
        pixels, plane, space = texture.pixels, source.pixels[..., :1], texture.color_space
    else:
        pixels, plane = (resize(t.linear(), height, width) for t in (texture, source))
        plane, space = plane[..., :1], "linear"
    pixels = np.concatenate([pixels[..., :channel], plane, pixels[..., channel + 1 :]], axis=2)
    return Texture(np.ascontiguousarray(pixels), space, texture.wrap)


def pack_emission(values: NDArray[np.float32]) -> tuple[tuple[float, float, float], Texture | None]:
    """(factor, clamped sRGB texture) of linear emission (H, W, 3). The factor is its largest value;
    there is no texture where that is 0."""
    strength = float(values.max(initial=0.0))
    if strength <= 0:
        return (0.0, 0.0, 0.0), None
    encoded = linear_to_srgb(np.clip(values / np.float32(strength), 0, 1))
    return (strength,) * 3, Texture(
        (encoded * 255 + 0.5).astype(np.uint8), "srgb", ("clamp", "clamp")
    )
