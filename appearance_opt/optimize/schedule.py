"""How far a fit is, and what follows from it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field


@dataclass
class Clock:
    """Progress of a fit that ends after ``steps`` iterations, after ``seconds`` of wall-clock time,
    or at whichever comes first. ``elapsed`` seconds are carried over by a resumed fit."""

    steps: int | None
    seconds: float | None
    elapsed: float = 0.0
    _started: float = field(default_factory=time.perf_counter)

    def time(self) -> float:
        """Seconds of fitting, those before a resume included."""
        return self.elapsed + time.perf_counter() - self._started

    def progress(self, iteration: int) -> float:
        """Fraction done, in [0, 1]."""
        by_steps = iteration / self.steps if self.steps else 0.0
        by_time = self.time() / self.seconds if self.seconds else 0.0
        return min(1.0, max(by_steps, by_time))

    def done(self, iteration: int) -> bool:
        """Is the fit over?"""
        if self.steps is not None and iteration >= self.steps:
            return True
        return self.seconds is not None and self.time() >= self.seconds


def learning_rate(progress: float, decades: float) -> float:
    """Exponential decay by ``decades`` powers of ten over the fit, after a short warm-up.

    The paper decays by 10^(-0.0002 t), two decades over its 10,000 steps; here the decay follows
    the progress, so that short and long fits both end with small steps.
    """
    warm_up = min(1.0, progress / 0.01 + 0.1)
    return warm_up * 10.0 ** (-decades * progress)


def laplacian_weight(
    initial: float, progress: float, steps: float = 10_000.0, rate: float = 1e-6
) -> float:
    """lambda_t after t = progress * steps iterations of the paper's recursion lambda_t =
    (lambda_{t-1} - lambda_min) 10^(-k t) + lambda_min, lambda_min = 2 % of lambda_0 (Hasselgren et
    al. 2021, section 3.3): in closed form the exponents add up to k t (t + 1) / 2. The paper's
    10,000 steps are stretched or squeezed to the length of the fit."""
    t = progress * steps
    floor = 0.02 * initial
    return (initial - floor) * math.pow(10.0, -rate * t * (t + 1) / 2) + floor
