"""Files that an asset refers to."""

from __future__ import annotations

import codecs
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlparse

from appearance_opt.errors import InputError, MissingFileError

if TYPE_CHECKING:
    from collections.abc import Iterable


def resolve(
    reference: str, owner: Path, percent_encoded: bool = False, root: Path | None = None
) -> Path:
    """Path of a file that ``owner`` refers to, or of the only one whose name differs from that in
    upper and lower case: many writers work where that makes no difference. Raises InputError when
    it lies neither in owner's folder nor in ``root`` (an asset must not read what it does not own),
    MissingFileError when it does not exist."""
    text = unquote(reference, errors="surrogateescape") if percent_encoded else reference
    if "\0" in text or (urlparse(text).scheme and len(urlparse(text).scheme) > 1):
        raise InputError(f"{owner}: refers to '{reference}', which is not a file beside it")
    folder = owner.resolve().parent
    try:
        path = (folder / text.replace("\\", "/")).resolve()
        exists = path.is_file()
    except (
        OSError,
        ValueError,
        RuntimeError,
    ):  # names too long for the file system, loops of links
        raise InputError(f"{owner}: refers to '{reference[:80]}', which is no file name") from None
    check_inside(path, owner, reference, root)
    if exists:
        return path
    found = differing_in_case(path)
    if found is None and (plain := without_stray_bytes(text)) != text:
        return resolve(plain, owner, root=root)
    if found is None:
        raise MissingFileError(f"{owner}: refers to '{reference}', which does not exist")
    check_inside(found, owner, reference, root)
    return found.resolve()


def check_inside(path: Path, owner: Path, reference: str, root: Path | None = None) -> None:
    """Raise InputError if ``path``, which ``owner`` calls ``reference``, lies neither in its folder
    nor in ``root``."""
    allowed = [owner.resolve().parent, *([] if root is None else [root.resolve()])]
    if not any(path.resolve().is_relative_to(folder) for folder in allowed):
        raise InputError(
            f"{owner}: refers to '{reference}' outside its own folder; copy it beside the file, or allow the folder: "
            f"--root {common_folder([path.resolve().parent, *([] if root is None else [root.resolve()])])}"
        )


def common_folder(folders: Iterable[Path]) -> Path:
    """The folder that all of these lie in."""
    return Path(os.path.commonpath([str(f) for f in folders]))


def without_stray_bytes(text: str) -> str:
    """Text with bytes that were no UTF-8, kept as ``os.fsdecode`` keeps them, taken for Latin-1."""
    return re.sub("[\udc80-\udcff]", lambda m: chr(ord(m[0]) - 0xDC00), text)


def differing_in_case(path: Path) -> Path | None:
    """The one file that there is under a name which differs from ``path`` in upper and lower case
    only; None if there is none, or more than one."""
    found = [Path(path.anchor)]
    for part in path.parts[1:]:
        within = [p / part for p in found if (p / part).exists()]
        found = within or [
            q for p in found if p.is_dir() for q in _list_files(p) if q.name.lower() == part.lower()
        ]
    files = [p for p in found if p.is_file()]
    return files[0] if len(files) == 1 else None


def _list_files(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError:  # it may be entered, but not listed
        return []


def read_text(path: Path, encoding: str = "utf-8") -> str:
    """Text of a file, without its byte order mark, which also says how it is encoded: UTF-8 or
    UTF-16. Bytes that are no UTF-8 stay what they are, as ``os.fsdecode`` keeps those of names.
    Raises InputError when it cannot be read or is empty."""
    data = read_bytes(path)
    marks = (
        (codecs.BOM_UTF8, "utf-8"),
        (codecs.BOM_UTF16_LE, "utf-16-le"),
        (codecs.BOM_UTF16_BE, "utf-16-be"),
    )
    for mark, marked in marks:
        if data.startswith(mark):
            data, encoding = data[len(mark) :], marked
            break
    return data.decode(encoding, errors="surrogateescape" if encoding == "utf-8" else "replace")


def read_bytes(path: Path) -> bytes:
    """Content of a file. Raises InputError when it cannot be read or is empty."""
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if not data:
        raise InputError(f"{path}: the file is empty")
    return data


MAX_NAME = 80
"""Characters of a material's name in the name of a file: file systems end at 255 bytes."""


def file_name(name: str) -> str:
    """A name that every file system takes, made of ``name``. Different names may become equal."""
    return re.sub(r"[^A-Za-z0-9._-]", "_", name)[:MAX_NAME]
