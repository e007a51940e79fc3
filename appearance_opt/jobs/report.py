"""Reports of the jobs: held-out views rendered, measured, and written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt import backend
from appearance_opt.config import as_dict
from appearance_opt.evaluate import pictures
from appearance_opt.evaluate.comparison import Comparison, render_asset
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.evaluate.report import ReportData, write_report
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.pool import check_images
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.rays import trace_grid
from appearance_opt.views import MEASURED, Views

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.config import CommonOptions
    from appearance_opt.jobs.result import Result
    from appearance_opt.reference.subject import Subject

VIEWS, RESOLUTION, SAMPLES = 8, 384, 9
PICTURED = 4


def write_job_report(
    folder: Path, result: Result, subject: Subject, options: CommonOptions
) -> None:
    """Report of a job: what it started from and what came of it, against images of ``subject``."""
    views = subject.sampler.held_out(MEASURED).draw(0, VIEWS)
    drawn = subject.reference.render(views, RESOLUTION, SAMPLES)
    reference = check_images(drawn, VIEWS, RESOLUTION, "views of the report")
    local = {name: subject.placement.local(a) for name, a in result.columns.items()}
    images = {n: render_asset(a, views, RESOLUTION, SAMPLES) for n, a in local.items()}
    first, *_, last = [*images, *images]  # one and the same where nothing was fitted
    wires = triangle_images(local[last], views[:PICTURED], 2 * RESOLUTION)
    per_view = []
    for r, s, a, t in zip(reference, images[first], images[last], wires, strict=False):
        shown = {
            "reference": pictures.picture(r),
            "result": pictures.picture(a),
            "difference x 4": pictures.difference(r, a),
            "wireframe": pictures.wireframe(a, t),
        }
        if first != last:
            shown[first] = pictures.picture(s)
            shown[f"{first}'s difference x 4"] = pictures.difference(r, s)
        per_view.append(shown)
    curve = [] if result.fit is None else result.fit.curve
    data = ReportData(
        title=result.title,
        facts=_facts(result, options),
        metrics={name: compare_images(reference, image) for name, image in images.items()},
        views=per_view,
        maps={**pictures.texture_pictures(result.asset), **result.pictures},
        curve=[(p.seconds, p.step, p.psnr, p.loss) for p in curve],
        notes=result.notes,
    )
    write_report(folder, data)


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
    scene, grid = MeshReference(asset).scene, Grid(1, resolution)
    pixel = np.array(grid.index)
    out = np.empty((len(views), resolution * resolution), np.int64)
    for k in range(len(views)):
        hits, _ = trace_grid(scene, Batch(views[k : k + 1].records(), grid))
        triangle = np.array(hits.triangle).astype(np.int64)
        out[k, pixel] = np.where(triangle == MISS, -1, triangle)
    return out.reshape(len(views), resolution, resolution)


def _facts(result: Result, options: CommonOptions) -> dict[str, object]:
    facts, fit = dict(result.facts), result.fit
    if fit is not None:
        speed = fit.steps / max(fit.seconds, 1e-9)
        facts["steps"] = f"{fit.steps} ({speed:.1f} per second), best at {fit.best_step}"
        facts |= {"skipped steps": fit.skipped, "triangles turned back": fit.unfolded}
    facts["seconds by stage"] = ", ".join(f"{k} {v:.1f}" for k, v in result.seconds.items())
    given = {k: v for k, v in as_dict(options).items() if v is not None}
    facts |= {f"option {k.replace('_', ' ')}": v for k, v in given.items()}
    return {**facts, **{f"version of {k}": v for k, v in backend.versions().items()}}
