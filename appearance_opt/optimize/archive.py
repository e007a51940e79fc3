"""Values made of dataclasses and arrays on disk, whole or not at all.

An archive is a ZIP file of NumPy arrays, not compressed, and one text that says how the value is
built of them. The text is data: a reader makes only the classes that it is given, and arrays of
plain numbers.
"""

from __future__ import annotations

import io
import json
import math
import os
import tempfile
import zipfile
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

STATE_FILE, START_FILE = "fit.npz", "start.npz"
IMAGES = "images"
"""Folder of images that took long."""

FILES = (STATE_FILE, START_FILE, IMAGES)
"""What a folder of checkpoints holds: the state of the fit, and the start that it belongs to."""

HEAD, SUFFIX, TEMPORARY = "archive.json", ".npy", ".tmp"

FORMAT = "appearance-opt archive 3"


class DamagedError(Exception):
    """An archive cannot be read (says why)."""


def write(path: Path, fingerprint: str, value: object) -> None:
    """Write to a temporary name, then rename: a killed run leaves the previous archive whole.
    ``fingerprint`` identifies the job. ``value``: None, numbers, text, arrays, and tuples, lists,
    dictionaries with text as keys and dataclasses of such; every field is kept. Raises TypeError
    for anything else."""
    arrays: dict[str, NDArray] = {}
    head = {
        "format": FORMAT,
        "fingerprint": fingerprint,
        "value": _describe(value, "value", arrays),
    }
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=TEMPORARY)
    try:
        with os.fdopen(handle, "wb") as file:
            with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as packed:
                packed.writestr(HEAD, json.dumps(head))
                for name, array in arrays.items():
                    with packed.open(name + SUFFIX, "w", force_zip64=True) as member:
                        np.lib.format.write_array(member, array, allow_pickle=False)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        Path(temporary).unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def fingerprint_of(path: Path) -> str:
    """The fingerprint of an archive. Raises DamagedError."""
    return str(_head_of(path)["fingerprint"])


def read(
    path: Path,
    fingerprint: str,
    classes: Iterable[type],
    convert: Callable[[NDArray], Any] | None = None,
) -> Any:
    """The value of an archive. ``classes``: dataclasses that it may consist of; ``convert``: what
    becomes of arrays. Raises InputError when it belongs to another job, DamagedError when it is
    damaged."""
    head = _head_of(path)
    if head["fingerprint"] != fingerprint:
        raise InputError(
            f"{path}: this checkpoint belongs to another input or other options; "
            "resume with the same ones, or choose another --checkpoint folder"
        )
    known = {c.__name__: c for c in classes}
    try:
        with zipfile.ZipFile(path) as packed:
            return _rebuild(head["value"], packed, known, convert or (lambda array: array))
    except _UNREADABLE as error:
        raise DamagedError(f"{error or type(error).__name__}") from error


_UNREADABLE = (
    OSError, KeyError, ValueError, TypeError, AttributeError, IndexError, EOFError, RecursionError, RuntimeError,
    NotImplementedError, zipfile.BadZipFile,
)  # fmt: skip
"""What damaged bytes make readers raise."""


def _head_of(path: Path) -> dict[str, Any]:
    try:
        with zipfile.ZipFile(path) as packed:
            head = json.loads(_member(packed, HEAD))
            if head["format"] != FORMAT:
                raise DamagedError("written by another version")
            return {"fingerprint": str(head["fingerprint"]), "value": head["value"]}
    except _UNREADABLE as error:
        raise DamagedError(f"{error or type(error).__name__}") from error


def _member(packed: zipfile.ZipFile, name: str) -> bytes:
    """A file in the package. Nothing is compressed: no file can be larger than the package."""
    entry = packed.getinfo(name)
    if entry.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"'{name}' is compressed")
    return packed.read(entry)


def _array(data: bytes) -> NDArray:
    """A NumPy file (its format version 1.0 or 2.0). Nothing is allocated that the bytes do not
    hold."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    shape, fortran, kind = header(stream)
    if kind.hasobject or kind.itemsize * math.prod(shape) != len(data) - stream.tell():
        raise ValueError("an array has another size than it says")
    return (
        np.frombuffer(data, kind, offset=stream.tell())
        .reshape(shape, order="F" if fortran else "C")
        .copy()
    )


def _describe(value: Any, name: str, arrays: dict[str, NDArray]) -> Any:
    """A description of a value in JSON; its arrays go into ``arrays``, named after their place in
    it."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return {"number": repr(value)}  # JSON has no infinity
    if is_dataclass(value) and not isinstance(value, type):
        parts = {
            f.name: _describe(getattr(value, f.name), f"{name}/{f.name}", arrays)
            for f in fields(value)
        }
        return {"class": type(value).__name__, "fields": parts}
    if isinstance(value, dict) and all(isinstance(k, str) for k in value):
        return {"dictionary": {k: _describe(v, f"{name}/{k}", arrays) for k, v in value.items()}}
    if isinstance(value, (tuple, list)):
        return {
            type(value).__name__: [_describe(v, f"{name}/{k}", arrays) for k, v in enumerate(value)]
        }
    array = np.asarray(value)  # a Dr.Jit array, too
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{name}: a {type(value).__name__} cannot be kept")
    arrays[name] = array
    return {"array": name}


def _rebuild(
    described: Any,
    packed: zipfile.ZipFile,
    classes: dict[str, type],
    convert: Callable[[NDArray], Any],
) -> Any:
    if not isinstance(described, dict):
        return described

    def built(x: Any) -> Any:
        return _rebuild(x, packed, classes, convert)

    if "class" in described:
        kind = classes[described["class"]]
        given = described["fields"]
        if set(given) != {f.name for f in fields(kind)}:
            raise ValueError(f"a {kind.__name__} has other fields")
        return kind(**{k: built(v) for k, v in given.items()})
    ((kind_of, content),) = described.items()
    if kind_of == "array":
        return convert(_array(_member(packed, content + SUFFIX)))
    if kind_of == "number":
        return float(content)
    if kind_of == "dictionary":
        return {k: built(v) for k, v in content.items()}
    return {"tuple": tuple, "list": list}[kind_of](built(v) for v in content)
