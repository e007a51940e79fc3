"""The fewest triangles that look like the source within a bound, and how well that is known."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.errors import BoundError
from appearance_opt.evaluate.chart import Chart
from appearance_opt.evaluate.comparison import render_asset
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.jobs.result import SimplifyResult
from appearance_opt.options.bound import Bound, parse_bound
from appearance_opt.options.chain import PER_PIXEL
from appearance_opt.stages.export import OURS
from appearance_opt.stages.levels import LEAST_SECONDS, Level, fit_level, from_finer
from appearance_opt.stages.search import SAFETY, SLOPE, Trial, bracket, next_count
from appearance_opt.views import MEASURED, VALIDATION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.config import SimplifyOptions
    from appearance_opt.reference.subject import Subject
    from appearance_opt.stages.levels import KeptLevels
    from appearance_opt.stages.parts import Parts
    from appearance_opt.stages.run import Run
    from appearance_opt.views import Views

TRIALS = 6
"""Fits of a search, at the most."""

FIRST_SHARE = 1 / 3
"""Part of the time that the first trial may take."""

VIEWS, FEWEST_VIEWS = 24, 6
"""By which errors are measured, up to 1024 pixels; fewer where images are larger."""

RAYS = 16
"""Per pixel of these images."""

WITHIN = 0.95
"""Share of the views whose error must keep within the bound."""

OTHERS = 1
"""Iteration of a stream of views of which neither fits nor reports use any."""


@dataclass(frozen=True)
class Certificate:
    """What is known of a result's error at a size of ``pixels``, from ``views`` that neither the
    fit nor the search saw. ``metric``, ``bound``: what was asked for; ``value``: the mean over the
    views, with its ``standard_error``; ``within``: share of the views that keep within the bound;
    ``met``: are these enough? ``short_by``: how far the worst of those that must is from the bound,
    0 if it is met."""

    metric: str
    bound: float
    pixels: int
    value: float
    standard_error: float
    views: int
    within: float
    met: bool
    short_by: float

    def describe(self) -> str:
        """A sentence."""
        bound = Bound(self.metric, self.bound)
        said = (
            f"{bound.show(self.value)} +- {self.standard_error:.2g} at {self.pixels} pixels over "
            f"{self.views} views that nothing was chosen by, {100 * self.within:.0f} % of them "
            f"within {bound.show(self.bound)}"
        )
        return said if self.met else f"{said}: short by {self.short_by:.2g}"


def certify(values: NDArray, bound: Bound, pixels: int) -> Certificate:
    """From a metric's ``values`` (N,) of fresh views."""
    errors = np.array([bound.error(v) for v in values])
    within = float((errors <= bound.limit).mean())
    met = within >= WITHIN
    worst = bound.value_of(most_of(errors))
    return Certificate(
        bound.metric,
        bound.value,
        pixels,
        float(values.mean()),
        float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else 0.0,
        len(values),
        within,
        met,
        0.0 if met else abs(worst - bound.value),
    )


def most_of(errors: NDArray) -> float:
    """The largest error of all views but those that may exceed a bound."""
    spare = math.floor((1 - WITHIN) * len(errors) + 1e-9)
    return float(np.sort(errors)[len(errors) - 1 - spare])


class Judge:
    """Measures assets against a subject at a size, from the views of a stream."""

    def __init__(self, subject: Subject, bound: Bound, pixels: int, stream: int) -> None:
        self.subject, self.bound, self.pixels = subject, bound, pixels
        count = min(VIEWS, max(FEWEST_VIEWS, int(VIEWS * (1024 / pixels) ** 2)))
        self.views: Views = subject.sampler.held_out(stream).draw(OTHERS, count)
        self._reference = subject.reference.render(self.views, pixels, RAYS)

    def values(self, asset: Asset) -> NDArray[np.float64]:
        """(N,) the bound's metric in each view that shows anything."""
        local = self.subject.placement.local(asset)
        images = render_asset(local, self.views, self.pixels, RAYS)
        seen = self._reference[..., 3].any(axis=(1, 2)) | images[..., 3].any(axis=(1, 2))
        metrics = compare_images(self._reference[seen], images[seen])
        return np.array([getattr(v, self.bound.metric) for v in metrics.views])

    def error(self, asset: Asset) -> float:
        """That which must keep within the bound."""
        return most_of(np.array([self.bound.error(v) for v in self.values(asset)]))


def guess(bound: Bound, pixels: int, available: int) -> int:
    """Triangles to begin with."""
    usual = {"silhouette_shift": 0.5, "flip": 0.02, "psnr_covered": 10 ** (-32 / 20)}
    factor = (usual[bound.metric] / bound.limit) ** (-1 / SLOPE[bound.metric])
    return max(FEWEST_FIRST, min(round(PER_PIXEL / 2 * pixels * factor), available // 2))


FEWEST_FIRST = 12


def find_smallest(
    subject: Subject,
    parts: Parts,
    options: SimplifyOptions,
    run: Run,
    kept: KeptLevels | None = None,
) -> SimplifyResult:
    """Fit meshes of several numbers of triangles, each started from the smallest finer one that is
    there, until the fewest that keep within the bound are known, the time is spent, or somebody
    asks to end. What cannot be met is told, with the best that was reached."""
    o, source = options, parts.fitted
    assert o.start.max_error is not None
    bound, pixels = parse_bound(o.start.max_error), o.start.pixels or o.views.resolution
    available = source.triangle_count
    first, slope = guess(bound, pixels, available), SLOPE[bound.metric]
    run.begin(f"drawing the views that decide, at {pixels} pixels")
    judge = Judge(subject, bound, pixels, VALIDATION)
    run.lap("measure")
    levels: dict[int, Level] = {}
    trials: list[Trial] = []
    longest = around = 0.0
    while len(trials) < TRIALS:
        count = next_count(trials, SAFETY * bound.limit, available, first, slope)
        left = run.seconds_left()
        if count is None or run.interrupts.asked():
            break
        if trials and left is not None and left < 0.7 * longest:
            break
        began, k = run.watch.total, len(trials)
        # a fit is worth no less than what goes on around it; the first one's kernels are compiled
        least = 0.0 if left is None else FIRST_SHARE * left if k == 0 else 2 * around
        share = None if left is None else min(left, max(left / (TRIALS - k), least))
        share = None if share is None else max(share, LEAST_SECONDS)
        fitting = replace(o.fit, budget=share)
        if kept is not None and kept.done > k:
            fitting = replace(fitting, steps=0)
        start = replace(o.start, max_error=None, strict=False, triangles=count)
        finer = min((c for c in levels if c > count), default=None)
        made_from = subject if finer is None else from_finer(subject, levels[finer].drawn)
        run.begin(f"trial {k + 1}: {count:,} triangles")
        trial_run = replace(
            run,
            budget=None if share is None else began + share,
            checkpointer=None if kept is None else kept.checkpointer(k),
            with_report=False,
        )
        level = fit_level(
            made_from, source, replace(o, start=start, fit=fitting), trial_run, pixels
        )
        levels[count] = level
        if kept is not None and not level.fit.interrupted:
            kept.finish(k)
        trials.append(Trial(count, judge.error(level.drawn)))
        run.lap("measure")
        longest = max(longest, run.watch.total - began)
        around = level.seconds - level.fit.seconds
    best = _best(trials, SAFETY * bound.limit)
    certificate = certify(
        Judge(subject, bound, pixels, MEASURED).values(levels[best].drawn), bound, pixels
    )
    run.lap("measure")
    return _result(levels[best], trials, certificate, parts, options)


def _best(trials: list[Trial], limit: float) -> int:
    """The fewest triangles that are enough, or else those with the smallest error."""
    enough, _ = bracket(trials, limit)
    return (enough or min(trials, key=lambda t: t.error)).triangles


def _result(
    level: Level,
    trials: list[Trial],
    certificate: Certificate,
    parts: Parts,
    options: SimplifyOptions,
) -> SimplifyResult:
    source, bound = parts.fitted, Bound(certificate.metric, certificate.bound)
    what = "pass into the result as they are, and count for no --max-error"
    notes = [*source.notes, *parts.describe_kept(what), *level.notes]
    notes += parts.describe_nodes(level.asset)
    told = certificate.describe()
    error = None
    if not certificate.met:
        notes.append(f"--max-error {options.start.max_error} is not met: {told}")
        if options.start.strict:
            error = BoundError(f"--max-error {options.start.max_error} is not met: {told}")
    credit = level.asset.credits
    noted = {OURS: {"certificate": asdict(certificate)}}
    if isinstance(credit.extras, dict):
        noted = {**credit.extras, **noted}
    if credit.extras is None or isinstance(credit.extras, dict):
        asset = replace(level.asset, credits=replace(credit, extras=noted))
        exported = replace(level.exported, asset=asset)
    else:
        exported = level.exported
    name = (source.name, source.triangle_count)
    result = SimplifyResult.of(exported, parts, level.fit, name, notes, level.error)
    tried = {
        t.triangles: bound.value_of(t.error) for t in sorted(trials, key=lambda t: t.triangles)
    }
    facts: dict[str, Any] = {
        "certificate": asdict(certificate),
        "error": told,
        "triangles tried": ", ".join(f"{n} ({bound.show(v)})" for n, v in tried.items()),
    }
    result.facts |= facts
    result.error = result.error or error
    if len(trials) > 1:
        result.charts.append(_chart(trials, bound))
    return result


def _chart(trials: list[Trial], bound: Bound) -> Chart:
    names = {"silhouette_shift": "silhouette shift (pixels)", "flip": "FLIP"}
    return Chart(
        "How many triangles are needed",
        f"Error of each trial in the view that must keep within {bound.show(bound.value)} (the "
        "dotted line), by its triangles.",
        "triangles",
        names.get(bound.metric, "root of the mean squared error"),
        {"error": [(float(t.triangles), t.error) for t in trials]},
        bound.limit,
    )
