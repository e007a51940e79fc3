"""Bounds on device arrays.

Dr.Jit's ``maximum``/``minimum``/``clip`` propagate NaNs through an LLVM intrinsic that x86 has only since
LLVM 17; older libraries, which current long-term distributions still ship, abort the whole process on
it. These are built on the NaN-ignoring ``fmax``/``fmin``, which every version compiles. A NaN is caught
where it is born: in the image and in the gradients (see ``fit``), not here.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def at_least(x: mi.Float, low: float | mi.Float) -> mi.Float:
    """max(x, low); the gradient is zero below."""
    return dr.fmax(x, low)


def at_most(x: mi.Float, high: float | mi.Float) -> mi.Float:
    """min(x, high); the gradient is zero above."""
    return dr.fmin(x, high)


def clamp(x: mi.Float, low: float | mi.Float, high: float | mi.Float) -> mi.Float:
    """x brought into [low, high]; the gradient is zero outside."""
    return dr.fmin(dr.fmax(x, low), high)


def unit(v: mi.Vector3f) -> mi.Vector3f:
    """v / |v|, and zero with a zero gradient where v is (nearly) zero."""
    squared = dr.squared_norm(v)
    ok = squared > 1e-30
    return dr.select(ok, v * dr.rsqrt(dr.select(ok, squared, 1)), 0)
