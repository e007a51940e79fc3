"""A chain of levels of detail, each fitted for the size at which it is shown, and where to switch
between them, as measured."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt import backend
from appearance_opt.asset import HOLDS_LEVELS, write
from appearance_opt.config import LodOptions, resolve_options
from appearance_opt.evaluate.chart import Chart
from appearance_opt.evaluate.comparison import render_asset
from appearance_opt.evaluate.switching import (
    ErrorAt,
    ScreenSize,
    Switch,
    errors_by_size,
    find_switches,
    on_screen,
    sphere_in_views,
)
from appearance_opt.jobs.lifecycle import (
    CHECKPOINT_SECONDS,
    begin_reading,
    close_run,
    fingerprint,
    load_source,
    name_of,
    open_run,
    whole_subject,
)
from appearance_opt.jobs.paths import Outputs, lod_path
from appearance_opt.jobs.result import Result
from appearance_opt.options.bound import Bound, parse_bound
from appearance_opt.reference.subject import Subject
from appearance_opt.stages.levels import KeptLevels, Level, fit_levels
from appearance_opt.stages.parts import split
from appearance_opt.views import MEASURED

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.file_options import FileOptions
    from appearance_opt.asset.types import Asset
    from appearance_opt.progress import Progress
    from appearance_opt.publish import Publication
    from appearance_opt.stages.parts import Parts
    from appearance_opt.stages.run import Run

MEASURED_VIEWS = 8
"""Views by which levels are compared at all sizes."""

MOST_PIXELS = 1024
"""Of the largest images by which they are."""

RAYS = 16
"""Per pixel of images of 256 pixels and below; larger ones have fewer, as halving averages them."""

MEASURING_SHARE = 0.1
"""Part of the budget that is kept for measuring."""


@dataclass(frozen=True)
class Measured:
    """``curves``: error of each level against the source by size; ``between``: of each but the
    finest against the finer one; ``switches``: where each but the finest takes over, in pixels, and
    ``screens``: in the forms of engines."""

    curves: tuple[tuple[ErrorAt, ...], ...]
    between: tuple[tuple[ErrorAt, ...], ...]
    switches: tuple[Switch, ...]
    screens: tuple[ScreenSize, ...]


@dataclass
class LodResult(Result):
    """What ``lod`` did. ``asset``: the finest level; ``levels``: all of them, with what passed
    through; ``fitted``: how each was made; ``measured``: their errors and switches."""

    levels: tuple[Asset, ...] = field(kw_only=True)
    fitted: tuple[Level, ...] = field(kw_only=True)
    measured: Measured = field(kw_only=True)
    bound: Bound = field(kw_only=True)

    def write(self, asset: Asset, path: Path, options: FileOptions) -> None:
        """Write all levels to one file, if its format holds them, else ``asset``, the finest,
        alone."""
        coverage = (*(s.coverage for s in self.measured.screens), 0.0)
        write(asset, path, options, self.levels[1:], coverage)

    def write_files(self, out: Path, together: Publication, options: FileOptions) -> None:
        """Write each level to a file of its own beside ``out``."""
        for k, level in enumerate(self.levels):
            write(level, together.place(lod_path(out, k)), options)

    def outcome(self) -> str:
        """Triangles of the levels."""
        return f"{len(self.levels)} levels of {', '.join(self._counts())} triangles"

    def _counts(self) -> list[str]:
        return [f"{level.asset.triangle_count:,}" for level in self.fitted]

    def lines(self) -> list[str]:
        """What a terminal shows: a line per level."""
        out = [f"{self.outcome()}, {self.seconds['total']:.1f} s"]
        for k, level in enumerate(self.fitted):
            line = f"LOD{k}: {level.asset.triangle_count:,} triangles for {level.pixels} px"
            if k:
                switch, screen = self.measured.switches[k - 1], self.measured.screens[k - 1]
                line += (
                    f", takes over below {switch.pixels:.0f} px ({self.bound.show(switch.error)}"
                    f"{'' if switch.met else ', over the bound'}; popping FLIP "
                    f"{switch.popping:.3f}); Unreal {screen.unreal:.4f}, Unity {screen.unity:.4f}, "
                    f"Godot {screen.godot:.2f} m"
                )
            out.append(line)
        return out

    def record(self) -> dict[str, Any]:
        """Numbers of it for JSON."""
        levels = []
        for k, level in enumerate(self.fitted):
            one: dict[str, Any] = {
                "triangles": level.asset.triangle_count,
                "pixels": level.pixels,
                "seconds": level.seconds,
                "steps": level.fit.steps,
                "errors": [vars(e) for e in self.measured.curves[k]],
            }
            if k:
                one["switch"] = vars(self.measured.switches[k - 1])
                one["screen"] = self.measured.screens[k - 1].record()
            levels.append(one)
        return {**self.facts, "levels": levels, "seconds": self.seconds, "notes": self.notes}


def lod(
    source: str | Path | Asset,
    out: str | Path | None,
    options: LodOptions | None = None,
    *,
    report: str | Path | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    began: float | None = None,
    inputs: Iterable[str | Path] = (),
    **values: Any,
) -> LodResult:
    """Make a chain of levels of ``source`` (a path or an asset) and write it to ``out`` (None: do
    not write): a glTF file with MSFT_lod, a USD file with variants, or the finest level with the
    others beside it. Each level is fitted to images of the source at its size on screen.

    ``report``, ``checkpoint``, ``resume``, ``progress``, ``began``, ``inputs``, ``values``: as for
    ``simplify``; a resumed chain goes on at the level it was at. Ctrl-C ends the fit that runs and
    those that follow. Raises AppearanceError.
    """
    options = resolve_options(LodOptions, options, values)
    separate = options.chain.separate_files or (
        out is not None and Path(out).suffix.lower() not in HOLDS_LEVELS
    )
    lods = options.chain.count() if separate else 0
    outputs = Outputs.of(out, options, report=report, checkpoint=checkpoint, lods=lods)
    with open_run(outputs, (source, *inputs), options, progress, began, resume) as run:
        begin_reading(run, source)
        asset = load_source(source, options)
        outputs.check_inputs(asset)
        parts = split(asset, name_of(source), "simplify", named=options.parts.keep)
        parts = parts.merged() if options.parts.parts == "merge" else parts
        triangles = options.chain.budgets(parts.fitted.triangle_count)
        outputs.check_room(2 * triangles[0], options)
        run.lap("load")
        backend.select(options.device)
        kept = None
        if outputs.checkpoint is not None:
            job = fingerprint(options, asset, None)
            kept = KeptLevels(outputs.checkpoint, job, resume, CHECKPOINT_SECONDS, len(triangles))
        run.begin(f"preparing {parts.fitted.triangle_count:,} triangles")
        subject = Subject.of_asset(parts.fitted, options.views.seed, options.views.light)
        run.lap("reference")
        result = _make(subject, parts, triangles, options, run, kept)

        def beside(path: Path, together: Publication) -> None:
            if separate:
                result.write_files(path, together, options.output.for_file(path))

        shown = partial(whole_subject, subject, parts, options)
        close_run(run, result, outputs, options, shown, beside)
        return result


def _make(
    subject: Subject,
    parts: Parts,
    triangles: Sequence[int],
    options: LodOptions,
    run: Run,
    kept: KeptLevels | None,
) -> LodResult:
    left = run.seconds_left()
    seconds = None if left is None else left - MEASURING_SHARE * (options.fit.budget or 0.0)
    seconds = None if seconds is None else max(seconds, 0.0)
    levels = fit_levels(subject, parts.fitted, triangles, options, run, kept, seconds)
    bound = parse_bound(options.chain.max_error)
    run.begin("measuring where to switch")
    measured = _measure(subject, levels, bound, options.chain.screen)
    run.lap("measure")
    assets = tuple(parts.with_kept(level.asset) for level in levels)
    what = "pass into every level as they are, and count for no --triangles or --ratio"
    notes = [*parts.fitted.notes, *parts.describe_kept(what)]
    for k, level in enumerate(levels):
        told = (*level.notes, *level.fit.notes(), *parts.describe_nodes(level.asset))
        notes += [f"LOD{k}: {note}" for note in told]
    notes += _describe(measured, levels, bound)
    counts = " / ".join(f"{level.asset.triangle_count}" for level in levels)
    name = parts.fitted.name
    return LodResult(
        assets[0],
        {
            "start": parts.with_kept(levels[0].exported.start),
            **{f"LOD {k}": a for k, a in reversed(list(enumerate(assets)))},
        },
        fit=levels[0].fit,
        title=f"{name}: {len(levels)} levels of detail",
        facts={"triangles": f"{counts} of {parts.fitted.triangle_count}"},
        charts=[_chart(measured, bound)],
        notes=notes,
        error=next((level.error for level in levels if level.error is not None), None),
        levels=assets,
        fitted=tuple(levels),
        measured=measured,
        bound=bound,
    )


def _measure(subject: Subject, levels: Sequence[Level], bound: Bound, screen: int) -> Measured:
    """Errors by size, and the switches that follow from them."""
    size = 1 << min(levels[0].pixels - 1, MOST_PIXELS - 1).bit_length()
    views = subject.sampler.held_out(MEASURED).draw(0, MEASURED_VIEWS)
    most = max(size, 32)
    rays = max(2, min(RAYS, RAYS * 256**2 // most**2))
    images: list[NDArray[np.float32]] = [subject.reference.render(views, most, rays)]
    for level in levels:
        local = subject.placement.local(level.asset)
        images.append(render_asset(local, views, most, rays))
    curves = [tuple(errors_by_size(images[0], image)) for image in images[1:]]
    between = [tuple(errors_by_size(finer, coarser)) for finer, coarser in pairwise(images[1:])]
    switches = find_switches(curves, between, [level.pixels for level in levels], bound)
    points = subject.asset.points() if subject.asset is not None else np.zeros((1, 3))
    extent = float(np.ptp(points, axis=0).max())
    diameter, sphere = 2.0 * subject.placement.scale, sphere_in_views(views)
    screens = tuple(on_screen(s.pixels, sphere, diameter, extent, screen) for s in switches)
    return Measured(tuple(curves), tuple(between), tuple(switches), screens)


def _describe(measured: Measured, levels: Sequence[Level], bound: Bound) -> list[str]:
    """Notes on switches that are not where a user would expect them."""
    out = []
    for k, switch in enumerate(measured.switches, start=1):
        if not switch.met:
            out.append(
                f"LOD{k} keeps within {bound.show(bound.value)} at no measured size: it takes over "
                f"at the {switch.pixels:.0f} pixels for which it was fitted, with "
                f"{bound.show(switch.error)}"
            )
        elif k < len(measured.switches) and measured.switches[k].pixels >= switch.pixels:
            out.append(
                f"LOD{k} is never shown: LOD{k + 1} keeps within {bound.show(bound.value)} as far; "
                "leave it out, or ask for more --pixels or a tighter --max-error"
            )
    return out


def _chart(measured: Measured, bound: Bound) -> Chart:
    """Error of each level by size."""
    names = {"silhouette_shift": "silhouette shift (pixels)", "flip": "FLIP"}
    lines = {
        f"LOD{k}": [(float(e.pixels), bound.error(getattr(e, bound.metric))) for e in curve]
        for k, curve in enumerate(measured.curves)
    }
    marks = {
        f"LOD{k} takes over at {s.pixels:.0f} pixels": s.pixels
        for k, s in enumerate(measured.switches, start=1)
    }
    return Chart(
        "Where levels switch",
        "Error of each level against the source, by its size on screen in pixels. The dotted line is "
        f"the bound, {bound.show(bound.value)}; upright lines are the switches.",
        "size on screen (pixels)",
        names.get(bound.metric, "root of the mean squared error"),
        lines,
        bound.limit,
        marks,
    )
