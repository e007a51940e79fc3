"""How jobs begin and end: what they may write, what they read, the result on disk, the report."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from appearance_opt import __version__, backend
from appearance_opt.asset import load, write
from appearance_opt.digest import digest
from appearance_opt.errors import InputError
from appearance_opt.interrupts import Interrupts
from appearance_opt.jobs.paths import base_path, holds_displacement, level_path
from appearance_opt.jobs.report import write_job_report
from appearance_opt.publish import publication
from appearance_opt.reference.subject import Subject
from appearance_opt.stages.displacement import require_memory
from appearance_opt.stages.export import write_companion
from appearance_opt.stages.pair import Pair
from appearance_opt.stages.parts import split
from appearance_opt.stages.run import Run, Stopwatch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from appearance_opt.asset.types import Asset
    from appearance_opt.config import BakeOptions, CommonOptions, JointOptions
    from appearance_opt.jobs.paths import Outputs
    from appearance_opt.jobs.result import Result, SimplifyResult
    from appearance_opt.progress import Progress
    from appearance_opt.publish import Publication
    from appearance_opt.stages.parts import Parts


CHECKPOINT_SECONDS = 10.0
"""Between two checkpoints."""


@contextmanager
def open_run(
    outputs: Outputs,
    named: Iterable[object],
    options: CommonOptions,
    progress: Progress | None = None,
    began: float | None = None,
    resume: bool = False,
) -> Iterator[Run]:
    """A job under way, which alone may write its ``outputs``; they replace none of the files that
    are ``named``. ``resume``: it is to go on from its checkpoint. Raises InputError."""
    run = Run(
        Stopwatch(began), options.fit.budget, progress, with_report=outputs.report is not None
    )
    outputs.check()
    outputs.check_sources(*named)
    with outputs.held(), Interrupts() as run.interrupts:
        if resume and outputs.checkpoint is None:
            raise InputError("--resume needs --checkpoint DIR")
        yield run


def begin_reading(run: Run, source: str | Path | Asset) -> None:
    """Say that the input is read."""
    is_file = isinstance(source, (str, Path))
    run.begin(f"reading {Path(str(source)).name}" if is_file else "checking the asset")


def load_source(
    source: str | Path | Asset, options: CommonOptions, keep_rig: bool = False
) -> Asset:
    """``source`` itself, or the file of that name, read as the options say. ``keep_rig``: see
    ``load``."""
    if not isinstance(source, (str, Path)):
        return source
    return load(source, keep_rig=keep_rig, **options.asset.arguments())


def load_layout(source: str | Path | Asset, options: CommonOptions, missing_textures: str) -> Asset:
    """The same with vertices and texture coordinates as they are in the file."""
    if not isinstance(source, (str, Path)):
        return source
    o = options.asset
    return load(
        source,
        refine=o.refine,
        missing_textures=missing_textures,  # type: ignore[arg-type]
        root=o.root,
        keep_layout=True,
    )


def name_of(source: str | Path | Asset) -> str:
    """What to call an input in messages."""
    return str(source) if isinstance(source, (str, Path)) else source.name


def fingerprint(options: CommonOptions, asset: Asset, first: Asset | None) -> str:
    """Hash of all that a result depends on: version, options, and everything that was read, but for
    where it was read from and what was said about it. ``first``: the mesh of ``--init``."""
    read = [None if a is None else replace(a, files=(), notes=()) for a in (asset, first)]
    return digest([__version__, options, *read])


def whole_subject(subject: Subject, parts: Parts, options: CommonOptions) -> Subject:
    """What a report shows of a ``subject``: with the parts that passed through, which may lie
    outside of what the views of its fit show."""
    if not parts.kept:
        return subject
    return Subject.of_asset(parts.whole, options.views.seed, options.views.light)


def read_pair(
    high: str | Path | Asset,
    low: str | Path | Asset,
    outputs: Outputs,
    options: BakeOptions | JointOptions,
    run: Run,
) -> Pair:
    """What of HIGH is baked, and what of LOW it is baked onto. Raises InputError if it is nothing,
    or if the outputs would replace a file of either."""
    run.begin("reading both meshes")
    heavy = load_source(high, options)
    light = load_layout(low, options, options.asset.missing_textures)
    outputs.check_inputs(heavy, light)
    outputs.check_room(light.triangle_count, options)
    run.lap("load")
    run.begin(f"preparing {heavy.triangle_count:,} and {light.triangle_count:,} triangles")
    fitted = split(heavy, f"HIGH, {name_of(high)}", "bake")
    onto = split(light, f"LOW, {name_of(low)}", "bake onto", False)
    require_memory(onto.fitted.triangle_count, options)
    return Pair.of(fitted, onto, name_of(low), options, run)


def close_run(
    run: Run,
    result: Result,
    outputs: Outputs,
    options: CommonOptions,
    shown: Callable[[], Subject],
    beside: Callable[[Path, Publication], None] | None = None,
) -> None:
    """Write the result with what belongs ``beside`` it, all of it or nothing, then its report.

    ``shown``: what the report compares it with. A fit that diverged is raised between the two: its
    best state is worth having. A Ctrl-C after the result is written ends the report alone.
    """
    if outputs.out is not None:
        run.begin("writing the result")
        with publication() as together:
            written = result.asset if holds_displacement(outputs.out) else result.drawn
            place, files = together.place(outputs.out), options.output.for_file(outputs.out)
            result.write(written, place, files)
            result.files = together.files(outputs.out)
            if beside is not None:
                beside(outputs.out, together)
        run.lap("write")
    run.interrupts.release()
    if result.error is not None:
        raise result.error
    if outputs.report is not None:
        run.begin("drawing the report")
        result.seconds = dict(run.watch.stages)
        try:
            backend.release_memory()
            write_job_report(outputs.report, result, shown(), options)
        except KeyboardInterrupt:
            result.notes.append(
                "interrupted while the report was made: the result is complete, the report is missing"
            )
        run.lap("report")
    result.seconds = {**run.watch.stages, "total": run.watch.total}


def write_levels(
    result: SimplifyResult, options: CommonOptions, out: Path, together: Publication
) -> None:
    """What belongs beside a fitted mesh: the base mesh and its displacement map where the format
    has no place for one, and tessellated meshes, where they are asked for."""
    files = options.output.for_file(out)
    if options.displacement.fitted and not holds_displacement(out):
        base = base_path(out)
        write(result.asset, together.place(base), files)
        write_companion(result.asset, together.place(base))
        count, drawn = result.asset.triangle_count, result.drawn.triangle_count
        result.notes.append(
            f"{out.name} is the displaced mesh of {drawn:,} triangles; {base.name} is its base mesh "
            f"of {count:,}, with the displacement map beside it"
        )
    if options.displacement.write_tessellated:
        for level, asset in result.tessellated.items():
            write(asset, together.place(level_path(out, level)), files)
