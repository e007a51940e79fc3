"""The main job: a heavy asset in, a light one that looks the same out."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from appearance_opt import backend
from appearance_opt.config import SimplifyOptions, resolve_options, with_values
from appearance_opt.jobs.lifecycle import (
    CHECKPOINT_SECONDS,
    begin_reading,
    close_run,
    fingerprint,
    load_layout,
    load_source,
    name_of,
    open_run,
    whole_subject,
    write_levels,
)
from appearance_opt.jobs.paths import Outputs
from appearance_opt.jobs.result import SimplifyResult
from appearance_opt.jobs.smallest import TRIALS, find_smallest
from appearance_opt.optimize.checkpoint import Checkpointer
from appearance_opt.reference.subject import Subject
from appearance_opt.stages.levels import RESOLUTIONS, KeptLevels, fit_level
from appearance_opt.stages.parts import split
from appearance_opt.stages.start import atlas_of

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from appearance_opt.asset.types import Asset
    from appearance_opt.progress import Progress
    from appearance_opt.stages.parts import Parts
    from appearance_opt.stages.run import Run


def simplify(
    source: str | Path | Asset,
    out: str | Path | None,
    options: SimplifyOptions | None = None,
    *,
    report: str | Path | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    began: float | None = None,
    inputs: Iterable[str | Path] = (),
    **values: Any,
) -> SimplifyResult:
    """Simplify ``source`` (a path or an asset) and write the result to ``out`` (None: do not
    write).

    ``values``: options by flat key, instead of ``options`` or over them: ``triangles=3000``.
    ``report``: folder for pictures, metrics and report.html. ``checkpoint``: folder in which the
    state is kept every few seconds; with ``resume`` a run goes on from there. ``began``:
    ``time.perf_counter()`` at which the time budget began, if before this call. ``inputs``: other
    files that must not be replaced. Transparent meshes of the source pass into the result as they
    are (see ``stages.parts``). Ctrl-C ends the fit early and still writes the best state so far,
    the third one gives it up; once the result is written it ends the report. Raises
    AppearanceError.
    """
    options = for_size(resolve_options(SimplifyOptions, options, values))
    outputs = Outputs.of(out, options, report=report, checkpoint=checkpoint)
    named = (source, options.start.file, *inputs)
    with open_run(outputs, named, options, progress, began, resume) as run:
        begin_reading(run, source)
        asset, given = load_source(source, options), options.start.file
        first = None if given is None else load_layout(given, options, "ignore")
        outputs.check_inputs(asset, first)
        expected = round((options.start.ratio or 1.0) * asset.triangle_count)
        outputs.check_room(options.start.triangles or expected, options)
        parts = split(asset, name_of(source), "simplify", named=options.parts.keep)
        parts = parts.merged() if options.parts.parts == "merge" else parts
        run.lap("load")
        backend.select(options.device)
        searching, kept = options.start.max_error is not None, None
        if outputs.checkpoint is not None:
            job = fingerprint(options, asset, first)
            if searching:
                kept = KeptLevels(
                    outputs.checkpoint, job, resume, CHECKPOINT_SECONDS, TRIALS, "trial"
                )
            else:
                run.checkpointer = Checkpointer(outputs.checkpoint, job, resume, CHECKPOINT_SECONDS)
        run.begin(f"preparing {parts.fitted.triangle_count:,} triangles")
        subject = Subject.of_asset(parts.fitted, options.views.seed, options.views.light)
        run.lap("reference")
        if searching:
            result = find_smallest(subject, parts, options, run, kept)
        else:
            result = _fit(subject, parts, first, options, run)
        shown = partial(whole_subject, subject, parts, options)
        close_run(run, result, outputs, options, shown, partial(write_levels, result, options))
    return result


def _fit(
    subject: Subject, parts: Parts, first: Asset | None, options: SimplifyOptions, run: Run
) -> SimplifyResult:
    """A start, by default the subject with fewer triangles, and its fit."""
    asset, given = parts.fitted, None
    what = "pass into the result as they are, and count for no --triangles or --ratio"
    notes = [*asset.notes, *parts.describe_kept(what)]
    if first is not None:
        given, told = atlas_of(first, subject, options)
        notes += told
    level = fit_level(subject, asset, options, run, options.views.resolution, given)
    source = (asset.name, asset.triangle_count)
    notes += [*level.notes, *parts.describe_nodes(level.asset)]
    return SimplifyResult.of(level.exported, parts, level.fit, source, notes, level.error)


def for_size(options: SimplifyOptions) -> SimplifyOptions:
    """The same options, with views of the size on screen that is asked for."""
    if options.start.pixels is None:
        return options
    low, high = RESOLUTIONS
    return with_values(options, resolution=min(max(options.start.pixels, low), high))
