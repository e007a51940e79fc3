"""Pictures for people: 8-bit RGB arrays from images and maps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.images import encode_webp
from appearance_opt.asset.types import Asset, linear_to_srgb
from appearance_opt.render.display import display

DIFFERENCE_GAIN = 4.0


def picture(image: NDArray) -> NDArray[np.uint8]:
    """(H, W, 4) premultiplied linear radiance and coverage, over grey."""
    return _bytes(display(image))


def difference(a: NDArray, b: NDArray) -> NDArray[np.uint8]:
    """Absolute difference of display values, four times as bright."""
    return _bytes(np.abs(display(a) - display(b)) * DIFFERENCE_GAIN)


def wireframe(image: NDArray, triangle: NDArray) -> NDArray[np.uint8]:
    """``image`` with lines between pixels that show different triangles. ``triangle``: (H, W)
    index, -1 where nothing is seen; may be twice as fine as the image, or any multiple."""
    edge = np.zeros(triangle.shape, bool)
    edge[1:] |= triangle[1:] != triangle[:-1]
    edge[:, 1:] |= triangle[:, 1:] != triangle[:, :-1]
    factor = triangle.shape[0] // image.shape[0]
    share = edge.reshape(image.shape[0], factor, image.shape[1], factor).mean(axis=(1, 3))
    line = np.clip(share * 1.5, 0, 1)[..., None] * (image[..., 3:] > 0)
    base = 0.35 + 0.65 * display(image)
    return _bytes(base * (1 - line) + line * np.array([0.05, 0.12, 0.3]))


def shrink(pixels: NDArray, size: int) -> NDArray:
    """(H, W, C) pixels, at most ``size`` high and wide: averages over rectangles."""
    height, width = pixels.shape[:2]
    factor = max(height, width) / size
    if factor <= 1:
        return pixels
    rows, columns = (max(round(n / factor), 1) for n in (height, width))
    y, x = np.arange(rows) * height // rows, np.arange(columns) * width // columns
    kind = np.float64 if pixels.dtype.kind == "f" else np.uint64
    sums = np.add.reduceat(np.add.reduceat(pixels, y, 0, dtype=kind), x, 1)
    area = np.diff(np.append(y, height))[:, None] * np.diff(np.append(x, width))[None]
    mean = sums / area[..., None]
    return (mean if pixels.dtype.kind == "f" else np.round(mean)).astype(pixels.dtype)


def encode_for_page(pixels: NDArray, quality: int | None) -> bytes:
    """WebP file of (H, W, 3 or 4) uint8 pixels; ``quality``: 1 to 100, or None for lossless. Made
    fast: reports share a time budget with the fit."""
    return encode_webp(pixels, quality, 0 if quality is None else 2)


def texture_pictures(asset: Asset) -> dict[str, NDArray[np.uint8]]:
    """The maps of an asset's first material as they are stored, by name."""
    m = asset.meshes[0].material
    named = {
        "base colour": m.base_color_texture,
        "roughness, metalness": m.orm_texture,
        "normal": m.normal_texture,
    }
    out = {}
    for name, texture in named.items():
        if texture is not None:
            pixels = texture.pixels[..., :3]
            out[name] = (
                pixels
                if pixels.dtype == np.uint8
                else _bytes(_encode(texture.linear()[..., :3], name))
            )
    return out


def _encode(linear: NDArray, name: str) -> NDArray:
    return linear_to_srgb(np.clip(linear, 0, 1)) if name == "base colour" else linear


def _bytes(x: NDArray) -> NDArray[np.uint8]:
    return (np.clip(x, 0, 1) * 255 + 0.5).astype(np.uint8)
