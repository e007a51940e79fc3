"""Adam (Kingma and Ba 2015) over one flat parameter, with bounds, in a single kernel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render.math import clamp

if TYPE_CHECKING:
    from appearance_opt.latent.parameter import Parameter

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-12
"""EPSILON is far below the published 1e-8: gradients of a mean over a million pixels are that small."""

AVERAGING = 8
"""The mean of the values is over about the last 1/AVERAGING of all steps (polynomial-decay averaging, Shamir and
Zhang 2013). It is what a fit hands out: the noise of few views per step averages out in it."""


@dataclass
class Moments:
    """First and second moment of each element's gradient, the running ``mean`` of its value (see ``AVERAGING``),
    and the number of steps they hold."""

    first: mi.Float
    second: mi.Float
    mean: mi.Float
    steps: int = 0


def moments_of(parameter: Parameter) -> Moments:
    """Moments before the first step."""
    n = dr.width(parameter.value)
    return Moments(dr.zeros(mi.Float, n), dr.zeros(mi.Float, n), mi.Float(parameter.value))


def update(parameter: Parameter, gradient: mi.Float, moments: Moments, rate: float) -> tuple[mi.Float, Moments]:
    """(new value, new moments) after one step; ``rate`` multiplies the parameter's own rates."""
    steps = moments.steps + 1
    first = dr.fma(moments.first, BETA_1, gradient * (1 - BETA_1))
    second = dr.fma(moments.second, BETA_2, dr.square(gradient) * (1 - BETA_2))
    # bias corrections and rate change every step: opaque, or each step would compile a kernel
    scale = dr.opaque(mi.Float, rate / (1 - BETA_1**steps))
    correction = dr.opaque(mi.Float, 1 / (1 - BETA_2**steps))
    step = first * scale / (dr.sqrt(second * correction) + EPSILON)
    if dr.width(parameter.rate) == dr.width(parameter.value):
        value = parameter.value - parameter.rate * step
    else:
        channel = dr.arange(mi.UInt32, dr.width(parameter.value)) & (parameter.channels - 1)
        value = parameter.value - dr.gather(mi.Float, parameter.rate, channel) * step
        if parameter.low is not None and parameter.high is not None:
            value = clamp(
                value, dr.gather(mi.Float, parameter.low, channel), dr.gather(mi.Float, parameter.high, channel)
            )
    share = dr.opaque(mi.Float, (AVERAGING + 1) / (steps + AVERAGING))
    mean = dr.fma(value - moments.mean, share, moments.mean)
    dr.eval(value, first, second, mean)
    return value, Moments(first, second, mean, steps)
