"""Image files to pixels and back, through OpenImageIO, without any colour conversion."""

from __future__ import annotations

import re
import struct
import tempfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset import basis
from appearance_opt.asset.paths import read_bytes
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from appearance_opt.asset.budget import Budget

MAX_SIZE = 16384
"""Widest and highest texture read (pixels)."""

MAX_WEBP = 16383
"""Widest and highest WebP (the container specification: 14 bits)."""


def decode(data: bytes, name: str, budget: Budget | None = None) -> NDArray:
    """Pixels (H, W, C) of an image file in memory; uint8, uint16 or float32 as stored, row 0 on
    top. ``budget``: what they may take. Raises InputError when it cannot be read, or is too
    large."""
    if not data:
        raise InputError(f"{name}: the image is empty")
    if basis.is_basis(data):
        return basis.decode(data, name, MAX_SIZE, budget)
    # the Python bindings of OpenImageIO read from and write to named files only, and the name
    # chooses the reader: one of ours, by what the data is, for a name may ask for readers that read
    # no picture at all
    suffix = _suffix(data, name)
    if suffix == ".png":
        check_png(data, name)
    elif suffix == ".jpg":
        check_jpeg(data, name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("image" + suffix)
        path.write_bytes(data)
        return _open(path, name, budget)


def read(path: Path) -> NDArray:
    """Pixels of an image file. Raises InputError naming the file."""
    return decode(read_bytes(path), str(path))


def to_color(pixels: NDArray) -> NDArray:
    """Pixels of at least three channels: grey ones repeat theirs, and keep their alpha if they have
    one."""
    if pixels.shape[2] >= 3:
        return pixels
    grey = np.repeat(pixels[..., :1], 3, axis=2)
    return grey if pixels.shape[2] == 1 else np.concatenate([grey, pixels[..., 1:]], axis=2)


def check_png(data: bytes, name: str) -> None:
    """Raise InputError if a PNG file is cut short or a chunk's checksum is wrong (PNG
    specification, 5.3).

    libpng, asked to read such a file, prints to standard error before it fails.
    """
    offset = 8
    while offset + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        end = offset + 12 + length
        if end > len(data):
            break
        if zlib.crc32(data[offset + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise InputError(f"{name}: the image is damaged (a wrong checksum); export it again")
        if kind == b"IEND":
            return
        offset = end
    raise InputError(f"{name}: the image is damaged (cut short); export it again")


_MARKER = re.compile(rb"\xff+([\x01-\xcf\xd8-\xfe])", re.DOTALL)
"""A marker that is none of those within the data of a scan: stuffed zeros and restarts."""


def check_jpeg(data: bytes, name: str) -> None:
    """Raise InputError if a JPEG file ends before its end-of-image marker (ITU-T T.81, annex B).

    Readers fill what is missing with grey and say nothing.
    """
    offset = 2
    while (found := _MARKER.search(data, offset)) is not None:
        marker, offset = found[1][0], found.end()
        if marker == _END_OF_IMAGE:
            return
        if marker != _TEMPORARY:  # the others have a length
            offset += int.from_bytes(data[offset : offset + 2], "big")
    raise InputError(f"{name}: the image is damaged (cut short); export it again")


_END_OF_IMAGE, _TEMPORARY = 0xD9, 0x01


def _open(path: Path, name: str, budget: Budget | None) -> NDArray:
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise InputError(
            f"{name}: not a readable image ({_reason(oiio.geterror, 'unknown format')})"
        )
    try:
        return _read(source, name, budget)
    finally:
        source.close()


def _read(source, name: str, budget: Budget | None) -> NDArray:
    import OpenImageIO as oiio

    spec = source.spec()
    if spec.width > MAX_SIZE or spec.height > MAX_SIZE:
        raise InputError(
            f"{name}: {spec.width} x {spec.height} pixels; at most {MAX_SIZE} x {MAX_SIZE} are supported"
        )
    kind = {oiio.UINT8: oiio.UINT8, oiio.UINT16: oiio.UINT16}.get(spec.format.basetype, oiio.FLOAT)
    channels = min(spec.nchannels, 4)
    if budget is not None:
        size = {oiio.UINT8: 1, oiio.UINT16: 2}.get(kind, 4)
        budget.take_picture(spec.width, spec.height, channels * size, name)
    pixels = source.read_image(0, 0, 0, channels, kind)
    if pixels is None:
        raise InputError(
            f"{name}: the image is damaged ({_reason(source.geterror, 'cannot be decoded')})"
        )
    pixels = pixels.reshape(spec.height, spec.width, channels)
    if pixels.dtype == np.float32 and not np.isfinite(pixels).all():
        raise InputError(f"{name}: the image has NaN or infinite pixels")
    return pixels


def encode_png(pixels: NDArray, attributes: Mapping[str, float | str] | None = None) -> bytes:
    """PNG file of (H, W, C) uint8 or uint16 pixels, ``attributes`` as text chunks. Fast
    compression: a texture is written more often than it is shipped."""
    import OpenImageIO as oiio

    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(
        width, height, channels, oiio.UINT16 if pixels.dtype == np.uint16 else oiio.UINT8
    )
    spec.attribute("png:compressionLevel", 3)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    return _encode(np.ascontiguousarray(pixels), spec, ".png", attributes)


def encode_jpeg(pixels: NDArray, quality: int) -> bytes:
    """JPEG file of (H, W, 1 or 3) uint8 pixels, colours at full resolution; ``quality``: 1 to
    100."""
    import OpenImageIO as oiio

    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT8)
    spec.attribute("Compression", f"jpeg:{quality}")
    spec.attribute("jpeg:subsampling", "4:4:4")
    return _encode(np.ascontiguousarray(pixels), spec, ".jpg")


def encode_webp(pixels: NDArray, quality: int | None = None, effort: int = 6) -> bytes:
    """WebP file of (H, W, 3 or 4) uint8 pixels; ``quality``: 1 to 100, None: lossless; ``effort``:
    0 to 6, where the last tenth of the bytes takes most of the time."""
    import OpenImageIO as oiio

    height, width, channels = pixels.shape
    if max(height, width) > MAX_WEBP:
        raise InputError(
            f"a texture of {width} x {height} pixels is too large for WebP, which ends at "
            f"{MAX_WEBP}; choose another --textures"
        )
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT8)
    spec.attribute("Compression", "lossless" if quality is None else f"webp:{quality}")
    spec.attribute("webp:method", effort)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    return _encode(np.ascontiguousarray(pixels), spec, ".webp")


def encode_exr(pixels: NDArray, attributes: Mapping[str, float | str] | None = None) -> bytes:
    """OpenEXR file (32-bit float, lossless zip) of (H, W, C) linear pixels, with header
    attributes."""
    import OpenImageIO as oiio

    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.FLOAT)
    spec.attribute("compression", "zip")
    return _encode(np.ascontiguousarray(pixels, np.float32), spec, ".exr", attributes)


def _encode(
    pixels: NDArray, spec, suffix: str, attributes: Mapping[str, float | str] | None = None
) -> bytes:
    import OpenImageIO as oiio

    for name, value in (attributes or {}).items():
        # PNG keeps text alone
        spec.attribute(
            name, f"{value:.9g}" if suffix == ".png" and not isinstance(value, str) else value
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("image" + suffix)
        out = oiio.ImageOutput.create(str(path))
        fault, full = f"a {suffix} image could not be encoded in {folder}", "is its disk full?"
        if out is None or not out.open(str(path), spec) or not out.write_image(pixels):
            raise OSError(f"{fault} ({_reason(oiio.geterror, full)})")
        if not out.close():  # what is buffered meets a full disk only now
            raise OSError(f"{fault} ({_reason(out.geterror, full)})")
        return path.read_bytes()


def _suffix(data: bytes, name: str) -> str:
    """File suffix by magic number (OpenImageIO picks its reader by name first)."""
    magic = (
        (b"\x89PNG", ".png"),
        (b"\xff\xd8", ".jpg"),
        (b"\x76\x2f\x31\x01", ".exr"),
        (b"II*\x00", ".tif"),
        (b"MM\x00*", ".tif"),
        (b"RIFF", ".webp"),
        (b"BM", ".bmp"),
        (b"#?", ".hdr"),
    )
    for head, suffix in magic:
        if data.startswith(head):
            return suffix
    if (
        len(data) > 18
        and data[1] <= 1
        and data[2] in _TGA_TYPES
        and data[16] in (8, 15, 16, 24, 32)
    ):
        return ".tga"  # it has no magic number
    raise InputError(
        f"{name}: not a readable image (neither PNG, JPEG, EXR, TIFF, WebP, BMP, TGA, HDR nor KTX2)"
    )


_TGA_TYPES = (1, 2, 3, 9, 10, 11)


def _reason(said: Callable[[], str], otherwise: str) -> str:
    """What OpenImageIO says of a fault, on one line; ``otherwise`` if it says nothing, or bytes
    that are no text: it quotes what stands in the file."""
    try:
        return " ".join(said().split()) or otherwise
    except UnicodeDecodeError:
        return otherwise
