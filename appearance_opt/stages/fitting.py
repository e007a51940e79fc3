"""From a start and a reference to a fitted model: what all jobs that fit have in common."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Protocol

import numpy as np

from appearance_opt.errors import DivergedError
from appearance_opt.fit.loop import FitOptions, FitResult, fit
from appearance_opt.fit.validation import Validation
from appearance_opt.initial.fill import fill
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.displacement import DISPLACEMENT
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.texels import Texels
from appearance_opt.reference.pool import ReferencePool
from appearance_opt.render.quality import Quality
from appearance_opt.views import VALIDATION

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from appearance_opt.config import CommonOptions
    from appearance_opt.fit.checkpoint import Checkpointer
    from appearance_opt.fit.loop import Progress
    from appearance_opt.interrupts import Interrupts
    from appearance_opt.reference.base import Reference
    from appearance_opt.stages.start import Start
    from appearance_opt.views import ViewSampler

log = logging.getLogger(__name__)

VALIDATION_VIEWS = 8

POOL_SAMPLES = 8
"""Rays per pixel of the reference's images where outlines pass. More views with fewer rays are
worth more than fewer with many: each view is seen a few times only, and the errors of all of them
average out."""

DISPLACEMENT_RATE = 4.0
"""Rate of the displacement map in units of that of the normal map: its texels move by a fraction of
the finest edge, which is an eighth of the base edge at level 3."""

EXPORT_SECONDS = 1.0
"""Time kept back from the budget for writing the result; the report has a reserve of its own."""

REPORT_SECONDS = 5.0


class Stopwatch:
    """Seconds by stage. ``began``: ``time.perf_counter()`` of the start, by default now.
    ``progress``: told what begins."""

    def __init__(self, began: float | None = None, progress: Progress | None = None) -> None:
        self._progress = progress
        self.began = self._last = time.perf_counter() if began is None else began
        self.stages: dict[str, float] = {}

    def begin(self, text: str) -> None:
        """Say what begins, in a few words."""
        if self._progress is not None:
            self._progress.stage(text)

    def lap(self, stage: str) -> None:
        """Everything since the last lap was ``stage``."""
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + now - self._last
        self._last = now

    @property
    def total(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self.began


class Timed(Protocol):
    """What the results of all jobs have."""

    seconds: dict[str, float]
    notes: list[str]


def conclude(result: Timed, watch: Stopwatch, write_report: Callable[[], None] | None) -> None:
    """Write the report, if there is to be one, and note the time of every stage. The result is
    written already: a Ctrl-C from here on, the imports of the report included, ends the report
    alone."""
    if write_report is not None:
        watch.begin("drawing the report")
        result.seconds = dict(watch.stages)
        try:
            write_report()
        except KeyboardInterrupt:
            result.notes.append(
                "interrupted while the report was made: the result is complete, the report is missing"
            )
        watch.lap("report")
    result.seconds = {**watch.stages, "total": watch.total}


def fit_start(
    reference: Reference,
    sampler: ViewSampler,
    start: Start,
    options: CommonOptions,
    watch: Stopwatch,
    *,
    interrupts: Interrupts,
    laplacian: float = 0.0,
    relative: bool = True,
    progress: Progress | None = None,
    checkpointer: Checkpointer | None = None,
    with_report: bool = False,
) -> tuple[Latent, FitResult, DivergedError | None]:
    """Fit what ``options.fit.parts`` names, from ``start``, within what is left of the budget on
    ``watch``.

    The model is left at its best state by held-out PSNR; so it is when the fit diverged, which is
    returned rather than raised: the state is worth writing first. From here on ``interrupts``
    protect the result.
    """
    interrupts.protect()
    o = options
    width = point_width(o.views.resolution, o.texture.size)
    pool = ReferencePool(
        reference,
        sampler,
        o.views.pool,
        o.views.per_step,
        o.views.resolution,
        POOL_SAMPLES,
        width,
        o.views.reuse,
    )
    held_out = sampler.held_out(VALIDATION).draw(0, VALIDATION_VIEWS)
    validation = Validation(reference, held_out, min(o.views.resolution, 256))
    parts = frozenset(o.fit.parts) | ({DISPLACEMENT} if o.displacement.fitted else set())
    model = latent_of(start.mesh, start.maps, parts, Rates(), start.levels)
    quality, rates = fit_policy(
        validation.psnr(model), start.relative, start.grown, patience(o, watch, with_report)
    )
    given = (
        o.fit.position_rate,
        o.fit.normal_rate,
        o.fit.color_rate,
        o.fit.material_rate,
        o.displacement.rate,
    )
    defaults = (rates.position, rates.normal, rates.base_color, rates.material, rates.displacement)
    model.set_rates(Rates(*(d if g is None else g for g, d in zip(given, defaults, strict=True))))
    watch.lap("set-up")
    seconds = seconds_left(o, watch, with_report)
    if seconds == 0.0:
        log.warning(
            "--budget %.0f s holds no more than set-up (%.0f s so far) and writing: the result is the start, "
            "without a fit",
            o.fit.budget,
            watch.total,
        )
    fit_options = FitOptions(
        steps=o.fit.steps if seconds is not None or o.fit.steps is not None else 1000,
        seconds=seconds,
        loss=o.fit.loss,
        laplacian=laplacian,
        relative=relative,
        background=o.views.background_color(),
        quality=quality,
        seed=o.views.seed,
    )
    error = None
    try:
        fitted = fit(model, pool, validation, fit_options, progress, checkpointer, interrupts.asked)
    except DivergedError as diverged:
        error, fitted = diverged, FitResult()
    watch.lap("fit")
    return model, fitted, error


def seconds_left(options: CommonOptions, watch: Stopwatch, with_report: bool) -> float | None:
    """Seconds of the budget that are left for fitting; None without a budget."""
    if options.fit.budget is None:
        return None
    reserve = EXPORT_SECONDS + (REPORT_SECONDS if with_report else 0.0)
    return max(options.fit.budget - watch.total - reserve, 0.0)


def point_width(resolution: int, texture_size: int) -> float:
    """Width in pixels of the filter of point samples: about a texel, if the object fills both the
    view and the atlas. Narrower would compare single texels with detail that they cannot hold,
    wider would blur."""
    return float(np.clip(1.25 * resolution / texture_size, 0.4, 2.0))


GROWN_RATE = 0.032  # docs/trials.md: rates
"""Learning rates from a grown shape, which is rough however well it does."""


LEAST_RATE_SHARE = 0.25  # docs/trials.md: rates
"""Least share of the rates for starts that are better than 35 dB: what is left there is finer than
what the views of a fit show."""

LEAST_VERTEX_SHARE = 0.3  # docs/trials.md: rates
"""Least share of the rate of vertices, on top of that, for starts that are better than 34 dB: a
vertex that moves turns the bumps of the normal map around it."""


LONG = (600, 40.0)  # docs/trials.md: rates
"""Steps or seconds of a fit that is long enough for the least rates."""


def patience(options: CommonOptions, watch: Stopwatch, with_report: bool) -> float:
    """How long a fit will be, from 0 to 1 (as in ``LONG``, or longer)."""
    seconds = seconds_left(options, watch, with_report)
    by_steps = 1.0 if options.fit.steps is None else options.fit.steps / LONG[0]
    return min(1.0, by_steps, 1.0 if seconds is None else seconds / LONG[1])


def fit_policy(
    psnr: float, likeness: bool, grown: bool = False, patience: float = 1.0
) -> tuple[Quality, Rates]:
    """Sampling and learning rates for a start of the given held-out PSNR (dB).

    A good start is easily spoilt: large steps undo it before they find something better.
    ``likeness``: False for a start that knows nothing (a sphere); ``grown``: whether it was found
    by fitting; ``patience``: see there.
    """
    if not likeness:
        return Quality(1.0, 4, 1), Rates(0.05, 0.01, 0.02, 0.01, 0.05)
    rate = 0.008 * float(np.clip(10 ** ((25.0 - psnr) / 10.0), 0.25, 3.5))
    still = float(np.clip(10 ** ((34.0 - psnr) / 3.0), LEAST_VERTEX_SHARE, 1.0)) ** patience
    rate *= float(np.clip(10 ** ((35.0 - psnr) / 4.0), LEAST_RATE_SHARE, 1.0)) ** patience
    if grown:
        still, rate = 1.0, GROWN_RATE
    return Quality(), Rates(still * rate, rate, rate, rate, DISPLACEMENT_RATE * rate)


def clean_maps(model: Latent, known: NDArray) -> dict:
    """The model's maps and constants. Where nothing was known at the start (``known`` is false
    everywhere), texels that no view ever touched are filled from those that one did; other starts
    were filled before the fit, which may since have moved gutters that lookups reach: filling them
    again would undo that."""
    maps = model.host_maps()
    out: dict = {**model.constants, **maps}
    texels = model.fitted(Texels)
    if known.any() or texels is None:
        return out
    names = texels.channels
    stacked = fill(np.stack([maps[n] for n in names], axis=-1), texels.changed())
    return {**out, **{n: stacked[..., k] for k, n in enumerate(names)}}
