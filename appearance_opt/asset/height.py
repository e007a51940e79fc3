"""Height maps: metres to stored texels and files, with scale and mid-level."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset import images
from appearance_opt.asset.types import Displacement, Texture

if TYPE_CHECKING:
    from numpy.typing import NDArray


def displacement_of(heights: NDArray[np.float32]) -> Displacement:
    """(H, W) heights in metres as 16 bits: mid-level 0.5 is no displacement, and the scale is the
    least that holds all of them. The rounding error is at most scale / 131070."""
    scale = 2 * float(np.abs(heights).max(initial=0.0))
    scale = scale if scale > 0 else 1.0
    # the mid-level is a stored value, so that no displacement stays exactly none
    mid = 32768 / 65535
    scale = scale / (1 - 1 / 65535)
    stored = np.clip(np.round((heights / scale + mid) * 65535), 0, 65535).astype(np.uint16)
    return Displacement(Texture(stored[..., None], "linear", ("clamp", "clamp")), scale, mid)


def as_16_bit(displacement: Displacement) -> Displacement:
    """The same, its texels as uint16."""
    return (
        displacement
        if displacement.texture.pixels.dtype == np.uint16
        else displacement_of(heights_of(displacement))
    )


def heights_of(displacement: Displacement) -> NDArray[np.float32]:
    """(H, W) metres of a displacement."""
    pixels = displacement.texture.pixels[..., 0]
    texel = pixels.astype(np.float64) / (65535 if pixels.dtype == np.uint16 else 1)
    return ((texel - displacement.mid) * displacement.scale).astype(np.float32)


def height_png(displacement: Displacement) -> bytes:
    """16-bit PNG with ``DisplacementScale`` (metres) and ``DisplacementMidLevel`` as text
    chunks."""
    d = as_16_bit(displacement)
    return images.encode_png(d.texture.pixels[..., :1], _attributes(d.scale, d.mid))


def height_exr(heights: NDArray[np.float32]) -> bytes:
    """32-bit EXR of (H, W) metres: scale 1 and mid-level 0, in the header under the same names."""
    return images.encode_exr(heights[..., None], _attributes(1.0, 0.0))


def _attributes(scale: float, mid: float) -> dict[str, float | str]:
    text = f"displacement along the unit normal in metres = scale * (texel - mid-level); scale {scale:.9g}"
    return {
        "ImageDescription": f"{text}, mid-level {mid:.9g}",
        "DisplacementScale": scale,
        "DisplacementMidLevel": mid,
    }
