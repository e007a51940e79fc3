"""Files in USDZ packages, which USD calls "package[file]", packages in packages included."""

from __future__ import annotations

import io
import zipfile
from typing import TYPE_CHECKING

from appearance_opt.errors import InputError, MissingFileError

if TYPE_CHECKING:
    from pathlib import Path


def read_packaged(name: str, owner: Path) -> bytes:
    """Bytes of the file of that name, which ``owner`` refers to. Raises InputError,
    MissingFileError if there is none.

    Older versions of usd-core cannot read it from Python. Entries are stored plain (USDZ
    specification, "Zip constraints"): none is longer than its package.
    """
    package, *inside = name.replace("]", "").split("[")
    source: str | io.BytesIO = package
    try:
        for entry in inside:
            with zipfile.ZipFile(source) as opened:
                if opened.getinfo(entry).compress_type != zipfile.ZIP_STORED:
                    raise InputError(
                        f"{name}: is compressed; store it in its package without compression"
                    )
                source = io.BytesIO(opened.read(entry))
    except (KeyError, FileNotFoundError):
        raise MissingFileError(f"{owner}: refers to '{name}', which does not exist") from None
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise InputError(f"{name}: its package is damaged ({error}); export it again") from None
    assert isinstance(source, io.BytesIO)
    return source.getvalue()
