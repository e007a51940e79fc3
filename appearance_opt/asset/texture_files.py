"""Textures to the files that hold them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset import images, ktx2
from appearance_opt.asset.encoding import encoded_for
from appearance_opt.asset.file_options import PNG

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.file_options import Codec, FileOptions, MapKind, TextureFormat
    from appearance_opt.asset.types import ColorSpace, Texture

MIME: dict[Codec, str] = {
    "png": "image/png",
    "jpeg": "image/jpeg",
    "webp": "image/webp",
    "ktx2": "image/ktx2",
}
SUFFIXES: dict[Codec, str] = {"png": ".png", "jpeg": ".jpg", "webp": ".webp", "ktx2": ".ktx2"}


@dataclass(frozen=True)
class TextureFile:
    """The bytes of an image file, and their codec."""

    data: bytes
    codec: Codec

    @property
    def suffix(self) -> str:
        return SUFFIXES[self.codec]

    @property
    def mime(self) -> str:
        return MIME[self.codec]


@dataclass(frozen=True)
class Slot:
    """A texture where a material reads it: as colours that are encoded so, as a kind of map.
    ``free_red``: does nobody read its red channel? Then it may repeat the green one, which costs
    lossy codecs less and keeps the others sharper: they hold colours as brightness and differences,
    the latter at half the resolution."""

    texture: Texture
    space: ColorSpace
    kind: MapKind
    free_red: bool = False


def encode_all(slots: Sequence[Slot], options: FileOptions) -> list[TextureFile]:
    """The files of textures. Raises OSError, InputError."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(lambda slot: encode(slot, options.format_of(slot.kind)), slots))


def encode(slot: Slot, wanted: TextureFormat) -> TextureFile:
    """The file of one texture. PNG takes the place of JPEG where alpha says something."""
    return encode_pixels(encoded_for(slot.texture, slot.space), wanted, slot)


def encode_pixels(pixels: NDArray, wanted: TextureFormat, slot: Slot) -> TextureFile:
    """The file of 8- or 16-bit pixels (H, W, C) that are encoded as the slot says."""
    if wanted.codec == "png":
        return TextureFile(images.encode_png(pixels), "png")
    if pixels.dtype == np.uint16:
        pixels = np.round(pixels.astype(np.float32) * np.float32(255 / 65535)).astype(np.uint8)
    pixels = _without_plain_alpha(pixels)
    if slot.free_red and pixels.shape[2] == 3:
        pixels = pixels[..., [1, 1, 2]]
    if wanted.codec == "jpeg":
        if pixels.shape[2] in (2, 4):
            return TextureFile(images.encode_png(pixels), PNG.codec)
        return TextureFile(images.encode_jpeg(pixels, wanted.quality), "jpeg")
    if wanted.codec == "webp":
        quality = None if wanted.mode == "lossless" else wanted.quality
        return TextureFile(images.encode_webp(_visible(images.to_color(pixels)), quality), "webp")
    data = ktx2.encode(
        images.to_color(pixels),
        slot.space,
        wanted.mode == "uastc",
        wanted.quality,
        slot.kind == "normal",
    )
    return TextureFile(data, "ktx2")


def _without_plain_alpha(pixels: NDArray) -> NDArray:
    """Pixels without an alpha that is 1 everywhere."""
    if pixels.shape[2] in (2, 4) and bool((pixels[..., -1] == np.iinfo(pixels.dtype).max).all()):
        return pixels[..., :-1]
    return pixels


def _visible(pixels: NDArray) -> NDArray:
    """Pixels whose alpha is at least one step of 255: WebP's encoder gives up the colours under
    zero, which filters mix into what lies beside it."""
    if pixels.shape[2] != 4:
        return pixels
    return np.concatenate([pixels[..., :3], np.maximum(pixels[..., 3:], 1)], axis=2)
