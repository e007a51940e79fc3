"""Gradients of distance fields."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render.math import unit

if TYPE_CHECKING:
    from collections.abc import Callable

    Distance = Callable[[mi.Point3f], mi.Float]

WIDTH = 2e-4
"""Half the width of differences, in units of the field's coordinates: float32 has lost a thousandth
of the slope then."""


def derivative(distance: Distance, p: mi.Point3f) -> mi.Vector3f:
    """The gradient of a field at points, by automatic differentiation."""
    with dr.resume_grad():
        at = mi.Point3f(dr.detach(p))
        dr.enable_grad(at)
        value = distance(at)
        if not dr.grad_enabled(value):
            return dr.zeros(mi.Vector3f, dr.width(p))
        dr.backward_from(value)
        return mi.Vector3f(dr.grad(at))


def differences(distance: Distance, p: mi.Point3f, width: float = WIDTH) -> mi.Vector3f:
    """The same by central differences, for fields that cannot be differentiated."""
    slopes = []
    for axis in range(3):
        step = mi.Vector3f(*(width * (k == axis) for k in range(3)))
        slopes.append((distance(p + step) - distance(p - step)) / (2 * width))
    return mi.Vector3f(*slopes)


def normal(distance: Distance, p: mi.Point3f, by_derivative: bool = True) -> mi.Vector3f:
    """Unit normals of the surface at points of it, outward; zero where the field is flat."""
    return unit((derivative if by_derivative else differences)(distance, p))
