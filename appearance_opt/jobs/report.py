"""Reports of the jobs: held-out views rendered, measured, and written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt import backend
from appearance_opt.baking.encode import coverage_picture
from appearance_opt.config import as_dict
from appearance_opt.evaluate import pictures
from appearance_opt.evaluate.comparison import Comparison, render_asset
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.evaluate.report import ReportData, write_report
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.render.rays import MISS, trace
from appearance_opt.views import MEASURED, Views

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.config import BakeOptions, CommonOptions
    from appearance_opt.evaluate.metrics import Metrics
    from appearance_opt.jobs.bake import BakeResult
    from appearance_opt.jobs.simplify import SimplifyResult
    from appearance_opt.placement import Placement
    from appearance_opt.views import ViewSampler

VIEWS, RESOLUTION, SAMPLES = 8, 384, 9
PICTURED = 4


def write_simplify_report(
    folder: Path,
    source: Asset,
    result: SimplifyResult,
    sampler: ViewSampler,
    placement: Placement,
    options: CommonOptions,
) -> None:
    """Report of a simplification: start and result against the source."""
    names = ("start", f"level {max(result.tessellated)}" if result.tessellated else "result")
    metrics, per_view = _measure(source, result.start, result.shown, names, sampler, placement)
    metrics.update(_level_metrics(source, result, sampler, placement))
    data = ReportData(
        title=f"{source.name}: {result.source_triangles:,} to {result.triangles:,} triangles",
        facts=_facts(result, options),
        metrics=metrics,
        views=per_view,
        maps=pictures.texture_pictures(result.asset),
        curve=[(p.seconds, p.step, p.psnr, p.loss) for p in result.fit.curve],
        notes=result.notes,
    )
    write_report(folder, data)


def _level_metrics(
    source: Asset, result: SimplifyResult, sampler: ViewSampler, placement: Placement
) -> dict[str, Metrics]:
    """The coarser tessellation levels on the same views."""
    if len(result.tessellated) < 2:
        return {}
    views = sampler.held_out(MEASURED).draw(0, VIEWS)
    reference = render_asset(placement.local(source), views, RESOLUTION, SAMPLES)
    return {
        f"level {k}": compare_images(
            reference, render_asset(placement.local(a), views, RESOLUTION, SAMPLES)
        )
        for k, a in sorted(result.tessellated.items())[:-1]
    }


def write_bake_report(
    folder: Path,
    high: Asset,
    result: BakeResult,
    sampler: ViewSampler,
    placement: Placement,
    options: BakeOptions,
) -> None:
    """Report of a bake: closed form and fit against HIGH (as it was aligned)."""
    names = ("closed form", "fitted" if result.fit is not None else "result")
    metrics, per_view = _measure(high, result.closed_form, result.asset, names, sampler, placement)
    fit = result.fit
    facts: dict[str, object] = {
        "triangles": f"{result.asset.triangle_count} of {high.triangle_count}",
        "missed texels": f"{100 * result.missed_share:.3f} % of {int(result.covered.sum())}",
        "reach of the rays (m)": f"{result.reach:.6g}",
        "seconds by stage": ", ".join(f"{k} {v:.1f}" for k, v in result.seconds.items()),
    }
    if fit is not None:
        facts["steps"] = (
            f"{fit.steps} ({fit.steps / max(fit.seconds, 1e-9):.1f} per second), best at {fit.best_step}"
        )
    maps = pictures.texture_pictures(result.asset)
    maps["coverage (red: missed)"] = coverage_picture(result.covered, result.missed)
    data = ReportData(
        title=f"{high.name} baked to {result.asset.name}",
        facts={**facts, **_settings(options)},
        metrics=metrics,
        views=per_view,
        maps=maps,
        curve=[] if fit is None else [(p.seconds, p.step, p.psnr, p.loss) for p in fit.curve],
        notes=result.notes,
    )
    write_report(folder, data)


def _measure(
    source: Asset,
    start: Asset,
    result: Asset,
    names: tuple[str, str],
    sampler: ViewSampler,
    placement: Placement,
) -> tuple[dict[str, Metrics], list[dict[str, NDArray[np.uint8]]]]:
    """(metrics of start and result, which ``names`` names, on held-out views of the source;
    pictures of some of the views). One column is left out if the two are the same."""
    views = sampler.held_out(MEASURED).draw(0, VIEWS)
    reference, last = (
        render_asset(placement.local(a), views, RESOLUTION, SAMPLES) for a in (source, result)
    )
    first = (
        last
        if start is result
        else render_asset(placement.local(start), views, RESOLUTION, SAMPLES)
    )
    triangles = triangle_images(placement.local(result), views[:PICTURED], 2 * RESOLUTION)
    metrics = {names[0]: compare_images(reference, first)}
    if start is not result:
        metrics[names[1]] = compare_images(reference, last)
    per_view = []
    for r, s, a, t in zip(reference, first, last, triangles, strict=False):
        shown = {
            "reference": pictures.picture(r),
            "result": pictures.picture(a),
            "difference x 4": pictures.difference(r, a),
            "wireframe": pictures.wireframe(a, t),
        }
        if start is not result:
            shown[names[0]] = pictures.picture(s)
            shown[f"{names[0]}'s difference x 4"] = pictures.difference(r, s)
        per_view.append(shown)
    return metrics, per_view


def write_compare_report(
    folder: Path, reference: Asset, candidate: Asset, result: Comparison
) -> None:
    """Report of a comparison."""
    per_view = []
    for r, c in zip(result.reference, result.candidate, strict=True):
        shown = {"reference": pictures.picture(r), "result": pictures.picture(c)}
        per_view.append({**shown, "difference x 4": pictures.difference(r, c)})
    data = ReportData(
        title=f"{candidate.name} against {reference.name}",
        facts={
            "reference triangles": reference.triangle_count,
            "candidate triangles": candidate.triangle_count,
        },
        metrics={"candidate": result.metrics},
        views=per_view,
        notes=[*reference.notes, *candidate.notes],
    )
    write_report(folder, data)


def triangle_images(asset: Asset, views: Views, resolution: int) -> NDArray[np.int64]:
    """(B, H, W) index of the triangle seen in each pixel, -1 for none."""
    import mitsuba as mi

    scene = MeshReference(asset).scene
    count = resolution * resolution
    out = []
    y, x = np.divmod(np.arange(count), resolution)
    for k in range(len(views)):
        view = mi.UInt32(np.zeros(count, np.uint32))
        px, py = mi.Float((x + 0.5).astype(np.float32)), mi.Float((y + 0.5).astype(np.float32))
        hits = trace(scene, views[k : k + 1].records(), view, px, py, mi.Float(resolution))
        triangle = np.array(hits.triangle).astype(np.int64)
        out.append(np.where(triangle == MISS, -1, triangle).reshape(resolution, resolution))
    return np.stack(out)


def _facts(result: SimplifyResult, options: CommonOptions) -> dict[str, object]:
    fit = result.fit
    facts: dict[str, object] = {
        "triangles": f"{result.triangles} of {result.source_triangles}",
        "steps": f"{fit.steps} ({fit.steps / max(fit.seconds, 1e-9):.1f} per second), best at {fit.best_step}",
        "skipped steps": fit.skipped,
        "triangles turned back": fit.unfolded,
        "seconds by stage": ", ".join(f"{k} {v:.1f}" for k, v in result.seconds.items()),
    }
    return {**facts, **_settings(options)}


def _settings(options: CommonOptions) -> dict[str, object]:
    facts: dict[str, object] = {
        f"option {k.replace('_', ' ')}": v for k, v in as_dict(options).items() if v is not None
    }
    facts.update({f"version of {k}": v for k, v in backend.versions().items()})
    return facts
