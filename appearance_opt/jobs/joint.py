"""Bake with the shape free: LOW's vertices, a displacement map, normals and material fitted
together."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from appearance_opt.config import JointOptions, resolve_options, with_values
from appearance_opt.interrupts import Interrupts
from appearance_opt.jobs.paths import Outputs
from appearance_opt.jobs.result import SimplifyResult
from appearance_opt.jobs.simplify import write_result

if TYPE_CHECKING:
    from collections.abc import Iterable

    from appearance_opt.asset.types import Asset
    from appearance_opt.fit.loop import Progress
    from appearance_opt.jobs.bake import BakeJob
    from appearance_opt.stages.fitting import Stopwatch


def joint(
    high: str | Path | Asset,
    low: str | Path | Asset,
    out: str | Path | None,
    options: JointOptions | None = None,
    *,
    report: str | Path | None = None,
    progress: Progress | None = None,
    variants: dict[str, str] | None = None,
    began: float | None = None,
    inputs: Iterable[str | Path] = (),
    **values: Any,
) -> SimplifyResult:
    """Fit base shape, displacement, normals and material of ``low`` to ``high`` and write the
    result to ``out`` (None: do not write). LOW keeps its topology and its texture coordinates; each
    kind of detail goes where it is represented best. ``values``: options by flat key, instead of
    ``options`` or over them. ``inputs``: other files that must not be replaced. Raises
    AppearanceError."""
    from appearance_opt.stages.fitting import Stopwatch

    watch = Stopwatch(began, progress)
    options = resolve_options(JointOptions, options, values)
    outputs = Outputs.of(out, options, report=report)
    outputs.check()
    outputs.check_sources(high, low, *inputs)
    with outputs.held(), Interrupts() as interrupts:
        return _fit_pair(high, low, outputs, options, progress, variants, watch, interrupts)


def _fit_pair(
    high: str | Path | Asset,
    low: str | Path | Asset,
    outputs: Outputs,
    options: JointOptions,
    progress: Progress | None,
    variants: dict[str, str] | None,
    watch: Stopwatch,
    interrupts: Interrupts,
) -> SimplifyResult:
    from appearance_opt.jobs.bake import BakeJob, read_pair
    from appearance_opt.stages.displacement import require_memory
    from appearance_opt.stages.fitting import conclude

    parts = read_pair(high, low, outputs, options, variants, watch)
    require_memory(parts[1].fitted.triangle_count, options)
    job = BakeJob(*parts, options, watch, interrupts)
    result = _fit_job(job, options, progress, outputs.report is not None)
    if outputs.out is not None:
        write_result(result, outputs.out, options)
        watch.lap("write")
    interrupts.release()
    if result.error is not None:
        raise result.error

    def write_report() -> None:
        from appearance_opt.jobs.report import write_job_report

        assert outputs.report is not None
        write_job_report(outputs.report, result, job.shown(), options)

    conclude(result, watch, None if outputs.report is None else write_report)
    return result


def _fit_job(
    job: BakeJob, options: JointOptions, progress: Progress | None, with_report: bool
) -> SimplifyResult:
    from appearance_opt.baking.closed_form import Settings, bake
    from appearance_opt.baking.target_mesh import movable
    from appearance_opt.initial.transfer import transfer_emission
    from appearance_opt.latent.build import latent_of
    from appearance_opt.stages.displacement import Exporter, bake_displacement
    from appearance_opt.stages.fitting import clean_maps, fit_start
    from appearance_opt.stages.plain import flatten_maps
    from appearance_opt.stages.start import Start, select_told

    light, with_kept = job.low_parts.fitted, job.low_parts.with_kept
    mesh = movable(job.mesh)
    drawn, displacement = bake_displacement(job.survey, mesh, options, job.cage)
    found = bake(job.survey, drawn, Settings(options.texture.size, samples=options.baking.samples))
    job.check_missed(found)
    start = Start(
        mesh,
        {**select_told(job.subject.unlit, found.maps), **displacement},
        True,
        found.covered,
        options.levels(),
    )
    job.watch.lap("closed form")
    parts = tuple(dict.fromkeys(("shape", *options.fit.parts)))
    model, fitted, error = fit_start(
        job.subject.reference,
        job.subject.sampler,
        start,
        with_values(options, fit=parts),
        job.watch,
        interrupts=job.interrupts,
        laplacian=options.fit.laplacian,
        progress=progress,
        with_report=with_report,
    )
    exporter = Exporter(job.placement, light.origin, light.name)
    initial = latent_of(mesh, start.maps, levels=start.levels[-1:])
    final = clean_maps(model, start.known)
    final |= transfer_emission(job.survey, model.posed_mesh(), options.texture.size)
    final = flatten_maps(model, final, start, job.subject.reference, job.subject.sampler, options)
    tessellated = {k: with_kept(a) for k, a in exporter.drawn(model, final).items()}
    before, after = len(job.survey.triangles.faces), len(mesh.faces)
    result = SimplifyResult(
        with_kept(exporter.base(model, final)),
        {
            "start": with_kept(exporter.drawn(initial, start.maps)[initial.pose.level]),
            **{f"level {k}": a for k, a in tessellated.items()},
        },
        title=f"{job.high.name}: {before:,} to {after:,} triangles",
        facts={"triangles": f"{after} of {before}"},
        notes=[*job.notes, *fitted.notes()],
        error=error,
        fit=fitted,
        triangles=after,
        source_triangles=before,
        kept_triangles=job.low_parts.kept_triangles,
        tessellated=tessellated,
    )
    job.watch.lap("export")
    return result
