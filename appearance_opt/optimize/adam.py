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
"""EPSILON is far below the published 1e-8: gradients of a mean over a million pixels are that
small."""

AVERAGING = 8
"""The mean of the values is over about the last 1/AVERAGING of all steps (polynomial-decay
averaging, Shamir and Zhang 2013). It is what a fit hands out: the noise of few views per step
averages out in it."""


@dataclass
class Moments:
    """First and second moment of each element's gradient, the running ``mean`` of its value (see
    ``AVERAGING``), and the number of steps they hold."""

    first: mi.Float
    second: mi.Float
    mean: mi.Float
    steps: int = 0


def moments_of(parameter: Parameter) -> Moments:
    """Moments before the first step."""
    n = dr.width(parameter.value)
    return Moments(dr.zeros(mi.Float, n), dr.zeros(mi.Float, n), mi.Float(parameter.value))


def update(
    parameter: Parameter, gradient: mi.Float, moments: Moments, rate: float
) -> tuple[mi.Float, Moments]:
    """(new value, new moments) after one step; ``rate`` multiplies the parameter's own rates."""
    steps = moments.steps + 1
    if parameter.smooth is not None:
        gradient = parameter.smooth(gradient)
    first = dr.fma(moments.first, BETA_1, gradient * (1 - BETA_1))
    second = dr.fma(moments.second, BETA_2, dr.square(gradient) * (1 - BETA_2))
    # bias corrections and rate change every step: opaque, or each step would compile a kernel
    scale = dr.opaque(mi.Float, rate / (1 - BETA_1**steps))
    correction = dr.opaque(mi.Float, 1 / (1 - BETA_2**steps))
    if parameter.smooth is None:
        step = first * scale / (dr.sqrt(second * correction) + EPSILON)
    else:
        # one scale for all: a scale per element would undo the smoothness (Nicolet et al. 2021,
        # section 4.3)
        step = parameter.smooth(first * scale / (dr.sqrt(dr.max(second) * correction) + EPSILON))
    value = _clamp_to_bounds(parameter, parameter.value - _rates(parameter) * step)
    share = dr.opaque(mi.Float, (AVERAGING + 1) / (steps + AVERAGING))
    mean = dr.fma(value - moments.mean, share, moments.mean)
    dr.eval(value, first, second, mean)
    return value, Moments(first, second, mean, steps)


def _rates(parameter: Parameter) -> mi.Float:
    """Rate of every element."""
    if dr.width(parameter.rate) in (1, dr.width(parameter.value)):
        return parameter.rate
    return dr.gather(mi.Float, parameter.rate, _channel(parameter))


def _clamp_to_bounds(parameter: Parameter, value: mi.Float) -> mi.Float:
    if parameter.low is None or parameter.high is None:
        return value
    channel = _channel(parameter)
    return clamp(
        value,
        dr.gather(mi.Float, parameter.low, channel),
        dr.gather(mi.Float, parameter.high, channel),
    )


def _channel(parameter: Parameter) -> mi.UInt32:
    return dr.arange(mi.UInt32, dr.width(parameter.value)) & (parameter.channels - 1)
