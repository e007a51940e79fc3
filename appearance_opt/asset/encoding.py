"""Pixels as the writers store them: in the encoding that the slot of a material expects."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.types import Texture, linear_to_srgb

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.types import ColorSpace


def encoded_for(texture: Texture, space: ColorSpace, factor: Sequence[float] = (1.0,)) -> NDArray:
    """8- or 16-bit pixels (H, W, C) of a texture for a slot whose colours are encoded as ``space``
    says (glTF 2.0,
    3.9.2: base colour and emission sRGB, everything else linear).

    Integers that are encoded so already stay as they are; others keep their depth, floats become 8
    bits, clamped to [0, 1]. ``factor``: what the linear colours are multiplied by. A fourth channel
    (alpha) is linear in every slot.
    """
    pixels = texture.pixels
    scaled = any(f != 1.0 for f in factor)
    if pixels.dtype in (np.uint8, np.uint16) and texture.color_space == space and not scaled:
        return pixels
    if texture.color_space == space and not scaled:  # floats in the slot's own encoding
        values = pixels.astype(np.float32)
    else:
        values = texture.linear()
        if values.shape[2] < len(factor):  # a grey texture times a colour
            values = np.repeat(values[..., :1], len(factor), axis=2)
        values[..., :3] *= np.asarray(factor, np.float32)
        if space == "srgb":
            values[..., :3] = linear_to_srgb(np.clip(values[..., :3], 0, 1))
    most, kind = (65535, np.uint16) if pixels.dtype == np.uint16 else (255, np.uint8)
    return (np.clip(values, 0, 1) * np.float32(most) + np.float32(0.5)).astype(kind)
