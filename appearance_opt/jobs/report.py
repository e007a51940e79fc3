"""Reports of the jobs: held-out views rendered, measured, and written."""

from __future__ import annotations

import os
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt import backend
from appearance_opt.config import as_dict
from appearance_opt.evaluate import pictures
from appearance_opt.evaluate.preview import preview_of
from appearance_opt.evaluate.report import Option, ReportData, write_report
from appearance_opt.evaluate.showing import Looks, picture_upright, show
from appearance_opt.evaluate.sizes import sizes_of
from appearance_opt.evaluate.verdict import at_sizes
from appearance_opt.options.option import entries, flag_name
from appearance_opt.reference.album import Album
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.views import support

if TYPE_CHECKING:
    from collections.abc import Iterable

    from appearance_opt.asset.types import Asset
    from appearance_opt.config import CommonOptions, CompareOptions
    from appearance_opt.evaluate.comparison import Comparison
    from appearance_opt.evaluate.motion import Motion
    from appearance_opt.jobs.result import Result
    from appearance_opt.options.option import Record
    from appearance_opt.placement import Placement
    from appearance_opt.reference.base import Reference
    from appearance_opt.reference.subject import Subject

LOOKS = Looks()

MOST_VIEWS, MOST_LINKS = 3, 8
"""Random views of a comparison that a page shows, those that differ most first; files that it links to."""

COLUMNS = {
    "start": "before any fitting: decimated, with maps that rays have baked",
    "closed form": "before any fitting: maps as rays have baked them",
    "fitted": "after the fit, as it is written",
    "result": "after the fit, as it is written",
    "level": "the displaced mesh at this level of tessellation",
    "LOD": "a level of detail, seen as large as all others here",
}
"""What the columns of numbers are, by the first word of their names or by all."""


def write_job_report(
    folder: Path, result: Result, subject: Subject, options: CommonOptions
) -> None:
    """Report of a job: what it started from and what came of it, against images of ``subject``."""
    original = subject.asset
    shown = show(
        subject.reference,
        None if original is None else subject.placement.local(original),
        {name: subject.placement.local(a) for name, a in result.columns.items()},
        subject.placement.local(result.asset),
        subject.sampler,
        looks_at(subject.reference),
    )
    curve = [] if result.fit is None else result.fit.curve
    sizes = {"result": sizes_of(result.asset, result.files)}
    if original is not None:
        sizes = {"original": sizes_of(original, original.files), **sizes}
    told = {n: COLUMNS.get(n) or COLUMNS.get(n.split()[0]) for n in result.columns}
    data = ReportData(
        title=result.title,
        facts=_facts(result),
        options=_options(options),
        maps={**pictures.texture_pictures(result.asset), **result.pictures},
        curve=[(p.seconds, p.step, p.psnr, p.loss) for p in curve],
        charts=result.charts,
        notes=result.notes,
        columns={name: text for name, text in told.items() if text},
        sizes=sizes,
        links=_links(folder, result.files),
        motion=result.motion(),
        **{f.name: getattr(shown, f.name) for f in fields(shown)},
    )
    write_report(folder, data)


def looks_at(reference: Reference) -> Looks:
    """How finely a report looks: where images take long, no finer than those that are kept."""
    if not isinstance(reference, Album):
        return LOOKS
    size = min(reference.resolution, LOOKS.resolution)
    return replace(LOOKS, resolution=size, pictured=size)


def write_compare_report(
    folder: Path,
    reference: Asset,
    candidate: Asset,
    placement: Placement,
    result: Comparison,
    options: CompareOptions,
    motion: Motion | None = None,
) -> None:
    """Report of a comparison; ``motion``: of characters."""
    original, other = placement.local(reference), placement.local(candidate)
    points = np.concatenate([a.points() for a in (original, other)])
    drawn = MeshReference(original)
    hero = picture_upright(drawn, original, other, support(points), LOOKS.pictured)
    most = [int(k) for k in np.argsort([-v.flip for v in result.metrics.views])][:MOST_VIEWS]
    data = ReportData(
        title=f"{candidate.name} against {reference.name}",
        facts=_versions(),
        options=_options(options),
        metrics={"candidate": result.metrics},
        by_size=at_sizes(result.reference, result.candidate, result.metrics),
        views=[
            hero.pictures,
            *(
                {
                    "reference": pictures.picture(result.reference[k]),
                    "result": pictures.picture(result.candidate[k]),
                }
                for k in most
            ),
        ],
        captions=[hero.caption, *(f"random view {k + 1} of {options.views}" for k in most)],
        maps=pictures.texture_pictures(candidate),
        notes=[*reference.notes, *candidate.notes],
        columns={"candidate": f"{candidate.name}, called the result on this page"},
        sizes={
            "original": sizes_of(reference, reference.files),
            "result": sizes_of(candidate, candidate.files),
        },
        links=_links(folder, (*reference.files[:1], *candidate.files[:1])),
        previews={"original": preview_of(original), "result": preview_of(other)},
        azimuth=hero.azimuth,
        elevation=hero.elevation,
        motion=motion,
    )
    write_report(folder, data)


def _facts(result: Result) -> dict[str, object]:
    facts, fit = dict(result.facts), result.fit
    if fit is not None:
        speed = fit.steps / max(fit.seconds, 1e-9)
        facts["steps"] = f"{fit.steps} ({speed:.1f} per second), best at {fit.best_step}"
        facts |= {"skipped steps": fit.skipped, "triangles turned back": fit.unfolded}
    facts["seconds by stage"] = ", ".join(f"{k} {v:.1f}" for k, v in result.seconds.items())
    return {**facts, **_versions()}


def _versions() -> dict[str, object]:
    return {f"version of {k}": v for k, v in backend.versions().items()}


def _options(options: Record) -> list[Option]:
    """What was asked for, in the words of the command line's help."""
    known = entries(type(options))
    return [
        Option(
            f"--{flag_name(key)}",
            ",".join(map(str, value)) if isinstance(value, tuple) else value,
            known[key].spec.help,
            value == known[key].default,
        )
        for key, value in as_dict(options).items()
        if value is not None
    ]


def _links(folder: Path, files: Iterable[Path]) -> dict[str, str]:
    """Files by name, relative to the report's folder."""
    out = {path.name: os.path.relpath(path, folder) for path in files}
    listed = dict(list(out.items())[:MOST_LINKS])
    return {**listed, "report.json (all numbers)": "report.json"}
