"""Rays and distance fields: sphere tracing with over-relaxation.

Hart 1996; steps longer than the distance, taken back where two spheres in a row do not overlap:
Keinert, Schaefer, Korndoerfer, Ganse and Stamminger 2014, "Enhanced Sphere Tracing".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.sdf.shape import Field

TOLERANCE = 1e-4
"""Distance from which a ray has met the surface, in units of the field's coordinates: in a fit, of
the object's radius. A fortieth of a pixel at 512 of them."""

RELAXATION = 1.6
"""Length of a step in units of the distance, as long as spheres overlap."""

STEPS = 256
"""Most steps of a ray. One that comes within ``NEAR`` tolerances has met the surface then, another
has missed it."""

NEAR = 10.0


@dataclass
class Hit:
    """What N rays met. ``t``: distance along the ray; ``valid``: did it meet anything?
    ``residual``: distance left to the surface; ``steps`` that it took."""

    t: mi.Float
    valid: mi.Bool
    residual: mi.Float
    steps: mi.UInt32


def clip(field: Field, origin: mi.Point3f, direction: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """(start, end) of the part of each ray that lies within the bounds of the field; an end before
    the start where it passes them by."""
    slack = 2 * TOLERANCE
    low, high = np.asarray(field.bounds, np.float64) + [[-slack], [slack]]
    inverse = 1 / dr.select(dr.abs(direction) < 1e-12, mi.Vector3f(1e-12), direction)
    one = (mi.Point3f(*low.tolist()) - origin) * inverse
    two = (mi.Point3f(*high.tolist()) - origin) * inverse
    near, far = dr.fmin(one, two), dr.fmax(one, two)
    start = dr.fmax(dr.fmax(near.x, near.y), dr.fmax(near.z, 0))
    return start, dr.fmin(dr.fmin(far.x, far.y), far.z)


def sphere_trace(
    distance: Callable[[mi.Point3f], mi.Float],
    origin: mi.Point3f,
    direction: mi.Vector3f,
    start: mi.Float,
    end: mi.Float,
    safety: mi.Float | float = 1.0,
) -> Hit:
    """The first place between ``start`` and ``end`` of rays (unit directions) where the distance is
    below ``TOLERANCE``. ``safety``: what distances are multiplied with, below 1 for fields that
    change by more than 1 per unit of length."""

    def going(t: mi.Float, _s, _b, _w, k: mi.UInt32, _r, open_: mi.Bool) -> mi.Bool:
        return open_ & (k < STEPS)

    def march(t, step, before, relaxation, k, residual, open_):  # type: ignore[no-untyped-def]
        there = distance(dr.fma(direction, t, origin))
        radius = there * safety
        apart = (relaxation > 1) & (radius + before < step)
        met = ~apart & (there < TOLERANCE)
        residual = dr.select(apart, residual, there)
        # back to the border of the sphere before, else on; plain steps on the way to a surface
        on = dr.select(apart, step / relaxation - step, radius * relaxation)
        relaxation = dr.select(apart, 1, dr.select(radius > before, RELAXATION, relaxation))
        on = dr.select(met, 0, on)
        t += on
        before = dr.select(apart, before, radius)
        return t, on, before, relaxation, k + 1, residual, ~met & (t < end)

    width = dr.width(direction)
    state = (
        mi.Float(start),
        dr.zeros(mi.Float, width),
        dr.zeros(mi.Float, width),
        dr.full(mi.Float, RELAXATION, width),
        dr.zeros(mi.UInt32, width),
        dr.full(mi.Float, dr.inf, width),
        mi.Bool(start < end),
    )
    t, _, _, _, steps, residual, _ = dr.while_loop(state, going, march, label="sphere tracing")
    near = NEAR * TOLERANCE
    return Hit(t, (t < end) & (residual < near) & (start < end), residual, steps)
