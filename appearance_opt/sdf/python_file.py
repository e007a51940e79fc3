"""Shapes from Python files. A file is code and runs with all that its user may do: only the one that
a user names is ever run."""

from __future__ import annotations

import runpy
import traceback
from pathlib import Path
from typing import Any

from appearance_opt.errors import InputError


def load_python(path: Path, name: str) -> Any:
    """What a file calls ``name`` after it was run: a ``Field``, or a function without parameters
    that makes one. Raises InputError."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    try:
        names = runpy.run_path(str(path), run_name="<sdf>")
    except Exception as error:
        raise InputError(f"{path}{where(error, path)}: {describe(error)}") from error
    if name not in names:
        public = ", ".join(k for k in names if not k.startswith("_")) or "nothing"
        raise InputError(f"{path}: has no '{name}'; it has {public}")
    made = names[name]
    if not hasattr(made, "distance") and callable(made):
        try:
            made = made()
        except Exception as error:
            raise InputError(
                f"{path}:{name}{where(error, path)}: {describe(error)}; it must be a "
                "sdf.Shape, or a function without parameters that makes one"
            ) from error
    for needed in ("distance", "bounds"):
        if not hasattr(made, needed):
            raise InputError(
                f"{path}:{name}: has no {needed}; make it sdf.Shape(distance, bounds, material)"
            )
    return made


def where(error: BaseException, path: Path) -> str:
    """The line of a file at which an error arose, the innermost one, as ":12"; "" if none of its
    lines did."""
    lines = [
        f.lineno for f in traceback.extract_tb(error.__traceback__) if Path(f.filename) == path
    ]
    if not lines and isinstance(error, SyntaxError):
        lines = [error.lineno]
    return f":{lines[-1]}" if lines else ""


def describe(error: BaseException) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
