"""Distance fields as sources of ``convert``: a function in a Python file, a grid in an .npz file, or
an object."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.errors import InputError
from appearance_opt.placement import Placement
from appearance_opt.reference.opened import Opened
from appearance_opt.reference.sdf import SdfReference
from appearance_opt.reference.sdf_survey import SdfSurvey
from appearance_opt.reference.subject import Subject, corners_of
from appearance_opt.sdf.check import check
from appearance_opt.sdf.grid import read_grid
from appearance_opt.sdf.python_file import load_python
from appearance_opt.sdf.shape import Placed
from appearance_opt.views import views_around

if TYPE_CHECKING:
    from appearance_opt.config import ConvertOptions
    from appearance_opt.sdf.shape import Field

OVERSAMPLING, LEAST, MOST = 12, 20_000, 300_000
"""Triangles of the isosurface, in units of those asked for, and their range: enough that decimation
chooses where they go."""


def open_source(source: Any, options: ConvertOptions) -> Opened:
    """See ``jobs.convert.OPENERS``. Raises InputError."""
    if not isinstance(source, (str, Path)):
        name = type(source).__name__
        return _opened(source, name, name, (), options)
    if str(source).endswith(".npz"):
        grid = Path(source)
        return _opened(read_grid(grid), str(source), grid.stem, (grid,), options)
    path, _, name = str(source).rpartition(":")
    if not path.endswith(".py"):
        path, name = str(source), "scene"
    if not path.endswith(".py"):
        raise InputError(f"{source}: is no distance field; give FILE.py:NAME or FILE.npz")
    file = Path(path)
    return _opened(load_python(file, name), f"{path}:{name}", name, (file,), options)


def _opened(
    field: Field, source: str, name: str, files: tuple[Path, ...], options: ConvertOptions
) -> Opened:
    """The field around the origin, in the unit sphere. ``source``: what messages call it."""
    around = Placement.around(corners_of(field.bounds))
    placed = Placed(field, around.centre, around.scale)
    checked = check(placed, source)
    points = placed.to_world(checked.points)
    placement = Placement.around(points)
    sampler = views_around(placement.to_local(points), options.views.seed, options.views.light)
    reference = SdfReference(Placed(field, placement.centre, placement.scale), checked.tracing)
    wanted = int(np.clip(OVERSAMPLING * (options.start.triangles or 0), LEAST, MOST))
    subject = Subject(reference, sampler, placement, SdfSurvey(reference, wanted))
    return Opened(subject, name, files, checked.notes)
