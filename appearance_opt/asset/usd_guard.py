"""What stands between damaged USD files and USD's own reader, which does not survive all of them.

It allocates what the counts in a binary ("crate") file ask for before it finds that the file is
shorter, gigabytes for a few damaged bytes, and some damaged values crash it, and the process with
it (usd-core 26.11). So the sizes are checked first, and then another process reads the file before
this one does. The layout of crate files is that of OpenUSD's ``sdf/crateFile.h``: a header with the
offset of a table of contents, sections by name in it, and in each section counts and sizes of
compressed blocks.
"""

from __future__ import annotations

import io
import os
import re
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

from appearance_opt.errors import InputError

MAGIC = b"PXR-USDC"
BLOCKS = {"FIELDS": 2, "FIELDSETS": 1, "PATHS": 3, "SPECS": 3}
"""Sections of integers: a count, then this many compressed blocks, each after its size in bytes
(the paths repeat their count first)."""

EXPANSION = 1024
"""Elements per byte that no compressed block exceeds: LZ4 makes at most 255 bytes of one, the
integer coding at most four elements of a byte."""

SURVIVED = 77
"""Exit code of the probe when it has read all that can be read: none that Python itself uses."""

PATIENCE, BYTES_PER_SECOND = 120.0, 1 << 20
"""How long the probe may take (seconds), and how much of a file it reads per second at the least.
It ends a reader that waits for ever (for a pipe that nobody writes to), never one that is slow."""

PROBE = """
import os, resource, sys

def limit(kind, wanted):
    _, hard = resource.getrlimit(kind)
    resource.setrlimit(kind, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))

limit(resource.RLIMIT_AS, int(sys.argv[2]))
limit(resource.RLIMIT_CORE, 0)
try:
    from pxr import Usd
    stage = Usd.Stage.Open(sys.argv[1])
    for root in (stage.GetPseudoRoot(), *stage.GetPrototypes()):
        for prim in Usd.PrimRange(root):
            for attribute in prim.GetAttributes():
                try:
                    attribute.Get()
                except Exception:
                    pass
except MemoryError:
    raise
except Exception:
    pass
os._exit(int(sys.argv[3]))
"""
"""Reads every value of a stage once, in no more memory than the machine has and the process may
take. What it raises is of no interest: the reader will meet it again and tell."""


def survives(path: Path) -> bool:
    """Can USD read the file without crashing or waiting for ever? Costs half a second: a process
    and the import of USD."""
    if not sys.executable or os.name != "posix":
        return True
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    patience = PATIENCE + path.stat().st_size / BYTES_PER_SECOND
    try:
        done = subprocess.run(
            [sys.executable, "-c", PROBE, str(path), str(memory), str(SURVIVED)],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            timeout=patience,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == SURVIVED


def check_usd(data: bytes, path: Path) -> None:
    """Raise InputError for a USD file that is damaged so badly that USD should not be asked to read
    it."""
    if data.startswith(MAGIC):
        try:
            damaged = _crate_fault(data)
        except struct.error:
            damaged = "a section is too short"
        if damaged:
            raise InputError(
                f"{path}: the USD file is damaged or cut short ({damaged}); export it again"
            )
    elif data.startswith(b"PK"):
        _check_package(data, path)
    elif not re.search(rb"@[^@]*\.usd", data):
        return  # text that refers to no other layer
    if not survives(path):
        raise InputError(
            f"{path}: the USD file is damaged (USD's reader crashes on it, waits for ever or runs out of memory); "
            "export it again"
        )


def _check_package(data: bytes, path: Path) -> None:
    """Raise InputError for a package whose directory promises other bytes than it has. Entries of a
    USDZ package are stored plain (USDZ specification, "Zip constraints"), so that together they are
    shorter than the package."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as package:
            entries = package.infolist()
            packed = next(
                (e.filename for e in entries if e.compress_type != zipfile.ZIP_STORED), None
            )
            if packed is not None:
                raise InputError(
                    f"{path}: '{packed}' in the USDZ package is compressed; store it without compression"
                )
            if sum(max(e.file_size, e.compress_size) for e in entries) > len(data):
                raise InputError(
                    f"{path}: the USDZ package is damaged (its files overlap); export it again"
                )
            bad = package.testzip()
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        OSError,
        ValueError,
        NotImplementedError,
        RuntimeError,
    ) as error:
        raise InputError(
            f"{path}: the USDZ package is damaged or cut short ({error}); export it again"
        ) from None
    if bad is not None:
        raise InputError(
            f"{path}: the file '{bad}' in the USDZ package is damaged; export it again"
        )


def _crate_fault(data: bytes) -> str:
    """What is impossible about a crate file; empty when nothing is. Raises struct.error where it
    ends early."""
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
