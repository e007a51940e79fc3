"""A start that is the reference with fewer triangles, which then move to where images miss them."""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.initial.atlas import pack_charts
from appearance_opt.initial.decimation import Decimation
from appearance_opt.initial.density import chart_scales
from appearance_opt.initial.reallocate import StartError, weights
from appearance_opt.stages.displacement import gutter
from appearance_opt.stages.start import Start, normals_of, require_survey, transfer_appearance
from appearance_opt.views import START

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from appearance_opt.config import SimplifyOptions
    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.reference.subject import Subject

log = logging.getLogger(__name__)

REALLOCATION_SHARE = 0.4  # docs/trials.md: reallocation
"""Part of the time left after the first start that moving triangles may take."""

REALLOCATION_EXTRA = 1.5  # docs/trials.md: reallocation
"""What moving triangles takes apart from its rounds, in first starts: images of the reference, and
the spread of the texels."""

WORTHWHILE = 0.98  # docs/trials.md: reallocation
"""Error of a start with moved triangles, relative to the one before, up to which it takes its
place."""

TIGHT_TRIANGLES = 10_000
"""Largest mesh whose atlas is packed by trying every place: the time grows with the square of the
charts."""


def decimate_start(
    subject: Subject,
    options: SimplifyOptions,
    triangles: int,
    seconds: float | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> Start:
    """The reference decimated to ``triangles``, with its appearance. ``seconds``: what is left for
    start and fit (None: no limit). ``tell``: called with what begins, in a few words. Raises
    InputError."""
    starts = _Starts(subject, options, triangles, tell)
    began = time.perf_counter()
    start = starts.make(starts.decimation.weight)
    taken = time.perf_counter() - began
    if starts.decimation.coarse:
        count, budget = len(starts.heavy.faces), options.fit.budget
        return replace(
            start,
            notes=(
                f"{count:,} triangles are many for --budget {budget:g}: decimation began with a "
                "coarse round, and triangles were not moved to where they are missed",
            ),
        )
    rounds = affordable(
        options.start.reallocate, taken, None if seconds is None else seconds - taken
    )
    if not rounds:
        return start
    judge = StartError(subject.reference, starts.heavy, starts.views)
    start, error = starts.move_triangles(start, judge, rounds)
    again = starts.spread_texels(start, len(start.mesh.faces) <= TIGHT_TRIANGLES)
    return again if judge.measure(again.drawn, again.maps)[0] < error else start


def affordable(rounds: int, taken: float, left: float | None) -> int:
    """Rounds of reallocation, of those asked for, that leave most of the time that is ``left`` to
    the fit when one takes about as long as the first start has ``taken``, and all of them
    ``REALLOCATION_EXTRA`` times as long besides. Both in seconds; None: no limit."""
    if left is None or taken <= 0:
        return rounds
    return min(rounds, max(int(REALLOCATION_SHARE * left / taken - REALLOCATION_EXTRA), 0))


class _Starts:
    """Starts from one reference. ``views``: that neither the fit nor its validation uses."""

    def __init__(
        self,
        subject: Subject,
        options: SimplifyOptions,
        triangles: int,
        tell: Callable[[str], None],
    ) -> None:
        self.tell, self.options, self.survey = tell, options, require_survey(subject)
        self.heavy, self.views = self.survey.triangles, subject.sampler.held_out(START)
        shown = None if options.start.keep_hidden else subject.sampler
        self.decimation = Decimation(self.heavy, triangles, options.fit.budget, shown, tell)

    def make(self, weight: NDArray) -> Start:
        """The reference decimated with these importances of its faces (F,)."""
        charts = self.decimation.charts(weight, normals_of(self.survey, self.options))
        return self._pack_and_bake(charts, np.ones(len(charts.faces)), False)

    def move_triangles(self, start: Start, judge: StartError, rounds: int) -> tuple[Start, float]:
        """The best of a start and those with triangles moved to where its image error is, and its
        error."""
        heavy, weight = self.heavy, self.decimation.weight
        best, (error, by_face) = start, judge.measure(start.drawn, start.maps)
        for number in range(1, rounds + 1):
            weight = weight * weights(
                heavy.positions, heavy.faces, by_face, self.decimation.visible
            )
            candidate = self.make(weight)
            again, by_face = judge.measure(candidate.drawn, candidate.maps)
            log.info(
                "triangles moved, round %d: squared error of the start %.3g -> %.3g",
                number,
                error,
                again,
            )
            if again < WORTHWHILE * error:
                best, error = candidate, again
        return best, error

    def spread_texels(self, start: Start, tight: bool) -> Start:
        """The same triangles, with texels moved to where they are seen to be missing.
        ``tight``: see ``pack_charts``."""
        assert start.charts is not None
        scale = np.ones(len(start.mesh.faces))
        # displaced vertices read the rim of a chart on both of its sides, which asks for the same
        # texels everywhere
        if not self.options.displacement.fitted:
            scale = chart_scales(start.mesh, start.maps, self.views)
        return self._pack_and_bake(start.charts, scale, tight)

    def _pack_and_bake(self, charts: LatentMesh, scale: NDArray, tight: bool) -> Start:
        options = self.options
        self.tell("packing the atlas and baking its maps")
        mesh = pack_charts(
            charts, scale, options.texture.size, gutter(len(charts.faces), options), tight
        )
        return replace(transfer_appearance(self.survey, mesh, options), charts=charts)
