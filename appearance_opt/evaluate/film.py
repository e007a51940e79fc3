"""Films for pages: animated WebP files, made of stills (WebP Container Specification)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from appearance_opt.evaluate.pictures import encode_for_page

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import numpy as np
    from numpy.typing import NDArray

ANIMATED = 0x02
"""Flag of the extended header; no frame has transparency."""

NO_BLEND = 0x02
"""Flag of a frame: it takes the place of what was there."""


def encode_film(
    frames: Sequence[NDArray[np.uint8]], rate: float, quality: int | None = 80
) -> bytes:
    """Animated WebP of (H, W, 3) frames of one size that repeats for ever. ``rate``: frames per
    second; ``quality``: as of ``encode_for_page``."""
    height, width = frames[0].shape[:2]
    header = bytes([ANIMATED, 0, 0, 0]) + _uint24(width - 1) + _uint24(height - 1)
    ends = [round(1000 * k / rate) for k in range(len(frames) + 1)]  # no drift by rounding
    chunks = [_chunk(b"VP8X", header), _chunk(b"ANIM", bytes(6))]
    for k, pixels in enumerate(frames):
        assert pixels.shape[:2] == (height, width), "frames of a film have one size"
        place = _uint24(0) * 2 + _uint24(width - 1) + _uint24(height - 1)
        still = b"".join(_bitstreams(encode_for_page(pixels, quality)))
        duration = _uint24(max(ends[k + 1] - ends[k], 1))
        chunks.append(_chunk(b"ANMF", place + duration + bytes([NO_BLEND]) + still))
    body = b"WEBP" + b"".join(chunks)
    return b"RIFF" + len(body).to_bytes(4, "little") + body


def _bitstreams(still: bytes) -> Iterator[bytes]:
    """The chunks of a WebP file that hold pixels, headers and padding included."""
    offset = 12
    while offset + 8 <= len(still):
        size = int.from_bytes(still[offset + 4 : offset + 8], "little")
        end = offset + 8 + size + size % 2
        if still[offset : offset + 4] in (b"VP8 ", b"VP8L"):
            yield still[offset:end]
        offset = end


def _chunk(kind: bytes, content: bytes) -> bytes:
    return kind + len(content).to_bytes(4, "little") + content + bytes(len(content) % 2)


def _uint24(value: int) -> bytes:
    return value.to_bytes(3, "little")
