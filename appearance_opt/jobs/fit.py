"""Fit a mesh and its maps to anything that renders."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appearance_opt import backend
from appearance_opt.asset.types import Asset
from appearance_opt.baking import check
from appearance_opt.baking.target_mesh import movable, prepare, unwrap_asset
from appearance_opt.config import SimplifyOptions, resolve_options
from appearance_opt.errors import InputError
from appearance_opt.jobs.lifecycle import close_run, load_layout, name_of, open_run, write_levels
from appearance_opt.jobs.paths import Outputs
from appearance_opt.jobs.result import SimplifyResult
from appearance_opt.reference.subject import Subject
from appearance_opt.stages.choice import choose_start
from appearance_opt.stages.export import Exporter, export, with_lighting
from appearance_opt.stages.fitting import fit_start
from appearance_opt.stages.parts import Parts, split
from appearance_opt.stages.start import localize

if TYPE_CHECKING:
    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.progress import Progress
    from appearance_opt.reference.base import Reference
    from appearance_opt.stages.run import Run


def fit(
    reference: Reference,
    start: Asset | Path | str | int = "sphere",
    options: SimplifyOptions | None = None,
    *,
    out: str | Path | None = None,
    report: str | Path | None = None,
    progress: Progress | None = None,
    began: float | None = None,
    **values: Any,
) -> SimplifyResult:
    """Fit a mesh with maps to the images of ``reference``, and write it to ``out`` (None: do not
    write).

    ``reference``: any object with ``bounds`` and ``render`` (see ``Reference``), in any unit and
    place; with ``pair``, too, single rays are compared (see ``PointReference``). ``start``: an
    asset or a file, whose shape and look are the start, on its own atlas if it has one; "sphere"
    (``triangles=N`` says of how many), or N alone. ``options``, ``values``, ``report``,
    ``progress``, ``began``: as for ``simplify``. Returns the asset, its curve (``result.fit``),
    whose PSNR is of views that the fit does not see, and what it started from. Raises
    AppearanceError.
    """
    for name in ("bounds", "render"):
        if not hasattr(reference, name) or isinstance(reference, Asset):
            raise InputError(
                f"{type(reference).__name__}: is no reference, which has bounds and "
                "render(views, resolution, samples); an asset is drawn by "
                "reference.mesh.MeshReference, or simplified"
            )
    options = resolve_options(SimplifyOptions, options, _asked(start, options, values))
    outputs = Outputs.of(out, options, report=report)
    with open_run(outputs, (start,), options, progress, began) as run:
        backend.select(options.device)
        run.begin("preparing the start")
        given = None if isinstance(start, int) or start == "sphere" else start
        parts = None if given is None else _read(given, options)
        outputs.check_inputs(None if parts is None else parts.whole)
        outputs.check_room(options.start.triangles or 0, options)
        run.lap("load")
        subject = Subject.of_reference(reference, options.views.seed, options.views.light)
        run.lap("reference")
        result = _fit(subject, parts, options, run)
        beside = partial(write_levels, result, options)
        close_run(run, result, outputs, options, lambda: subject, beside)
    return result


def _asked(
    start: Asset | Path | str | int, options: SimplifyOptions | None, values: dict[str, Any]
) -> dict[str, Any]:
    """``values`` with what ``start`` says: it is the shape, so that no triangles are counted."""
    if isinstance(start, bool) or (isinstance(start, int) and start < 1):
        raise InputError(f"a fit cannot start from {start}: give a number of triangles")
    if isinstance(start, int):
        return {"ratio": None, **values, "init": "sphere", "triangles": start}
    if start == "sphere":
        if "triangles" not in values and (options is None or options.start.triangles is None):
            raise InputError("a sphere needs a number of triangles: give triangles=N")
        return {"ratio": None, **values, "init": "sphere"}
    count = start.triangle_count if isinstance(start, Asset) else 1
    return {**values, "init": "decimate", "ratio": None, "triangles": max(count, 1)}


def _read(start: Asset | Path | str, options: SimplifyOptions) -> Parts:
    """What of a start is fitted, on an atlas of its own, and what of it is left alone."""
    asset = load_layout(start, options, options.asset.missing_textures)
    kept = options.parts.keep
    parts = split(asset, name_of(start), "start from", by_light=False, named=kept)
    parts = parts.merged() if options.parts.parts == "merge" else parts
    try:
        check.check_uvs(parts.fitted, name_of(start))
        check.check_overlap(prepare(parts.fitted).mesh, name_of(start))
    except InputError:
        return replace(parts, fitted=unwrap_asset(parts.fitted, options.texture.size))
    return parts


def _fit(
    subject: Subject, parts: Parts | None, options: SimplifyOptions, run: Run
) -> SimplifyResult:
    """A start and its fit. What is known of the surface of the reference is the start's."""
    mesh: LatentMesh | None = None
    notes: tuple[str, ...] = ()
    like, placement = Asset((), "fitted"), subject.placement
    if parts is not None:
        like, notes = parts.fitted, parts.fitted.notes
        mesh = localize(movable(prepare(like).mesh), placement, like.origin)
        subject = subject.with_likeness(parts.fitted)
    start, left = choose_start(subject, mesh, options, run)
    run.lap("start")
    model, fitted, error = fit_start(subject, start, left, run)
    like = with_lighting(like, subject)
    exported = export(model, start, subject, left, Exporter(placement, like, like.name))
    run.lap("export")
    parts = Parts(exported.asset) if parts is None else parts
    told = [*notes, *start.notes]
    return SimplifyResult.of(exported, parts, fitted, (like.name, 0), told, error)
