"""Plausibility of binary USD files before USD opens them.

USD's reader allocates what the counts in a crate file ask for before it finds that the file is shorter: a few
damaged bytes cost gigabytes and minutes. The layout read here is that of OpenUSD's ``sdf/crateFile.h``: a header
with the offset of a table of contents, sections by name in it, and in each section counts and sizes of compressed
blocks.
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from pathlib import Path

from appearance_opt.errors import InputError

MAGIC = b"PXR-USDC"
BLOCKS = {"FIELDS": 2, "FIELDSETS": 1, "PATHS": 3, "SPECS": 3}
"""Sections of integers: a count, then this many compressed blocks, each after its size in bytes (the paths repeat
their count first)."""

EXPANSION = 1024
"""Elements per byte that no compressed block exceeds: LZ4 makes at most 255 bytes of one, the integer coding at
most four elements of a byte."""


def check_usd(data: bytes, path: Path) -> None:
    """Raise InputError for a binary or packaged USD file whose sizes contradict its length. Text passes."""
    if data.startswith(MAGIC):
        try:
            damaged = _crate_fault(data)
        except struct.error:
            damaged = "a section is too short"
        if damaged:
            raise InputError(f"{path}: the USD file is damaged or cut short ({damaged}); export it again")
    elif data.startswith(b"PK"):
        _check_package(data, path)


def _check_package(data: bytes, path: Path) -> None:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as package:
            bad = package.testzip()
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, NotImplementedError, RuntimeError) as error:
        raise InputError(f"{path}: the USDZ package is damaged or cut short ({error}); export it again") from None
    if bad is not None:
        raise InputError(f"{path}: the file '{bad}' in the USDZ package is damaged; export it again")


def _crate_fault(data: bytes) -> str:
    """What is impossible about a crate file; empty when nothing is. Raises struct.error where it ends early."""
    (table,) = struct.unpack_from("<q", data, 16)
    if not 0 < table < len(data):
        return "no table of contents"
    (count,) = struct.unpack_from("<Q", data, table)
    if count * 32 > len(data) - table:
        return "the table of contents is too long"
    for k in range(count):
        name, start, size = struct.unpack_from("<16sqq", data, table + 8 + 32 * k)
        if start < 0 or size < 0 or start + size > len(data):
            return "a section lies beyond its end"
        section = name.rstrip(b"\0").decode("ascii", "replace")
        if not _plausible(section, data[start : start + size]):
            return f"section {section} contradicts itself"
    return ""


def _plausible(name: str, data: bytes) -> bool:
    """Do the counts and sizes of a section fit into its bytes?"""
    if name == "TOKENS":
        count, expanded, size = struct.unpack_from("<QQQ", data)
        return size <= len(data) - 24 and expanded <= 256 * (size + 1) and count <= expanded
    (count,) = struct.unpack_from("<Q", data)
    if name == "STRINGS":
        return count * 4 <= len(data) - 8
    if name not in BLOCKS:
        return True
    offset = 8
    if name == "PATHS":
        (encoded,) = struct.unpack_from("<Q", data, offset)
        offset += 8
        if encoded > count:
            return False
    for _ in range(BLOCKS[name]):
        (size,) = struct.unpack_from("<Q", data, offset)
        offset += 8 + size
        if offset > len(data) or count > EXPANSION * size:
            return False
    return True
