"""The main job: a heavy asset in, a light one that looks the same out."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appearance_opt import __version__, backend
from appearance_opt.asset import load, write
from appearance_opt.config import CommonOptions, SimplifyOptions, resolve_options, with_values
from appearance_opt.digest import digest
from appearance_opt.errors import InputError
from appearance_opt.interrupts import Interrupts
from appearance_opt.jobs.paths import Outputs, level_path
from appearance_opt.jobs.result import SimplifyResult
from appearance_opt.publish import publication
from appearance_opt.reference.subject import Subject
from appearance_opt.stages.parts import split

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from appearance_opt.asset.types import Asset
    from appearance_opt.fit.checkpoint import Checkpointer
    from appearance_opt.fit.loop import Progress
    from appearance_opt.stages.fitting import Stopwatch
    from appearance_opt.stages.growth import Effort
    from appearance_opt.stages.parts import Parts
    from appearance_opt.stages.start import Start

log = logging.getLogger(__name__)

CHECKPOINT_SECONDS = 10.0


def simplify(
    source: str | Path | Asset,
    out: str | Path | None,
    options: SimplifyOptions | None = None,
    *,
    report: str | Path | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    variants: dict[str, str] | None = None,
    began: float | None = None,
    inputs: Iterable[str | Path] = (),
    **values: Any,
) -> SimplifyResult:
    """Simplify ``source`` (a path or an asset) and write the result to ``out`` (None: do not
    write).

    ``values``: options by flat key, instead of ``options`` or over them: ``triangles=3000``.
    ``report``: folder for pictures, metrics and report.html. ``checkpoint``: folder in which the
    state is kept every few seconds; with ``resume`` a run goes on from there. ``variants``: USD
    variant selections. ``began``: ``time.perf_counter()`` at which the time budget began, if before
    this call. ``inputs``: other files that must not be replaced. Transparent meshes of the source
    pass into the result as they are (see ``stages.parts``). Ctrl-C ends the fit early and still
    writes the best state so far, the third one gives it up; once the result is written it ends the
    report. Raises AppearanceError.
    """
    from appearance_opt.stages.fitting import Stopwatch

    watch = Stopwatch(began, progress)
    options = resolve_options(SimplifyOptions, options, values)
    outputs = Outputs.of(out, options, report=report, checkpoint=checkpoint)
    outputs.check()
    outputs.check_sources(source, options.start.file, *inputs)
    if resume and checkpoint is None:
        raise InputError("--resume needs --checkpoint DIR")
    with outputs.held(), Interrupts() as interrupts:
        return _simplify(source, outputs, options, resume, progress, variants, watch, interrupts)


def _simplify(
    source: str | Path | Asset,
    outputs: Outputs,
    options: SimplifyOptions,
    resume: bool,
    progress: Progress | None,
    variants: dict[str, str] | None,
    watch: Stopwatch,
    interrupts: Interrupts,
) -> SimplifyResult:
    from appearance_opt.stages.fitting import conclude

    watch.begin(
        f"reading {Path(source).name}" if isinstance(source, (str, Path)) else "checking the asset"
    )
    asset = load_source(source, options, variants)
    first = load_init(options)
    outputs.check_inputs(asset, first)
    outputs.check_room(
        options.start.triangles or round((options.start.ratio or 1.0) * asset.triangle_count),
        options,
    )
    parts = split(asset, str(source) if isinstance(source, (str, Path)) else asset.name, "simplify")
    watch.lap("load")
    backend.select(options.device)
    checkpointer = None
    if outputs.checkpoint is not None:
        from appearance_opt.fit.checkpoint import Checkpointer

        job = fingerprint(options, asset, first)
        checkpointer = Checkpointer(outputs.checkpoint, job, resume, CHECKPOINT_SECONDS)
    run = _Job(
        parts, first, options, watch, progress, checkpointer, interrupts, outputs.report is not None
    )
    result = run.fit()
    if outputs.out is not None:
        watch.begin("writing the result")
        write_result(result, outputs.out, options)
        watch.lap("write")
    interrupts.release()
    if result.error is not None:
        raise result.error
    subject = run.subject
    if parts.kept:  # they may lie outside of what the fit's views show
        subject = Subject.of_asset(parts.whole, options.views.seed, options.views.light)
    del run

    def write_report() -> None:
        from appearance_opt.jobs.report import write_job_report

        backend.release_memory()
        assert outputs.report is not None
        write_job_report(outputs.report, result, subject, options)

    conclude(result, watch, None if outputs.report is None else write_report)
    return result


def write_result(result: SimplifyResult, out: Path, options: CommonOptions) -> None:
    """The result and what belongs to it, all of it or nothing. Raises OSError."""
    from appearance_opt.stages.displacement import write_companion

    with publication() as together:
        files = options.output.for_file(out)
        write(result.asset, together.place(out), files)
        if options.displacement.fitted:
            write_companion(result.asset, together.place(out))
        if options.displacement.write_tessellated:
            for level, asset in result.tessellated.items():
                write(asset, together.place(level_path(out, level)), files)


def load_source(
    source: str | Path | Asset, options: CommonOptions, variants: dict[str, str] | None = None
) -> Asset:
    """``source`` itself, or the file of that name, read as the options say."""
    if not isinstance(source, (str, Path)):
        return source
    arguments = options.asset.arguments()
    return load(source, **{**arguments, "variants": variants or arguments["variants"]})


def load_init(options: SimplifyOptions) -> Asset | None:
    """The asset that ``--init`` names; None if it names none. Its own maps are not used: it may
    lack them."""
    if options.start.file is None:
        return None
    return load(
        options.start.file,
        refine=options.asset.refine,
        missing_textures="ignore",
        root=options.asset.root,
        keep_layout=True,
    )


class _Job:
    """The reference, its placement and the start; then the fit."""

    def __init__(
        self,
        parts: Parts,
        first: Asset | None,
        options: SimplifyOptions,
        watch: Stopwatch,
        progress: Progress | None,
        checkpointer: Checkpointer | None,
        interrupts: Interrupts,
        with_report: bool,
    ) -> None:
        from appearance_opt.stages.fitting import seconds_left
        from appearance_opt.stages.growth import grow_start, mend_start
        from appearance_opt.stages.start import (
            atlas_of,
            budget,
            inherit_sides,
            make_start,
            require_survey,
            transfer_appearance,
        )

        self.options, self.watch, self.interrupts = options, watch, interrupts
        self.progress, self.checkpointer, self.with_report = progress, checkpointer, with_report
        self.parts, asset = parts, parts.fitted
        self.notes = [
            *asset.notes,
            *parts.describe_kept(
                "pass into the result as they are, and count for no --triangles or --ratio"
            ),
        ]
        watch.begin(f"preparing {asset.triangle_count:,} triangles")
        self.subject = Subject.of_asset(asset, options.views.seed, options.views.light)
        watch.lap("reference")
        survey = require_survey(self.subject)
        single = survey.triangles.single
        alone = "shape" in options.fit.parts and not options.displacement.fitted
        if options.start.init == "sphere" and alone:
            triangles = budget(options, asset.triangle_count)
            self.start = self._fit_shape(
                lambda effort: grow_start(self.subject, options, triangles, effort)
            )
        elif options.start.init in ("decimate", "sphere"):
            triangles = budget(options, asset.triangle_count)
            left = seconds_left(options, watch, with_report)
            self.start = self._make_start(
                lambda: make_start(self.subject, options, triangles, left, watch.begin)
            )
        else:
            assert first is not None
            mesh, notes = atlas_of(
                first, self.subject.placement, asset.triangle_count, options, single
            )
            self.notes += notes
            if options.fit.relative is False and alone:
                self.start = self._fit_shape(
                    lambda effort: mend_start(self.subject, options, mesh, effort)
                )
                # the shape has been let go of; the mended one is a likeness
                self.options = with_values(self.options, relative=None)
            else:
                self.start = self._make_start(lambda: transfer_appearance(survey, mesh, options))
        self.start = inherit_sides(self.start, single)
        watch.lap("start")

    def _make_start(self, make: Callable[[], Start]) -> Start:
        """A start that a resumed run takes from beside its checkpoint."""
        return self._make_or_resume(lambda: (make(), False))[0]

    def _make_or_resume(self, make: Callable[[], tuple[Start, bool]]) -> tuple[Start, bool]:
        from appearance_opt.latent.mesh import LatentMesh
        from appearance_opt.stages.start import Start

        if self.checkpointer is None:
            return make()
        return self.checkpointer.start(make, Start, LatentMesh)

    def _fit_shape(self, make_within: Callable[[Effort], tuple[Start, bool]]) -> Start:
        """A start whose shape is fitted first, in a part of the time or the steps."""
        from appearance_opt.stages.fitting import seconds_left
        from appearance_opt.stages.growth import SHARE, Effort

        o = self.options
        seconds = seconds_left(o, self.watch, self.with_report)
        steps = 1000 if o.fit.steps is None and seconds is None else o.fit.steps
        share = None if seconds is None else SHARE * seconds
        effort = Effort(
            share, None if steps is None else round(SHARE * steps), self.progress, self.interrupts
        )

        start, interrupted = self._make_or_resume(lambda: make_within(effort))
        if interrupted:  # Ctrl-C ends both fits
            self.options = with_values(o, steps=0)
        elif steps is not None:
            self.options = with_values(o, steps=steps - round(SHARE * steps))
        return start

    def fit(self) -> SimplifyResult:
        """Fit the start; see ``simplify``."""
        from appearance_opt.initial.transfer import transfer_emission
        from appearance_opt.latent.build import latent_of
        from appearance_opt.stages.displacement import Exporter
        from appearance_opt.stages.fitting import clean_maps, fit_start
        from appearance_opt.stages.plain import flatten_maps
        from appearance_opt.stages.start import require_survey

        o = self.options
        model, fitted, error = fit_start(
            self.subject.reference,
            self.subject.sampler,
            self.start,
            o,
            self.watch,
            interrupts=self.interrupts,
            laplacian=o.fit.laplacian,
            relative=self.start.relative if o.fit.relative is None else o.fit.relative,
            progress=self.progress,
            checkpointer=self.checkpointer,
            with_report=self.with_report,
        )
        asset = self.parts.fitted
        name = f"{asset.name}_{len(self.start.mesh.faces)}"
        exporter = Exporter(self.subject.placement, asset.origin, name)
        initial = latent_of(self.start.mesh, self.start.maps, levels=self.start.levels[-1:])
        begin = exporter.drawn(initial, self.start.maps)[initial.pose.level]
        maps = clean_maps(model, self.start.known)
        maps |= transfer_emission(require_survey(self.subject), model.posed_mesh(), o.texture.size)
        maps = flatten_maps(
            model, maps, self.start, self.subject.reference, self.subject.sampler, o
        )
        result = exporter.base(model, maps)
        tessellated = exporter.drawn(model, maps) if o.displacement.fitted else {}
        self.watch.lap("export")
        with_kept, triangles = self.parts.with_kept, len(self.start.mesh.faces)
        tessellated = {k: with_kept(a) for k, a in tessellated.items()}
        last = {f"level {k}": a for k, a in tessellated.items()} or {"result": with_kept(result)}
        return SimplifyResult(
            with_kept(result),
            {"start": with_kept(begin), **last},
            title=f"{asset.name}: {asset.triangle_count:,} to {triangles:,} triangles",
            facts={"triangles": f"{triangles} of {asset.triangle_count}"},
            fit=fitted,
            notes=[*self.notes, *self.start.notes, *fitted.notes()],
            error=error,
            triangles=triangles,
            source_triangles=asset.triangle_count,
            kept_triangles=self.parts.kept_triangles,
            tessellated=tessellated,
        )


def fingerprint(options: SimplifyOptions, asset: Asset, first: Asset | None) -> str:
    """Hash of all that a result depends on: version, options, and everything that was read, but for
    where it was read from and what was said about it. ``first``: the mesh of ``--init``."""
    read = [None if a is None else replace(a, files=(), notes=()) for a in (asset, first)]
    return digest([__version__, options, *read])
