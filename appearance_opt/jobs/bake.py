"""Bake: a heavy asset's look in the maps of a light one, which keeps its shape and its texture
coordinates."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt import backend
from appearance_opt.asset import load, write
from appearance_opt.asset.alpha import seen_through
from appearance_opt.config import BakeOptions, resolve_options, with_values
from appearance_opt.errors import DivergedError, InputError
from appearance_opt.interrupts import Interrupts
from appearance_opt.jobs.paths import Outputs
from appearance_opt.jobs.result import BakeResult
from appearance_opt.placement import Placement
from appearance_opt.publish import Publication, publication
from appearance_opt.stages.parts import split

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.baking.closed_form import BakedMaps
    from appearance_opt.baking.target_mesh import Low
    from appearance_opt.config import JointOptions
    from appearance_opt.fit.loop import Progress
    from appearance_opt.reference.subject import Subject
    from appearance_opt.stages.fitting import Stopwatch
    from appearance_opt.stages.parts import Parts

log = logging.getLogger(__name__)

MISSED_NOTE, MISSED_ERROR = 0.01, 0.5
"""Shares of missed texels from which on the user is told, and the bake is refused."""


def bake(
    high: str | Path | Asset,
    low: str | Path | Asset,
    out: str | Path | None,
    options: BakeOptions | None = None,
    *,
    report: str | Path | None = None,
    loose: str | Path | None = None,
    progress: Progress | None = None,
    variants: dict[str, str] | None = None,
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
    from appearance_opt.stages.fitting import Stopwatch

    watch = Stopwatch(began, progress)
    options = resolve_options(BakeOptions, options, values)
    outputs = Outputs.of(out, options, report=report, loose=loose)
    outputs.check()
    outputs.check_sources(high, low, *inputs)
    with outputs.held(), Interrupts() as interrupts:
        return _bake(high, low, outputs, options, progress, variants, watch, interrupts)


def _bake(
    high: str | Path | Asset,
    low: str | Path | Asset,
    outputs: Outputs,
    options: BakeOptions,
    progress: Progress | None,
    variants: dict[str, str] | None,
    watch: Stopwatch,
    interrupts: Interrupts,
) -> BakeResult:
    from appearance_opt.stages.fitting import conclude

    run = BakeJob(
        *read_pair(high, low, outputs, options, variants, watch), options, watch, interrupts
    )
    result, error = run.run(progress, outputs.report is not None)
    if outputs.out is not None:
        with publication() as together:
            write(result.asset, together.place(outputs.out), options.output.for_file(outputs.out))
            _write_loose(result, options, outputs.out, outputs.loose, together)
        watch.lap("write")
    interrupts.release()
    if error is not None:
        raise error

    def write_report() -> None:
        from appearance_opt.jobs.report import write_job_report

        assert outputs.report is not None
        write_job_report(outputs.report, result, run.shown(), options)

    conclude(result, watch, None if outputs.report is None else write_report)
    return result


def read_pair(
    high: str | Path | Asset,
    low: str | Path | Asset,
    outputs: Outputs,
    options: BakeOptions | JointOptions,
    variants: dict[str, str] | None,
    watch: Stopwatch,
) -> tuple[Parts, Parts, str]:
    """(what of HIGH is baked, what of LOW is baked onto, what to call LOW). Raises InputError if it
    is nothing, or if the outputs would replace a file of either."""
    from appearance_opt.jobs.simplify import load_source

    watch.begin("reading both meshes")
    heavy, light = load_source(high, options, variants), load_low(low, options)
    outputs.check_inputs(heavy, light)
    outputs.check_room(light.triangle_count, options)
    watch.lap("load")
    watch.begin(f"preparing {heavy.triangle_count:,} and {light.triangle_count:,} triangles")
    names = [str(a) if isinstance(a, (str, Path)) else a.name for a in (high, low)]
    return (
        split(heavy, f"HIGH, {names[0]}", "bake"),
        split(light, f"LOW, {names[1]}", "bake onto", False),
        names[1],
    )


def load_low(source: str | Path | Asset, options: BakeOptions | JointOptions) -> Asset:
    """LOW itself, or the file of that name with its vertices and texture coordinates as they
    are."""
    if not isinstance(source, (str, Path)):
        return source
    given = {"missing_textures": options.asset.missing_textures, "root": options.asset.root}
    return load(source, refine=options.asset.refine, keep_layout=True, **given)  # type: ignore[arg-type]


class BakeJob:
    """Both assets under one placement; then the closed form, then the fit. ``high``: all of HIGH,
    where it was aligned; ``low_parts``: what of LOW is baked onto, and what is left alone."""

    def __init__(
        self,
        high_parts: Parts,
        low_parts: Parts,
        name: str,
        options: BakeOptions | JointOptions,
        watch: Stopwatch,
        interrupts: Interrupts,
    ) -> None:
        from appearance_opt.baking import check
        from appearance_opt.baking.target_mesh import prepare, unwrap_asset
        from appearance_opt.reference.subject import Subject

        self.options, self.watch, self.interrupts, self.low_parts = (
            options,
            watch,
            interrupts,
            low_parts,
        )
        high, low = high_parts.fitted, low_parts.fitted
        self.notes = [*high.notes, *high_parts.describe_kept("of HIGH are not baked")]
        self.notes += [
            *(f"LOW: {n}" for n in low.notes),
            *low_parts.describe_kept("of LOW stay as they are"),
        ]
        self.high = high_parts.whole
        if options.baking.align:
            high, self.high = self._align(high_parts, low)
        check.check_place(high, low)
        if options.baking.unwrap:
            low = unwrap_asset(low, options.texture.size)
        check.check_uvs(low, name)
        backend.select(options.device)
        self.low: Low = prepare(low)
        if not options.baking.unwrap:
            check.check_overlap(self.low.mesh, name)
        watch.lap("check")
        self.placement = Placement.around(np.concatenate([high.points(), low.points()]))
        self.subject = Subject.of_asset(
            high, options.views.seed, options.views.light, self.placement
        )
        assert self.subject.survey is not None
        self.survey = self.subject.survey
        local = self.placement.relative_to(low.origin).to_local(self.low.mesh.positions)
        self.mesh = replace(self.low.mesh, positions=local.astype(np.float32))
        watch.lap("reference")

    def _align(self, high_parts: Parts, low: Asset) -> tuple[Asset, Asset]:
        """(what of HIGH is baked, all of it), aligned to what it is baked onto."""
        from appearance_opt.baking.align import align

        placed, scale, shift = align(high_parts.fitted, low)
        self.notes.append(
            f"HIGH was scaled by {scale:.6g} and moved by {', '.join(f'{x:.6g}' for x in shift)} m"
        )
        from_world = shift + scale * np.array(high_parts.fitted.origin) - low.origin
        kept = tuple(
            replace(
                m,
                positions=(m.positions.astype(np.float64) * scale + from_world).astype(np.float32),
            )
            for m in high_parts.kept
        )
        return placed, replace(high_parts, fitted=placed, kept=kept).whole

    def shown(self) -> Subject:
        """What a report compares with: all of HIGH, in views that show transparent parts, too."""
        from appearance_opt.reference.subject import Subject
        from appearance_opt.views import views_around

        low = self.low_parts.whole
        if not any(map(seen_through, (*self.high.meshes, *low.meshes))):
            return self.subject
        points = np.concatenate([self.high.points(), low.points()])
        placement, o = Placement.around(points), self.options
        sampler = views_around(placement.to_local(points), o.views.seed, o.views.light)
        return replace(Subject.of_asset(self.high, placement=placement), sampler=sampler)

    def run(
        self, progress: Progress | None, with_report: bool
    ) -> tuple[BakeResult, DivergedError | None]:
        """The closed form, and the fit that starts from it."""
        from appearance_opt.baking.closed_form import bake as bake_closed_form
        from appearance_opt.baking.encode import coverage_picture
        from appearance_opt.stages.fitting import fit_start
        from appearance_opt.stages.start import Start, select_told

        self.watch.begin("casting rays from texels")
        baked = bake_closed_form(self.survey, self.mesh, self._settings())
        self.check_missed(baked)
        self.watch.lap("closed form")
        closed = self._result(baked.maps)
        reach, missed = baked.reach * self.placement.scale, 100 * baked.missed_share
        count = closed.triangle_count
        result = BakeResult(
            closed,
            {"closed form": closed},
            title=f"{self.high.name} baked to {closed.name}",
            facts={
                "triangles": f"{count} of {self.high.triangle_count}",
                "missed texels": f"{missed:.3f} % of {int(baked.covered.sum())}",
                "reach of the rays (m)": f"{reach:.6g}",
            },
            pictures={"coverage (red: missed)": coverage_picture(baked.covered, baked.missed)},
            notes=self.notes,
            maps=self._in_metres(baked.maps),
            covered=baked.covered,
            missed=baked.missed,
            reach=reach,
        )
        parts = self._fitted_parts()
        if not parts:
            return result, None
        start = Start(
            self.mesh,
            select_told(self.subject.unlit, {n: baked.maps[n] for n in _FITTED}),
            True,
            baked.covered,
        )
        options = with_values(self.options, fit=parts)
        model, fitted, error = fit_start(
            self.subject.reference,
            self.subject.sampler,
            start,
            options,
            self.watch,
            interrupts=self.interrupts,
            progress=progress,
            with_report=with_report,
        )
        # gutters were filled before the fit, which moved those that lookups reach: filling again
        # would undo that
        maps = {**baked.maps, **model.host_maps()}
        result.fit, result.asset, result.maps = fitted, self._result(maps), self._in_metres(maps)
        result.columns["fitted"] = result.asset
        self.notes += fitted.notes()
        self.watch.lap("export")
        return result, error

    @property
    def cage(self) -> float | None:
        """``--cage`` in local units (see ``Placement``); None for the automatic one."""
        cage = self.options.baking.cage
        return None if cage is None else cage / self.placement.scale

    def _settings(self):
        from appearance_opt.baking.closed_form import FIELDS, Settings

        o, scale = self.options, self.placement.scale
        wanted = {n for n in FIELDS if o.baking.wants(n)}
        if not self.survey.emits and "emission" in wanted:
            wanted.remove("emission")
            if "emission" in o.baking.maps:
                self.notes.append("HIGH emits no light: there is no emission map")
        if o.baking.wants("base-color") or o.baking.wants("orm"):
            wanted.add("material")
        if self._fitted_parts():
            wanted |= {"material", "normal"}
        return Settings(
            o.texture.size,
            tuple(n for n in FIELDS if n in wanted),
            o.baking.samples,
            self.cage,
            o.baking.hit,  # type: ignore[arg-type]
            o.baking.ao_rays,
            float("inf") if o.baking.ao_distance is None else o.baking.ao_distance / scale,
        )

    def _fitted_parts(self) -> tuple[str, ...]:
        """What the fit moves: parts that are written. Colour and roughness are fitted together or
        not at all."""
        o = self.options
        if self.subject.unlit:
            written = {"normal": False, "material": o.baking.wants("base-color")}
        else:
            both = o.baking.wants("base-color") and o.baking.wants("orm")
            written = {"normal": o.baking.wants("normal"), "material": both}
        return () if o.baking.closed_form else tuple(p for p in o.fit.parts if written[p])

    def check_missed(self, baked: BakedMaps) -> None:
        """Raise InputError if most rays found nothing; a note if some did."""
        reach = f"{baked.reach * self.placement.scale:.4g} m"
        share = baked.missed_share
        if share > MISSED_ERROR:
            raise InputError(
                f"{100 * share:.0f} % of the rays found nothing of HIGH within {reach}: "
                "give a larger --cage, or --align if the two lie apart"
            )
        if share > MISSED_NOTE:
            self.notes.append(
                f"{100 * share:.1f} % of the texels found nothing within {reach} and were filled"
            )

    def _in_metres(self, maps: dict[str, NDArray]) -> dict[str, NDArray[np.float32]]:
        scale = self.placement.scale
        factors = {"displacement": scale, "curvature": 1 / scale}
        return {n: v * np.float32(factors[n]) if n in factors else v for n, v in maps.items()}

    def _result(self, maps: dict[str, NDArray]) -> Asset:
        from appearance_opt.baking.encode import material_change
        from appearance_opt.baking.target_mesh import with_material

        change = material_change(self._in_metres(maps), self.options.baking, self.subject.unlit)
        asset = with_material(self.low.asset, change)
        if self.options.baking.wants(
            "base-color"
        ):  # the map holds the whole colour: vertex colours would tint it again
            asset = replace(asset, meshes=tuple(replace(m, colors=None) for m in asset.meshes))
        return self.low_parts.with_kept(replace(asset, notes=()))


_FITTED = ("red", "green", "blue", "roughness", "metalness", "normal_x", "normal_y", "normal_z")


def _write_loose(
    result: BakeResult, options: BakeOptions, out: Path, folder: Path | None, together: Publication
) -> None:
    """Loose files, if asked for or if the format of ``out`` has no place for one of the maps."""
    from appearance_opt.baking.encode import loose_files

    placeless = (
        options.baking.wants("object-normal")
        or options.baking.wants("curvature")
        or options.baking.green == "directx"
    )
    placeless |= options.baking.wants("ao") and not options.baking.wants("orm")
    placeless |= options.baking.wants("displacement") and out.suffix.lower() == ".obj"
    if folder is None and not placeless:
        return
    target = out.with_name(out.stem + "_maps") if folder is None else folder
    for name, data in loose_files(
        result.maps, result.covered, result.missed, options.baking, out.stem
    ).items():
        together.place(target / name).write_bytes(data)
