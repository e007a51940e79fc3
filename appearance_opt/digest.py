"""Hashes of values made of dataclasses: whatever a value has is part of its hash."""

from __future__ import annotations

import hashlib
from dataclasses import fields, is_dataclass
from pathlib import PurePath
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator


def digest(value: object) -> str:
    """Hexadecimal SHA-256 of a value: numbers, text, bytes, None, paths, arrays, and tuples, lists,
    sets, dictionaries and dataclasses of such values, of which every field counts. Equal values
    have equal hashes, in any process. Raises TypeError for other kinds of values: nothing is left
    out in silence."""
    known: dict[int, bytes] = {}  # by identity: what is shared is hashed once

    def hashed(x: object) -> bytes:
        if isinstance(x, np.ndarray) or is_dataclass(x):
            if id(x) not in known:
                known[id(x)] = _sha256(parts(x))
            return known[id(x)]
        return _sha256(parts(x))

    def parts(x: object) -> Iterator[bytes | memoryview]:
        x = x.item() if isinstance(x, np.generic) else x
        yield type(x).__name__.encode()
        if isinstance(x, np.ndarray):
            yield repr((x.shape, x.dtype.str)).encode()
            yield np.ascontiguousarray(x).reshape(-1).view(np.uint8).data if x.size else b""
        elif is_dataclass(x) and not isinstance(x, type):
            for f in fields(x):
                yield f.name.encode() + b"\0"
                yield hashed(getattr(x, f.name))
        elif isinstance(x, (tuple, list)):
            yield from map(hashed, x)
        elif isinstance(x, (set, frozenset)):
            yield from sorted(map(hashed, x))
        elif isinstance(x, dict):
            yield from sorted(hashed(k) + hashed(v) for k, v in x.items())
        elif x is None or isinstance(x, (bool, int, float, str, bytes)):
            yield repr(x).encode()
        elif isinstance(x, PurePath):
            yield str(x).encode(errors="surrogateescape")
        else:
            raise TypeError(
                f"a {type(x).__name__} has no hash; say in digest.py what it consists of"
            )

    return hashed(value).hex()


def _sha256(parts: Iterator[bytes | memoryview]) -> bytes:
    out = hashlib.sha256()
    for part in parts:
        out.update(part)
    return out.digest()
