"""From a start and a reference to a fitted model: what all jobs that fit have in common."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.errors import DivergedError
from appearance_opt.initial.fill import fill
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.displacement import DISPLACEMENT
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.texels import Texels
from appearance_opt.optimize.loop import FitResult, Judge, fit
from appearance_opt.optimize.plan import FitOptions
from appearance_opt.optimize.validation import Validation
from appearance_opt.reference.album import Album
from appearance_opt.reference.pool import FIRST, ReferencePool
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.quality import Quality
from appearance_opt.stages.run import REPORT_SECONDS
from appearance_opt.views import VALIDATION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.config import CommonOptions
    from appearance_opt.reference.base import Reference
    from appearance_opt.reference.subject import Subject
    from appearance_opt.stages.run import Run
    from appearance_opt.stages.start import Start
    from appearance_opt.views import Sampler

log = logging.getLogger(__name__)

VALIDATION_VIEWS = 8

STEP = 0.1
"""About the seconds of a step of 4 views of 256 pixels."""

REPORT_VIEWS = 9
"""Images that a report looks at."""

FEWEST = 2
"""Batches that a fit to slow images begins with, at least."""

MOST_KEPT = 512
"""Views of which it is asked whether their images are there."""

POOL_SAMPLES = 8
"""Rays per pixel of the reference's images where outlines pass. More views with fewer rays are
worth more than fewer with many: each view is seen a few times only, and the errors of all of them
average out."""

DISPLACEMENT_RATE = 4.0
"""Rate of the displacement map in units of that of the normal map: its texels move by a fraction of
the finest edge, which is an eighth of the base edge at level 3."""


OPACITY_RATE = 2.0
"""Rate of opacity in units of that of the base colour, which is bounded alike."""

WEIGHT_RATE = 5.0
"""Rate of skinning weights, in logarithms of them, in units of that of the normal map."""


def fit_start(
    subject: Subject, start: Start, options: CommonOptions, run: Run
) -> tuple[Latent, FitResult, DivergedError | None]:
    """Fit what ``options.fit.parts`` names, from ``start``, within what is left of the budget.

    The model is left at its best state by held-out PSNR; so it is when the fit diverged, which is
    returned rather than raised: the state is worth writing first. From here on the interrupts of
    ``run`` protect the result.
    """
    run.interrupts.protect()
    o, reference, sampler = options, subject.reference, subject.sampler
    width = point_width(o.views.resolution, o.texture.size)
    pool = ReferencePool(
        reference,
        sampler,
        pool_size(sampler, o.views.pool, o.views.per_step),
        o.views.per_step,
        o.views.resolution,
        POOL_SAMPLES,
        width,
        *paced(reference, sampler, o.views.reuse, o.views.per_step, o.views.resolution, run),
    )
    held_out = sampler.held_out(VALIDATION).draw(0, VALIDATION_VIEWS)
    validation = Validation(reference, held_out, min(o.views.resolution, 256))
    parts = frozenset(o.fit.parts) | ({DISPLACEMENT} if o.displacement.fitted else set())
    model = latent_of(start.mesh, start.maps, parts, Rates(), start.levels)
    return model, *fit_latent(model, pool, validation, start, o, run)


def fit_latent(
    model: Latent,
    pool: ReferencePool,
    validation: Judge,
    start: Start,
    options: CommonOptions,
    run: Run,
    share: float = 1.0,
) -> tuple[FitResult, DivergedError | None]:
    """Fit a latent that was made from ``start`` to a pool, with rates by how good it is, within a
    ``share`` of what is left of the budget. See ``fit_start``."""
    o = options
    quality, rates = fit_policy(
        validation.psnr(model), start.relative, start.grown, patience(o, run.seconds_left())
    )
    given = (
        o.fit.position_rate,
        o.fit.normal_rate,
        o.fit.color_rate,
        o.fit.material_rate,
        o.displacement.rate,
    )
    defaults = (rates.position, rates.normal, rates.base_color, rates.material, rates.displacement)
    chosen = (d if g is None else g for g, d in zip(given, defaults, strict=True))
    some = Rates(*chosen)
    model.set_rates(
        replace(some, weight=WEIGHT_RATE * rates.normal, opacity=OPACITY_RATE * some.base_color)
    )
    run.lap("set-up")
    left = run.seconds_left()
    seconds = None if left is None else share * left
    if seconds == 0.0:
        log.warning(
            "--budget %.0f s holds no more than set-up (%.0f s so far) and writing: the result is the start, "
            "without a fit",
            o.fit.budget,
            run.watch.total,
        )
    fit_options = FitOptions(
        steps=o.fit.steps if seconds is not None or o.fit.steps is not None else 1000,
        seconds=seconds,
        loss=o.fit.loss,
        laplacian=o.fit.laplacian,
        relative=start.relative if o.fit.relative is None else o.fit.relative,
        background=o.views.background_color(),
        quality=quality,
        seed=o.views.seed,
    )
    error = None
    try:
        fitted = fit(model, pool, validation, fit_options, run.observers())
    except DivergedError as diverged:
        error, fitted = diverged, FitResult()
    run.lap("fit")
    return fitted, error


def paced(
    reference: Reference, sampler: Sampler, reuse: int, batch: int, resolution: int, run: Run
) -> tuple[int, int]:
    """(how often each view is seen, batches that are new at the beginning) of a pool. Where a time
    budget runs, slow images (see ``Album``) are seen more often, so that rendering takes no longer
    than fitting; the fit begins with those that are there."""
    if not isinstance(reference, Album) or run.budget is None:
        return reuse, FIRST
    run.report_seconds = REPORT_SECONDS + REPORT_VIEWS * reference.seconds
    step = STEP * batch / 4 * (resolution / 256) ** 2
    wanted = math.ceil(reference.seconds * batch / step)
    if wanted <= reuse:
        return reuse, FIRST
    there = reference.has(sampler.draw(0, MOST_KEPT))
    return wanted, max(there // batch, FEWEST)


def pool_size(sampler: Sampler, wanted: int, batch: int) -> int:
    """Views that a pool keeps at a time: no more than there are, but for a full last batch."""
    listed = sampler.listed
    return wanted if listed is None else min(wanted, -(-listed // batch) * batch)


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


def patience(options: CommonOptions, seconds: float | None) -> float:
    """How long a fit will be that has so many ``seconds`` (None: no limit), from 0 to 1 (as in
    ``LONG``, or longer)."""
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
        return Quality(visibility=CameraRays(samples=4)), Rates(0.05, 0.01, 0.02, 0.01, 0.05)
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
