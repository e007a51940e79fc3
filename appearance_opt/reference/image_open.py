"""Sources of ``convert`` of which only images are known: Mitsuba scenes, folders of pictures,
other programs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appearance_opt.errors import InputError
from appearance_opt.reference.base import PointReference
from appearance_opt.reference.command import CommandReference
from appearance_opt.reference.folder import FolderReference
from appearance_opt.reference.opened import Opened
from appearance_opt.reference.subject import Subject

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.config import ConvertOptions

STILL = (
    "the light of the images stands still: it is baked into the base colours, which are shown "
    "without any (unlit)"
)
ASKED = "the light of the images is baked into the base colours, as --unlit asks for"


def open_scene(source: Any, options: ConvertOptions) -> Opened:
    """A Mitsuba scene: an .xml file, or a loaded one. Raises InputError."""
    # needs a variant
    from appearance_opt.reference.scene import SceneReference

    o = options.source
    light = "scene" if o.lighting == "scene" else "point"
    reference = SceneReference(source, o.shape, light, o.paths)
    is_file = isinstance(source, (str, Path))
    name = o.shape or (Path(source).stem if is_file else "scene")
    subject = Subject.of_reference(reference, options.views.seed, options.views.light)
    return _opened(subject, name, (Path(source),) if is_file else (), options, slow=True)


def open_pictures(source: Any, options: ConvertOptions) -> Opened:
    """A transforms.json, or the folder that it lies in. Raises InputError."""
    path = Path(source)
    path = path / "transforms.json" if path.is_dir() else path
    pictures = FolderReference(path)
    subject = Subject.of_pictures(pictures, options.views.seed)
    name = path.resolve().parent.name if path.stem == "transforms" else path.stem
    return _opened(subject, name or "images", pictures.files, options)


def open_command(source: Any, options: ConvertOptions) -> Opened:
    """A command line, or its words. Raises InputError."""
    o = options.source
    startup, timeout = (math.inf if t is None else t for t in (o.startup, o.timeout))
    if not isinstance(source, (str, list, tuple)):
        raise InputError(f"{type(source).__name__}: is no command; give a line or its words")
    reference = CommandReference(source, startup, timeout)
    try:
        subject = Subject.of_reference(reference, options.views.seed, options.views.light)
    except BaseException:
        reference.close()
        raise
    return _opened(subject, "command", (), options, slow=True, close=reference.close)


def open_reference(source: Any, options: ConvertOptions) -> Opened:
    """An object with ``bounds`` and ``render``. Raises InputError."""
    if not hasattr(source, "bounds") or not hasattr(source, "render"):
        raise InputError(
            f"{type(source).__name__}: is no reference, which has bounds and "
            "render(views, resolution, samples); it is an object in Python"
        )
    subject = Subject.of_reference(source, options.views.seed, options.views.light)
    slow = not isinstance(source, PointReference)
    return _opened(subject, type(source).__name__.lower(), (), options, slow)


def _opened(
    subject: Subject,
    name: str,
    files: tuple[Path, ...],
    options: ConvertOptions,
    slow: bool = False,
    close: Callable[[], None] = lambda: None,
) -> Opened:
    notes = (STILL,) if subject.static_light else ()
    if options.source.unlit and not subject.static_light:
        subject, notes = replace(subject, static_light=True), (ASKED,)
    return Opened(subject, name, files, notes, slow, close)
