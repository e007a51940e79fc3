"""Bake: a heavy asset's look in the maps of a light one, which keeps its shape and its texture
coordinates."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appearance_opt.baking.closed_form import bake as bake_closed_form
from appearance_opt.baking.encode import coverage_picture, loose_files
from appearance_opt.config import BakeOptions, resolve_options, with_values
from appearance_opt.jobs.lifecycle import close_run, open_run, read_pair
from appearance_opt.jobs.paths import Outputs
from appearance_opt.jobs.result import BakeResult
from appearance_opt.stages.fitting import fit_start
from appearance_opt.stages.maps import (
    FITTED,
    bake_settings,
    fitted_parts,
    has_place,
    in_metres,
    with_maps,
)
from appearance_opt.stages.start import Start, select_told

if TYPE_CHECKING:
    from collections.abc import Iterable

    from appearance_opt.asset.types import Asset
    from appearance_opt.progress import Progress
    from appearance_opt.publish import Publication
    from appearance_opt.stages.pair import Pair
    from appearance_opt.stages.run import Run


def bake(
    high: str | Path | Asset,
    low: str | Path | Asset,
    out: str | Path | None,
    options: BakeOptions | None = None,
    *,
    report: str | Path | None = None,
    loose: str | Path | None = None,
    progress: Progress | None = None,
    began: float | None = None,
    inputs: Iterable[str | Path] = (),
    **values: Any,
) -> BakeResult:
    """Bake ``high`` to ``low`` (paths or assets) and write LOW with its new maps to ``out`` (None:
    do not write).

    ``values``: options by flat key, instead of ``options`` or over them: ``closed_form=True``.
    ``report``: folder for pictures, metrics and report.html. ``loose``: folder for the maps as
    loose files; maps for which the format of ``out`` has no place are always written, by default to
    ``<out's stem>_maps``. ``inputs``: other files that must not be replaced. Raises
    AppearanceError.
    """
    options = resolve_options(BakeOptions, options, values)
    outputs = Outputs.of(out, options, report=report, loose=loose)
    with open_run(outputs, (high, low, *inputs), options, progress, began) as run:
        pair = read_pair(high, low, outputs, options, run)
        result = _bake(pair, options, run)
        beside = partial(_write_loose, result, options, outputs.loose)
        close_run(run, result, outputs, options, pair.shown, beside)
    return result


def _bake(pair: Pair, options: BakeOptions, run: Run) -> BakeResult:
    """The closed form, and the fit that starts from it."""
    run.begin("casting rays from texels")
    baked = bake_closed_form(pair.survey, pair.mesh, bake_settings(pair, options))
    pair.check_missed(baked)
    run.lap("closed form")
    maps = in_metres(baked.maps, pair.scale)
    closed, reach = with_maps(pair, maps, options), baked.reach * pair.scale
    result = BakeResult(
        closed,
        {"closed form": closed},
        title=f"{pair.high.name} baked to {closed.name}",
        facts={
            "triangles": f"{closed.triangle_count} of {pair.high.triangle_count}",
            "missed texels": f"{100 * baked.missed_share:.3f} % of {int(baked.covered.sum())}",
            "reach of the rays (m)": f"{reach:.6g}",
        },
        pictures={"coverage (red: missed)": coverage_picture(baked.covered, baked.missed)},
        notes=pair.notes,
        maps=maps,
        covered=baked.covered,
        missed=baked.missed,
        reach=reach,
    )
    parts = fitted_parts(options, pair.subject.unlit)
    if not parts:
        return result
    told = select_told(pair.subject.unlit, {n: baked.maps[n] for n in FITTED})
    start = Start(pair.mesh, told, True, baked.covered)
    model, fit, error = fit_start(pair.subject, start, with_values(options, fit=parts), run)
    # gutters were filled before the fit, which moved those that lookups reach: filling again would
    # undo that
    maps = in_metres({**baked.maps, **model.host_maps()}, pair.scale)
    asset, notes = with_maps(pair, maps, options), [*pair.notes, *fit.notes()]
    columns = {**result.columns, "fitted": asset}
    run.lap("export")
    return replace(
        result, asset=asset, columns=columns, maps=maps, fit=fit, notes=notes, error=error
    )


def _write_loose(
    result: BakeResult, options: BakeOptions, folder: Path | None, out: Path, together: Publication
) -> None:
    """Loose files, if asked for or if the format of ``out`` has no place for one of the maps."""
    if folder is None and has_place(out, options):
        return
    target = out.with_name(out.stem + "_maps") if folder is None else folder
    files = loose_files(result.maps, result.covered, result.missed, options.baking, out.stem)
    for name, data in files.items():
        together.place(target / name).write_bytes(data)
