"""One fit: set up, timed, and measured at several times."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from appearance_opt.latent.build import latent_of
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.parts import Pose
from appearance_opt.latent.positions import Positions
from appearance_opt.latent.texels import Texels
from appearance_opt.optimize.loop import fit
from appearance_opt.optimize.plan import FitOptions, Plan
from appearance_opt.optimize.validation import Validation
from appearance_opt.reference.pool import ReferencePool
from appearance_opt.render.material import CHANNELS
from appearance_opt.stages.fitting import VALIDATION_VIEWS, fit_policy
from appearance_opt.views import VALIDATION
from experiments.speed_vs_error.recorder import Blind, Recorder, Snapshot

if TYPE_CHECKING:
    from appearance_opt.evaluate.metrics import Metrics
    from appearance_opt.stages.start import Start
    from experiments.speed_vs_error.setups import Setup
    from experiments.speed_vs_error.subjects import Bench

PARTS = frozenset(("shape", "normal", "material"))
FRACTIONS = (1 / 16, 1 / 8, 1 / 4, 1 / 2)
"""Parts of the time at which a fit is looked at, besides its start and its end."""

WARM_UP_STEPS = 12
"""Steps of a fit that is thrown away before each: kernels are compiled or loaded in it. More than
``optimize.plan.LOSS_EVERY``, so that both kinds of step occur."""

CONSTANT = {
    "red": 0.2, "green": 0.2, "blue": 0.2, "roughness": 0.5, "metalness": 0.0,
    "normal_x": 0.0, "normal_y": 0.0, "normal_z": 1.0,
}  # fmt: skip
"""Maps that know nothing: a grey dielectric."""


@dataclass(frozen=True)
class Point:
    """A fit after ``seconds``."""

    seconds: float
    step: int
    metrics: Metrics


def run(bench: Bench, setup: Setup, seconds: float) -> Run:
    """Fit for ``seconds``, set-up, warm-up and measuring not counted."""
    start = bench.start(setup.texture)
    maps = (
        start.maps
        if setup.closed_form
        else {n: np.full_like(start.maps[n], CONSTANT[n]) for n in start.maps}
    )
    start = replace(start, maps=maps)
    setup = replace(setup, rates=setup.rates or _rates(bench, start))
    snapshots = _timed(bench, start, setup, seconds)
    return Run(bench, start, snapshots, (setup.texture, setup.closed_form))


@dataclass(frozen=True)
class Run:
    """A fit that is over, not yet measured. ``which``: the start among those of the scene."""

    bench: Bench
    start: Start
    snapshots: list[Snapshot]
    which: tuple[int, bool]

    def measured(self, averaged: bool = True) -> list[Point]:
        """The start and every snapshot: the running means of the parameters, or their last
        values."""
        model = latent_of(self.start.mesh, self.start.maps, PARTS, Rates())
        points = [Point(0.0, 0, self.bench.measure_start(self.which, model))]
        for s in self.snapshots:
            model.restore(s.means if averaged else s.values)
            points.append(Point(s.seconds, s.step, self.bench.measure(model)))
        return points


def _timed(bench: Bench, start: Start, setup: Setup, seconds: float) -> list[Snapshot]:
    """Snapshots of the fit."""
    recorder = Recorder([f * seconds for f in FRACTIONS])
    phases: list[tuple[float | None, int]] = [(None, setup.resolution)]
    if setup.coarse is not None:
        phases.insert(0, (setup.coarse[0] * seconds, setup.coarse[1]))
    for stop, resolution in phases:
        _fit(
            bench,
            start,
            replace(setup, pool=2 * setup.views),
            resolution,
            Recorder(()),
            steps=WARM_UP_STEPS,
        )
        recorder.stop = stop
        _fit(bench, start, setup, resolution, recorder, seconds=seconds)
    return recorder.snapshots


def _fit(
    bench: Bench,
    start: Start,
    setup: Setup,
    resolution: int,
    recorder: Recorder,
    *,
    steps: int | None = None,
    seconds: float | None = None,
) -> None:
    """A fit of a fresh model, or one gone on with by the recorder, at one resolution."""
    model = _latent(start, setup)
    if setup.smoothing:
        positions = model.fitted(Positions)
        assert positions is not None
        positions.precondition(setup.smoothing, setup.smooth_rate * setup.rate_factor)
    sampler = replace(bench.sampler, seed=setup.seed)
    width = setup.width(resolution)
    pool = ReferencePool(
        bench.reference,
        sampler,
        setup.pool,
        setup.views,
        resolution,
        setup.pool_samples,
        width,
        setup.reuse,
    )
    options = FitOptions(
        steps=steps, seconds=seconds, loss=setup.loss, laplacian=setup.laplacian, relative=setup.relative,
        decay=setup.decay, quality=setup.quality, validate_every=2.0, seed=setup.seed,
    )  # fmt: skip
    plan = Plan.of(options, model.poses, pool.batch)
    if not setup.laplacian_decays:
        plan = replace(plan, laplacian=lambda _: 1.0)
    fit(model, pool, Blind(), options, [recorder], plan)
    dr.sync_thread()


def _latent(start: Start, setup: Setup) -> Latent:
    """The start, ready to be fitted."""
    if setup.mip:
        out = latent_of(start.mesh, start.maps, PARTS)
    else:
        images = {n: np.asarray(start.maps[n]) for n in CHANNELS if n in start.maps}
        parts = (Positions(start.mesh, True), Texels(images, True, levels=1))
        out = Latent(start.mesh, parts, {}, (Pose(),))
    out.set_rates(_scaled(setup.rates, setup.rate_factor))
    return out


def _rates(bench: Bench, start: Start) -> Rates:
    """The product's rule: from how good the start is."""
    views = bench.sampler.held_out(VALIDATION).draw(0, VALIDATION_VIEWS)
    model = latent_of(start.mesh, start.maps, frozenset(), Rates())
    return fit_policy(Validation(bench.reference, views, 256).psnr(model), start.relative)[1]


def _scaled(rates: Rates | None, factor: float) -> Rates:
    assert rates is not None
    return Rates(*(factor * rate for rate in astuple(rates)))
