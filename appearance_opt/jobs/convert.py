"""What is no mesh in, a textured mesh that looks the same out."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from appearance_opt import backend
from appearance_opt.asset.types import Asset
from appearance_opt.config import ConvertOptions, resolve_options
from appearance_opt.jobs.lifecycle import close_run, load_layout, open_run, write_levels
from appearance_opt.jobs.paths import Outputs
from appearance_opt.jobs.result import SimplifyResult
from appearance_opt.options.option import check_choice
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.stages import unreached
from appearance_opt.stages.choice import choose_start
from appearance_opt.stages.export import Exporter, export
from appearance_opt.stages.fitting import fit_start
from appearance_opt.stages.parts import Parts
from appearance_opt.stages.start import atlas_of

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from appearance_opt.progress import Progress
    from appearance_opt.reference.opened import Opened
    from appearance_opt.stages.run import Run

OPENERS = {"sdf": "appearance_opt.reference.sdf_open"}
"""Kinds of sources, and the module whose ``open_source(source, options)`` makes an ``Opened`` of
one. It is imported when a source of its kind is asked for."""


def convert(
    kind: str,
    source: Any,
    out: str | Path | None,
    options: ConvertOptions | None = None,
    *,
    report: str | Path | None = None,
    progress: Progress | None = None,
    began: float | None = None,
    inputs: Iterable[str | Path] = (),
    **values: Any,
) -> SimplifyResult:
    """Write a mesh that looks like ``source``, which is no mesh, to ``out`` (None: do not write).

    ``kind``: a key of ``OPENERS``: "sdf" takes "FILE.py:NAME", "FILE.npz", or in Python an object
    with ``distance``, ``bounds`` and perhaps ``material`` (see ``sdf.shape.Shape``). Code is run
    only from the file that is named here. ``values``: options by flat key, instead of ``options``
    or over them. ``inputs``: other files that must not be replaced. Raises AppearanceError.
    """
    options = resolve_options(ConvertOptions, options, values)
    check_choice("kind", kind, tuple(OPENERS))
    outputs = Outputs.of(out, options, report=report)
    with open_run(outputs, (options.start.file, *inputs), options, progress, began) as run:
        given = options.start.file
        first = None if given is None else load_layout(given, options, "ignore")
        outputs.check_inputs(first)
        outputs.check_room(options.start.triangles or 0, options)
        backend.select(options.device)
        run.begin(f"opening the {kind}")
        opened = import_module(OPENERS[kind]).open_source(source, options)
        outputs.check_sources(*opened.files)
        run.lap("reference")
        result = _fit(opened, first, options, run)
        beside = partial(write_levels, result, options)
        close_run(run, result, outputs, options, lambda: opened.subject, beside)
    return result


def _fit(opened: Opened, first: Asset | None, options: ConvertOptions, run: Run) -> SimplifyResult:
    """A first shape and its fit."""
    subject, given = opened.subject, None
    notes = list(opened.notes)
    if first is not None:
        given, told = atlas_of(first, subject, options)
        notes += told
    start, left = choose_start(subject, given, options, run)
    run.lap("start")
    model, fit, error = fit_start(subject, start, left, run)
    name = f"{opened.name}_{len(start.mesh.faces)}"
    exporter = Exporter(subject.placement, Asset((), opened.name), name)
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
