"""Bounds on device arrays.

Dr.Jit's ``maximum``/``minimum``/``clip`` propagate NaNs through an LLVM intrinsic that x86 has only
since LLVM 17; older libraries, which current long-term distributions still ship, abort the whole
process on it. These are built on the NaN-ignoring ``fmax``/``fmin``, which every version compiles.
A NaN is caught where it shows: in the gradients of every step and in the held-out images (see
``fit``), not here.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

LARGEST_HALF = 65504.0
"""Largest number in half precision."""


def at_least(x: mi.Float, low: float | mi.Float) -> mi.Float:
    """Return max(x, low); the gradient is zero below."""
    return dr.fmax(x, low)


def at_most(x: mi.Float, high: float | mi.Float) -> mi.Float:
    """Return min(x, high); the gradient is zero above."""
    return dr.fmin(x, high)


def clamp(x: mi.Float, low: float | mi.Float, high: float | mi.Float) -> mi.Float:
    """Bring x into [low, high]; the gradient is zero outside."""
    return dr.fmin(dr.fmax(x, low), high)


def unit(v: mi.Vector3f) -> mi.Vector3f:
    """Return v / |v|, and zero with a zero gradient where v is (nearly) zero."""
    squared = dr.squared_norm(v)
    ok = squared > 1e-30
    return dr.select(ok, v * dr.rsqrt(dr.select(ok, squared, 1)), 0)


ARC_TANGENT = (
    1.0, -0.333332823, 0.199982306, -0.142615737, 0.10940199,
    -0.0837206395, 0.0574635578, -0.0307175089, 0.0106807194, -0.00174370114,
)  # fmt: skip
"""atan(t) / t on [0, 1] as a polynomial in t^2 (Chebyshev fit, relative error 5e-9)."""


def angle_of(sine: mi.Float, cosine: mi.Float) -> mi.Float:
    """Return the angle in [0, pi] of a sine that is positive and a cosine, both up to a common
    factor: ``dr.atan2`` is built on the minimum and maximum that propagate NaNs."""
    across = dr.abs(cosine)
    steep = sine > across
    t = dr.select(steep, across, sine) / dr.select(steep, sine, across)
    squared, series = dr.square(t), mi.Float(ARC_TANGENT[-1])
    for coefficient in ARC_TANGENT[-2::-1]:
        series = dr.fma(series, squared, coefficient)
    angle = t * series
    angle = dr.select(steep, dr.pi / 2 - angle, angle)
    return dr.select(cosine < 0, dr.pi - angle, angle)
