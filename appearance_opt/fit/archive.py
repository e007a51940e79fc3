"""Arrays of one job on disk, whole or not at all."""

from __future__ import annotations

import os
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

UNREADABLE = (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile)
"""What reading a damaged archive, or looking for what is not in it, can raise."""


def write(path: Path, fingerprint: str, arrays: Mapping[str, NDArray]) -> None:
    """Write to a temporary name, then rename: a killed run leaves the previous archive whole. ``fingerprint``
    identifies input and options of the job."""
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
        try:
            np.savez(file, fingerprint=np.array(fingerprint), **arrays)  # type: ignore[arg-type]
            file.flush()
            os.replace(file.name, path)
        except BaseException:
            Path(file.name).unlink(missing_ok=True)
            raise


def read(path: Path, fingerprint: str) -> dict[str, NDArray]:
    """The arrays of an archive. Raises InputError when they belong to another job, one of ``UNREADABLE`` when the
    file is damaged."""
    # opened here: NumPy leaves its own handle open when the archive is cut short
    with path.open("rb") as stored, np.load(stored) as file:
        arrays = {k: file[k] for k in file.files}
    if str(arrays.pop("fingerprint")) != fingerprint:
        raise InputError(
            f"{path}: this checkpoint belongs to another input or other options; "
            "resume with the same ones, or choose another --checkpoint folder"
        )
    return arrays
