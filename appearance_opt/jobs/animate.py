"""An animated character in, a light one with the same joints and clips out, fitted over all of its
frames."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt import backend
from appearance_opt.asset.origin import ZERO
from appearance_opt.asset.posing import pose_asset
from appearance_opt.config import AnimateOptions, resolve_options, with_values
from appearance_opt.errors import InputError
from appearance_opt.evaluate.motion import show_motion
from appearance_opt.jobs.lifecycle import close_run, load_source, name_of, open_run
from appearance_opt.jobs.paths import Outputs
from appearance_opt.jobs.result import SimplifyResult
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.skinning import SkinWeights, prune
from appearance_opt.optimize.validation import FrameValidation, Validation
from appearance_opt.stages.animation import Animation
from appearance_opt.stages.choice import choose_start
from appearance_opt.stages.export import Exporter, export
from appearance_opt.stages.fitting import POOL_SAMPLES, clean_maps, fit_latent, point_width
from appearance_opt.stages.parts import split
from appearance_opt.views import MEASURED, VALIDATION

if TYPE_CHECKING:
    from collections.abc import Iterable

    from appearance_opt.asset.rig import Skin
    from appearance_opt.asset.types import Asset
    from appearance_opt.evaluate.motion import Motion
    from appearance_opt.latent.latent import Latent
    from appearance_opt.optimize.loop import FitResult
    from appearance_opt.progress import Progress
    from appearance_opt.stages.animation import Frame
    from appearance_opt.stages.parts import Parts
    from appearance_opt.stages.run import Run
    from appearance_opt.stages.start import Start

LOOKED_AT, VIEWS_EACH = 6, 2
"""Frames by which a fit keeps its best state, and held-out views of each."""

MEASURED_FRAMES, MEASURED_VIEWS, MEASURED_RESOLUTION = 24, 4, 256
"""Frames whose error is told, and views of each that nothing was ever chosen by."""

WIDE_SHARE = 0.7
"""Part of the fit in which vertices choose among the bones of their support; the rest is fitted
with as many as the result may have."""


@dataclass(frozen=True)
class FrameErrors:
    """PSNR in dB over covered pixels of some ``frames`` (their names), of the start, after the fit
    with the whole support, with the weights pruned, and of the result."""

    frames: tuple[str, ...]
    start: tuple[float, ...]
    wide: tuple[float, ...]
    pruned: tuple[float, ...]
    result: tuple[float, ...]

    def lines(self) -> dict[str, str]:
        """What a report says of it."""
        names = ("start", "wide", "pruned", "result")
        means = ", ".join(f"{n} {np.mean(getattr(self, n)):.2f}" for n in names)
        worst = int(np.argmin(self.result))
        spread = max(self.result) - min(self.result)
        return {
            "PSNR over frames (dB)": means,
            "worst frame": f"{self.frames[worst]}, {self.result[worst]:.2f} dB",
            "best and worst frame differ by": f"{spread:.2f} dB (start {np.ptp(self.start):.2f})",
            "PSNR by frame (dB)": ", ".join(
                f"{f}: {e:.2f}" for f, e in zip(self.frames, self.result, strict=True)
            ),
        }


@dataclass
class AnimateResult(SimplifyResult):
    """``asset``: with the rig of the source. ``errors``: by frame; None without a report.
    ``source``: what it is filmed beside; ``worst``: the frame with the largest error."""

    errors: FrameErrors | None = None
    source: Asset | None = None
    worst: Frame | None = None

    def motion(self) -> Motion | None:
        """A film of the clip in which the worst frame is."""
        if self.errors is None or self.source is None or self.worst is None:
            return None
        errors = {"start": self.errors.start, "result": self.errors.result}
        clip, time = self.worst.clip, self.worst.time
        return show_motion(self.source, self.asset, clip, time, self.errors.frames, errors)

    def record(self) -> dict[str, Any]:
        """The same as of a simplification, and the errors by frame."""
        return super().record() | {"errors": None if self.errors is None else asdict(self.errors)}


def animate(
    source: str | Path | Asset,
    out: str | Path | None,
    options: AnimateOptions | None = None,
    *,
    report: str | Path | None = None,
    progress: Progress | None = None,
    began: float | None = None,
    inputs: Iterable[str | Path] = (),
    **values: Any,
) -> AnimateResult:
    """Simplify an animated ``source`` (a path, or an asset read with ``keep_rig``) and write the
    result, which has the same joints and clips, to ``out`` (None: do not write).

    Bind pose, skinning weights and maps are fitted over the frames of its clips (Hasselgren et al.
    2021, section 4.3). ``values``: options by flat key. ``inputs``: other files that must not be
    replaced. Raises AppearanceError.
    """
    options = resolve_options(AnimateOptions, options, values)
    outputs = Outputs.of(out, options, report=report)
    if out is not None and Path(out).suffix.lower() == ".obj":
        raise InputError(f"{out}: OBJ files hold no skeleton; write .glb, .gltf or .usd*")
    if options.start.file is not None:
        raise InputError("--init: animate starts from decimate or sphere")
    with open_run(outputs, (source, *inputs), options, progress, began) as run:
        run.begin(f"reading {Path(name_of(source)).name}")
        asset = load_source(source, options, keep_rig=True)
        outputs.check_inputs(asset)
        parts = split(asset, name_of(source), "animate")
        run.lap("load")
        backend.select(options.device)
        run.begin(f"posing {parts.fitted.triangle_count:,} triangles")
        animation = Animation.of(parts.fitted, options.animation, options.views)
        run.lap("reference")
        result, worst = _fit(animation, parts, options, run)
        close_run(run, result, outputs, options, lambda: animation.at(worst))
    return result


def _fit(
    animation: Animation, parts: Parts, options: AnimateOptions, run: Run
) -> tuple[AnimateResult, int]:
    """(what came of it, number of the frame that is worst)."""
    subject, asset = animation.subject, parts.fitted
    start, left = choose_start(subject, None, options, run)
    run.lap("start")
    run.interrupts.protect()
    given = animation.transfer_skin(start.mesh, options.animation.support)
    frames = animation.device_frames()
    fitted = frozenset(left.fit.parts)
    model = latent_of(start.mesh, start.maps, fitted, skinned=(given, frames))
    pool = animation.pool(
        left.views, POOL_SAMPLES, point_width(left.views.resolution, left.texture.size)
    )
    seen = _spread(len(animation.frames), LOOKED_AT)
    validation = _validation(
        animation, seen, VALIDATION, VIEWS_EACH, min(left.views.resolution, 256)
    )
    steps = left.fit.steps
    first = left if steps is None else with_values(left, steps=round(WIDE_SHARE * steps))
    judge = _judge(animation) if run.with_report else None
    scores = {"start": [] if judge is None else judge.scores(model)}
    fit, error = fit_latent(model, pool, validation, start, first, run, WIDE_SHARE)
    scores["wide"] = [] if judge is None else judge.scores(model)
    skin = prune(_skin_of(model), options.animation.influences)
    mesh = replace(start.mesh, positions=model.host_positions())
    maps = {**start.maps, **model.constants, **model.host_maps()}
    model = latent_of(mesh, maps, fitted, skinned=(skin, frames))
    scores["pruned"] = [] if judge is None else judge.scores(model)
    if error is None and not fit.interrupted:
        rest = left if steps is None else with_values(left, steps=steps - round(WIDE_SHARE * steps))
        again, error = fit_latent(
            model, pool, validation, replace(start, mesh=mesh, maps=maps), rest, run
        )
        fit = _joined(fit, again)
    scores["result"] = [] if judge is None else judge.scores(model)
    result = _exported(animation, parts, start, model, given, left, fit)
    run.lap("export")
    worst = 0
    if judge is not None:
        names = tuple(str(animation.frames[k]) for k, _ in judge.frames)
        errors = FrameErrors(names, **{k: tuple(v) for k, v in scores.items()})  # type: ignore[arg-type]
        worst = judge.frames[int(np.argmin(errors.result))][0]
        result.source = parts.with_kept(animation.asset)
        result.worst = animation.frames[worst]
        result.errors, result.facts = errors, {**result.facts, **errors.lines()}
    result.columns = {n: _at(animation, a, worst) for n, a in result.columns.items()}
    result.notes = [*asset.notes, *start.notes, *result.notes]
    result.error = error
    return result, worst


def _spread(count: int, most: int) -> list[int]:
    """At most ``most`` of so many frames, evenly."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)).tolist()


def _validation(
    animation: Animation, frames: list[int], stream: int, views: int, resolution: int
) -> FrameValidation:
    return FrameValidation(
        [
            (
                k,
                Validation(
                    animation.reference.at(k),
                    animation.samplers[k].held_out(stream).draw(k, views),
                    resolution,
                ),
            )
            for k in frames
        ]
    )


def _judge(animation: Animation) -> FrameValidation:
    seen = _spread(len(animation.frames), MEASURED_FRAMES)
    return _validation(animation, seen, MEASURED, MEASURED_VIEWS, MEASURED_RESOLUTION)


def _skin_of(model: Latent) -> Skin:
    part = model.part(SkinWeights)
    assert part is not None
    return part.skin()


def _joined(first: FitResult, then: FitResult) -> FitResult:
    """Two fits, one after the other, as one."""
    later = [
        replace(p, seconds=p.seconds + first.seconds, step=p.step + first.steps) for p in then.curve
    ]
    return replace(
        then,
        curve=[*first.curve, *later],
        steps=first.steps + then.steps,
        skipped=first.skipped + then.skipped,
        seconds=first.seconds + then.seconds,
        best_step=first.steps + then.best_step,
    )


def _exported(
    animation: Animation,
    parts: Parts,
    start: Start,
    model: Latent,
    given: Skin,
    options: AnimateOptions,
    fit: FitResult,
) -> AnimateResult:
    """The fitted character, in its bind pose, with the rig of the source."""
    subject, asset = animation.subject, parts.fitted
    name = f"{asset.name}_{len(start.mesh.faces)}"
    maps = clean_maps(model, start.known)
    still = replace(start.mesh, positions=model.host_positions())
    bind = latent_of(still, maps, frozenset({"normal", "material"}))
    like = replace(asset, origin=ZERO, nodes=())  # the rig has a hierarchy of its own
    exporter = Exporter(subject.placement, like, name, _skin_of(model))
    exported = export(
        bind, replace(start, maps=maps, known=np.ones_like(start.known)), subject, options, exporter
    )
    begin = Exporter(subject.placement, like, name, given)
    before = begin.base(latent_of(start.mesh, start.maps), start.maps)
    with_rig = partial(replace, rig=animation.rig, contents=asset.contents)
    exported = replace(exported, asset=with_rig(exported.asset), start=with_rig(before))
    source = (asset.name, asset.triangle_count)
    made = SimplifyResult.of(exported, parts, fit, source, [])
    return AnimateResult(**vars(made))


def _at(animation: Animation, asset: Asset, frame: int) -> Asset:
    """The asset as it stands at a frame."""
    shown = animation.frames[frame]
    return pose_asset(asset, shown.clip, shown.time)
