"""Distance fields as sources of ``convert``: a function in a Python file, a grid in an .npz file, or
an object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appearance_opt.errors import InputError
from appearance_opt.placement import Placement
from appearance_opt.reference.opened import Opened
from appearance_opt.reference.sdf import SdfReference
from appearance_opt.reference.subject import Subject, corners_of
from appearance_opt.sdf.python_file import load_python
from appearance_opt.sdf.shape import Placed
from appearance_opt.views import views_around

if TYPE_CHECKING:
    from appearance_opt.config import ConvertOptions
    from appearance_opt.sdf.shape import Field


def open_source(source: Any, options: ConvertOptions) -> Opened:
    """See ``jobs.convert.OPENERS``. Raises InputError."""
    if not isinstance(source, (str, Path)):
        return _opened(source, type(source).__name__, (), options)
    path, _, name = str(source).rpartition(":")
    if not path.endswith(".py"):
        path, name = str(source), "scene"
    if not path.endswith(".py"):
        raise InputError(f"{source}: is no distance field; give FILE.py:NAME or FILE.npz")
    return _opened(load_python(Path(path), name), name, (Path(path),), options)


def _opened(field: Field, name: str, files: tuple[Path, ...], options: ConvertOptions) -> Opened:
    """The field around the origin, in the unit sphere."""
    corners = corners_of(field.bounds)
    placement = Placement.around(corners)
    placed = Placed(field, placement.centre, placement.scale)
    sampler = views_around(placement.to_local(corners), options.views.seed, options.views.light)
    reference = SdfReference(placed)
    return Opened(replace(Subject(reference, sampler, placement)), name, files)
