"""Pictures compressed by Basis Universal (KTX 2.0 and .basis files), through the optional package
opengl-basisu."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.budget import Budget

KTX2 = b"\xabKTX 20\xbb\r\n\x1a\n"
_BASIS = b"sB\x13\x00"  # the signature, and the version that every file has


def is_basis(data: bytes) -> bool:
    """Is it a KTX 2.0 or a .basis file?"""
    return data.startswith((KTX2, _BASIS))


def decode(data: bytes, name: str, largest: int, budget: Budget | None = None) -> NDArray[np.uint8]:
    """(H, W, 3) pixels of the finest level, or (H, W, 4) with alpha, row 0 on top, no larger than
    ``largest``. ``budget``: what they may take. Raises InputError."""
    try:
        import opengl_basisu
    except ImportError:
        needed = "compressed by Basis Universal, which needs the package opengl-basisu"
        raise InputError(
            f"{name}: {needed}: pip install 'appearance-opt[basisu]', or save it as PNG"
        ) from None
    try:
        texture = opengl_basisu.open(data)
        if max(texture.width, texture.height) > largest:
            size = f"{texture.width} x {texture.height} pixels"
            raise InputError(f"{name}: {size}; at most {largest} x {largest} are supported")
        if budget is not None:
            budget.take_picture(texture.width, texture.height, 4, name)
        pixels = np.asarray(texture.transcode("rgba8").data)
    except opengl_basisu.UnsupportedError as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{name}: only Basis Universal of 8 bits is read from KTX 2.0 ({reason}); save it as PNG"
        ) from None
    except opengl_basisu.BasisuError as error:
        raise InputError(
            f"{name}: the image is damaged ({' '.join(str(error).split())}); export it again"
        ) from None
    if texture.y_flipped:
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels if texture.has_alpha else pixels[..., :3])
