"""The fewest triangles that keep within a bound: which number to try next, by what is known."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

CLOSE = 1.15
"""Ratio between the fewest triangles that are enough and the most that are not at which a search
ends."""

SAFETY = 0.97
"""Part of the bound that is aimed at: other views differ a little."""

FEWEST = 4
"""Triangles of a closed mesh."""

SLOPE = {"silhouette_shift": -1.0, "flip": -0.5, "psnr_covered": -0.5}
"""Power of the number of triangles with which an error goes, where two trials do not tell: outlines
are off by the square of an edge's length, and triangles are as many as its inverse square."""


@dataclass(frozen=True)
class Trial:
    """A number of ``triangles``, and the ``error`` that a fit of so many has."""

    triangles: int
    error: float


def bracket(trials: Sequence[Trial], limit: float) -> tuple[Trial | None, Trial | None]:
    """(the fewest triangles that keep within ``limit``, the most below it that do not)."""
    enough = min((t for t in trials if t.error <= limit), key=lambda t: t.triangles, default=None)
    short = [
        t for t in trials if t.error > limit and (enough is None or t.triangles < enough.triangles)
    ]
    return enough, max(short, key=lambda t: t.triangles, default=None)


def next_count(
    trials: Sequence[Trial], limit: float, available: int, first: int, slope: float
) -> int | None:
    """How many triangles to try next, from ``FEWEST`` to ``available``; None if the answer is
    known well enough. It starts at ``first``, follows a power, of the last two trials or ``slope``
    before there are any, until the answer lies between two, and then the line through these in
    logarithms, which stays away from both ends by a tenth, so that each trial narrows the rest.
    Three digits, as none more is known."""
    tried = {t.triangles for t in trials}
    if not trials:
        return _rounded(first, available)
    enough, short = bracket(trials, limit)
    aim, slope = SAFETY * limit, _slope(trials, slope)
    if short is None:
        assert enough is not None
        factor = (max(enough.error, 1e-9) / aim) ** (-1 / slope)
        wanted = enough.triangles * min(max(factor, 1 / 8), 1 / 1.3)
    elif enough is None:
        factor = (short.error / aim) ** (-1 / slope)
        wanted = short.triangles * min(max(1.05 * factor, 1.5), 8.0)
    else:
        if enough.triangles <= CLOSE * short.triangles:
            return None
        low, high = math.log(short.triangles), math.log(enough.triangles)
        a, b = math.log(short.error), math.log(max(enough.error, 1e-9))
        part = (a - math.log(aim)) / (a - b) if a > b else 0.5
        wanted = math.exp(low + min(max(part, 0.1), 0.9) * (high - low))
    count = _rounded(wanted, available)
    return None if count in tried else count


def _slope(trials: Sequence[Trial], usual: float) -> float:
    """The power with which the error of the last two trials goes, if that makes sense."""
    if len(trials) < 2:
        return usual
    (a, b) = trials[-2:]
    if min(a.error, b.error) <= 0:
        return usual
    power = math.log(a.error / b.error) / math.log(a.triangles / b.triangles)
    return min(max(power, -2.0), -0.2)


def _rounded(count: float, available: int) -> int:
    digits = max(0, math.floor(math.log10(max(count, 1))) - 2)
    return min(max(FEWEST, round(count / 10**digits) * 10**digits), available)
