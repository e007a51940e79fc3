"""What is done to a file: cuts, changed bytes, moved blocks, hostile numbers, and structures turned
inside out."""

from __future__ import annotations

import json
import random
import re
import struct
import zlib
from typing import TYPE_CHECKING, Any

from tests.fuzz.seeds import glb_parts

if TYPE_CHECKING:
    from collections.abc import Callable

NUMBERS = (
    b"-1", b"0", b"1", b"2147483647", b"4294967296", b"9" * 23, b"1e999", b"-1e38", b"1e-45", b"nan", b"inf", b"0.5",
)  # fmt: skip
"""What numbers of text formats are replaced by."""

WORDS = (
    b"",
    b"\x1b[31m",
    b"\xff\xfe",
    b"../../etc/passwd",
    b"/dev/zero",
    b"a" * 5000,
    b'"',
    b"'",
    b"\\",
    b"\0",
    b"]",
)

VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1 << 40, 1e308, -0.5, float("nan"), "", "\ud800", "\x1b[31m", "../x.bin", "data:,", [], {},
    [[]], [0] * 20, {"a": {}},
)  # fmt: skip
"""What values of JSON are replaced by."""

INTEGERS = (0, 1, 0x7F, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)

TEXTS = ("glTF", "USDA", "MaterialX", "OBJ", "MTL", "PLY text", "STL text", "TOML")


def mutate(kind: str, data: bytes, rng: random.Random) -> bytes:
    """A damaged copy of a file of a format of ``seeds.SEEDS``."""
    choices: list[Callable[[bytes, random.Random], bytes]] = [_cut, _flip, _splice, _integer]
    if kind in TEXTS:
        choices += [_number] * 3 + [_word, _lines, _lines]
    if kind == "glTF":
        choices += [_json] * 4
    if kind in ("GLB", "Draco", "meshopt"):
        choices += [_glb] * 4
    if kind == "PNG":
        choices += [_png] * 3
    out = data
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        out = rng.choice(choices)(out, rng)
    return out


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _flip(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(min(len(out), rng.choice((1, 2, 8, 64)))):
        out[rng.randrange(len(out))] = rng.randrange(256)
    return bytes(out)


def _splice(data: bytes, rng: random.Random) -> bytes:
    """A block taken out, doubled, or moved."""
    a, b, c = sorted(rng.randrange(len(data) + 1) for _ in range(3))
    block = data[a : min(b, a + 4096)]
    return rng.choice(
        (
            data[:a] + data[a + len(block) :],
            data[:b] + block + data[b:],
            data[:c] + block + data[c:],
        )
    )


def _integer(data: bytes, rng: random.Random) -> bytes:
    """A 32-bit integer set to one at which counts overflow."""
    if len(data) < 4:
        return data
    at = rng.randrange(len(data) - 3)
    at -= at % rng.choice((1, 4))
    return data[:at] + struct.pack(rng.choice("<>") + "I", rng.choice(INTEGERS)) + data[at + 4 :]


def _number(data: bytes, rng: random.Random) -> bytes:
    found = list(re.finditer(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?", data))
    if not found:
        return data
    one = rng.choice(found)
    return data[: one.start()] + rng.choice(NUMBERS) + data[one.end() :]


def _word(data: bytes, rng: random.Random) -> bytes:
    found = list(re.finditer(rb"[A-Za-z_./:]+", data))
    if not found:
        return data
    one = rng.choice(found)
    return data[: one.start()] + rng.choice(WORDS) + data[one.end() :]


def _lines(data: bytes, rng: random.Random) -> bytes:
    """A line left out, doubled, moved, or written a thousand times."""
    lines = data.split(b"\n")
    k = rng.randrange(len(lines))
    line = lines.pop(k)
    again = rng.choice((0, 1, 2, 1000))
    at = rng.choice((k, rng.randrange(len(lines) + 1)))
    return b"\n".join([*lines[:at], *[line] * again, *lines[at:]])


def _json(data: bytes, rng: random.Random) -> bytes:
    try:
        document = json.loads(data)
    except ValueError:
        return data
    return json.dumps(_changed(document, rng)).encode()


def _glb(data: bytes, rng: random.Random) -> bytes:
    try:
        document, binary = glb_parts(data)
    except (ValueError, struct.error):
        return data
    text = json.dumps(_changed(document, rng)).encode()
    text += b" " * (-len(text) % 4)
    body = (
        struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(binary), 0x004E4942)
        + binary
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def _changed(document: Any, rng: random.Random) -> Any:
    """The document with one value replaced, removed, doubled, or taken from elsewhere."""
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            places.append((node, key))
            if isinstance(value, (dict, list)):
                walk(value)

    if not isinstance(document, (dict, list)) or not document:
        return rng.choice(VALUES)
    walk(document)
    node, key = rng.choice(places)
    other, at = rng.choice(places)
    action = rng.randrange(5)
    if action == 0:
        del node[key]
    elif action == 1 and isinstance(node, list):
        node.extend([node[key]] * rng.choice((1, 3, 500)))
    elif action == 2:
        node[key] = json.loads(json.dumps(other[at]))
    elif action == 3 and isinstance(node[key], (int, float)):
        node[key] = rng.choice((node[key] + 1, -node[key], node[key] * 1000, 1 << 31, 0.5))
    else:
        node[key] = rng.choice(VALUES)
    return document


def _png(data: bytes, rng: random.Random) -> bytes:
    """A chunk changed, with the checksum that it then has."""
    at, chunks = 8, []
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        if at + 12 + length > len(data):
            break
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    if not chunks:
        return data
    k = rng.randrange(len(chunks))
    kind, body = chunks[k]
    chunks[k] = kind, rng.choice((_flip, _integer, _cut))(body, rng) if body else b"\0"
    out = data[:8]
    for kind, body in chunks:
        out += (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )
    return out
