"""Buffer views that glTF holds compressed by meshoptimizer (EXT_meshopt_compression and its
successor KHR_meshopt_compression: what ``gltfpack -c`` writes), through the package meshopt, which
Python 3.10 lacks."""

from __future__ import annotations

from typing import Any

from appearance_opt.errors import InputError

MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
_MOST = 2048
"""Bytes that one compressed byte can stand for, and some: what claims more is damaged, and must not
ask for memory."""


class PackageMissing(InputError):
    """The package that decompresses is not installed."""


def compressed(view: dict[str, Any]) -> dict[str, Any] | None:
    """What a buffer view says of its compressed data, None if it has none."""
    extensions = view.get("extensions", {})
    return next((extensions[name] for name in MESHOPT if name in extensions), None)


def decompress(data: bytes, view: dict[str, Any], where: str) -> bytes:
    """The plain bytes behind ``data``, the compressed ones of a buffer view; ``view``: what
    ``compressed`` says of it. ``where`` begins the errors. Raises InputError."""
    try:
        import meshopt
    except ImportError:
        raise PackageMissing(
            f"{where}: meshopt compression needs the package meshopt (Python 3.11 and later): "
            "pip install meshopt (or save the file uncompressed, with gltfpack without -c)"
        ) from None
    count, stride = view["count"], view["byteStride"]
    if count < 0 or count * stride > _MOST * len(data):
        raise InputError(
            f"{where}: its meshopt data is damaged ({len(data)} bytes cannot hold {count} elements)"
        )
    try:
        return meshopt.decode_gltf_buffer(
            data, count, stride, view["mode"], view.get("filter", "NONE")
        ).tobytes()
    except Exception as error:  # the decoder raises types of its own
        raise InputError(f"{where}: its meshopt data is damaged ({error})") from error
