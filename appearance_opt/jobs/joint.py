"""Bake with the shape free: LOW's vertices, a displacement map, normals and material fitted
together."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appearance_opt.baking.closed_form import Settings, bake
from appearance_opt.baking.target_mesh import movable
from appearance_opt.config import JointOptions, resolve_options, with_values
from appearance_opt.jobs.lifecycle import close_run, open_run, read_pair, write_levels
from appearance_opt.jobs.paths import Outputs
from appearance_opt.jobs.result import SimplifyResult
from appearance_opt.stages.displacement import bake_displacement
from appearance_opt.stages.export import Exporter, export
from appearance_opt.stages.fitting import fit_start
from appearance_opt.stages.start import Start, select_told

if TYPE_CHECKING:
    from collections.abc import Iterable

    from appearance_opt.asset.types import Asset
    from appearance_opt.progress import Progress
    from appearance_opt.stages.pair import Pair
    from appearance_opt.stages.run import Run


def joint(
    high: str | Path | Asset,
    low: str | Path | Asset,
    out: str | Path | None,
    options: JointOptions | None = None,
    *,
    report: str | Path | None = None,
    progress: Progress | None = None,
    began: float | None = None,
    inputs: Iterable[str | Path] = (),
    **values: Any,
) -> SimplifyResult:
    """Fit base shape, displacement, normals and material of ``low`` to ``high`` and write the
    result to ``out`` (None: do not write). LOW keeps its topology and its texture coordinates; each
    kind of detail goes where it is represented best. ``values``: options by flat key, instead of
    ``options`` or over them. ``inputs``: other files that must not be replaced. Raises
    AppearanceError."""
    options = resolve_options(JointOptions, options, values)
    outputs = Outputs.of(out, options, report=report)
    with open_run(outputs, (high, low, *inputs), options, progress, began) as run:
        pair = read_pair(high, low, outputs, options, run)
        result = _fit(pair, options, run)
        beside = partial(write_levels, result, options)
        close_run(run, result, outputs, options, pair.shown, beside)
    return result


def _fit(pair: Pair, options: JointOptions, run: Run) -> SimplifyResult:
    """The closed form, displacement first, and the fit that starts from it."""
    mesh, survey, subject = movable(pair.mesh), pair.survey, pair.subject
    drawn, displacement = bake_displacement(survey, mesh, options, pair.cage)
    settings = Settings(options.texture.size, samples=options.baking.samples)
    found = bake(survey, drawn, settings)
    pair.check_missed(found)
    maps = {**select_told(subject.unlit, found.maps), **displacement}
    start = Start(mesh, maps, True, found.covered, options.levels())
    run.lap("closed form")
    fitted = tuple(dict.fromkeys(("shape", *options.fit.parts)))
    model, fit, error = fit_start(subject, start, with_values(options, fit=fitted), run)
    light = pair.low_parts.fitted
    exporter = Exporter(subject.placement, light, light.name)
    exported = export(model, start, subject, options, exporter)
    run.lap("export")
    source = (pair.high.name, len(survey.triangles.faces))
    return SimplifyResult.of(exported, pair.low_parts, fit, source, pair.notes, error)
