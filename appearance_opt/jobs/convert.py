"""What is no mesh in, a textured mesh that looks the same out."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appearance_opt import __version__, backend
from appearance_opt.asset.types import Asset
from appearance_opt.config import ConvertOptions, resolve_options
from appearance_opt.digest import digest
from appearance_opt.jobs.lifecycle import (
    CHECKPOINT_SECONDS,
    close_run,
    load_layout,
    open_run,
    write_levels,
)
from appearance_opt.jobs.paths import Outputs
from appearance_opt.jobs.result import SimplifyResult
from appearance_opt.optimize.archive import IMAGES
from appearance_opt.optimize.checkpoint import Checkpointer
from appearance_opt.options.option import check_choice
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.stages import unreached
from appearance_opt.stages.choice import choose_start
from appearance_opt.stages.export import Exporter, export, with_lighting
from appearance_opt.stages.fitting import fit_start
from appearance_opt.stages.parts import Parts, split
from appearance_opt.stages.start import atlas_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from appearance_opt.progress import Progress
    from appearance_opt.reference.opened import Opened
    from appearance_opt.stages.run import Run

OPENERS = {
    "sdf": ("appearance_opt.reference.sdf_open", "open_source"),
    "scene": ("appearance_opt.reference.image_open", "open_scene"),
    "images": ("appearance_opt.reference.image_open", "open_pictures"),
    "command": ("appearance_opt.reference.image_open", "open_command"),
    "reference": ("appearance_opt.reference.image_open", "open_reference"),
}
"""Kinds of sources: the module, and in it the function of (source, options) that makes an
``Opened`` of one. It is imported when a source of its kind is asked for."""


def convert(
    kind: str,
    source: Any,
    out: str | Path | None,
    options: ConvertOptions | None = None,
    *,
    report: str | Path | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    began: float | None = None,
    inputs: Iterable[str | Path] = (),
    **values: Any,
) -> SimplifyResult:
    """Write a mesh that looks like ``source``, which is no mesh, to ``out`` (None: do not write).

    ``kind``: a key of ``OPENERS``: "sdf" takes "FILE.py:NAME", "FILE.npz", or in Python an object
    with ``distance``, ``bounds`` and perhaps ``material`` (see ``sdf.shape.Shape``). Code is run
    only from the file that is named here. "scene" takes a Mitsuba scene, "images" a transforms.json
    beside its pictures, "command" a program that renders (see ``reference.command``),
    "reference" an object with ``bounds`` and ``render`` (see ``Reference``), whose images are kept,
    for they may take long. ``checkpoint``:
    folder in which the state is kept every few seconds, and images that took long; with ``resume``
    a run goes on from there. ``values``: options by flat key, instead of ``options``
    or over them. ``inputs``: other files that must not be replaced. Raises AppearanceError.
    """
    options = resolve_options(ConvertOptions, options, values)
    check_choice("kind", kind, tuple(OPENERS))
    outputs = Outputs.of(out, options, report=report, checkpoint=checkpoint)
    named = (options.start.file, *inputs)
    with open_run(outputs, named, options, progress, began, resume) as run:
        given = options.start.file
        first = None if given is None else load_layout(given, options, "ignore")
        outputs.check_inputs(first)
        outputs.check_room(options.start.triangles or 0, options)
        backend.select(options.device)
        run.begin(f"opening the {kind}")
        module, function = OPENERS[kind]
        opened = getattr(import_module(module), function)(source, options)
        try:
            outputs.check_sources(*opened.files)
            opened = _keep(opened, kind, source, first, options, outputs, resume, run)
            run.lap("reference")
            result = _fit(opened, first, options, run)
            beside = partial(write_levels, result, options)
            close_run(run, result, outputs, options, lambda: opened.subject, beside)
        finally:
            opened.close()
    return result


def _keep(
    opened: Opened,
    kind: str,
    source: Any,
    first: Asset | None,
    options: ConvertOptions,
    outputs: Outputs,
    resume: bool,
    run: Run,
) -> Opened:
    """The source with what is kept of it, and the checkpoint of the run, if there is to be one."""
    if outputs.checkpoint is None:
        return opened.kept(options.views.resolution, None, "")
    named = str(source) if isinstance(source, (str, Path, list, tuple)) else opened.name
    like = None if first is None else replace(first, files=(), notes=())
    read = [hashlib.sha256(path.read_bytes()).hexdigest() for path in opened.files]
    job = digest([__version__, kind, named, options, like, read])
    run.checkpointer = Checkpointer(outputs.checkpoint, job, resume, CHECKPOINT_SECONDS)
    folder = outputs.checkpoint / IMAGES
    if not resume and folder.is_dir():
        for path in folder.glob("*.npy"):
            path.unlink()
    return opened.kept(options.views.resolution, folder if opened.slow else None, job)


def _fit(opened: Opened, first: Asset | None, options: ConvertOptions, run: Run) -> SimplifyResult:
    """A first shape and its fit."""
    subject, given = opened.subject, None
    notes = list(opened.notes)
    if first is not None:
        given, told = atlas_of(first, subject, options)
        notes += told
        if subject.survey is None:  # all that is known of the surface is what it starts from
            fitted = split(first, f"--init {options.start.init}", "start from", by_light=False)
            subject = subject.with_likeness(fitted.fitted)
    start, left = choose_start(subject, given, options, run)
    run.lap("start")
    model, fit, error = fit_start(subject, start, left, run)
    name = f"{opened.name}_{len(start.mesh.faces)}"
    like = with_lighting(Asset((), opened.name), subject)
    exporter = Exporter(subject.placement, like, name)
    exported = export(model, start, subject, left, exporter)
    run.lap("export")
    parts = Parts(exported.asset)
    notes += start.notes
    if start.grown:
        shown = MeshReference(subject.placement.local(exported.asset))
        off = unreached.silhouettes_off(subject.reference, shown, subject.sampler)
        notes += unreached.describe(off, subject.survey is not None)
        run.lap("silhouettes")
    return SimplifyResult.of(exported, parts, fit, (opened.name, 0), notes, error)
