"""Signed distances to simple shapes around the origin, in the units of ``p``, negative inside.

Formulas: Inigo Quilez, "Distance functions", https://iquilezles.org/articles/distfunctions/. Exact
unless said otherwise, differentiable everywhere but at ridges, where the derivative is that of one
of their sides. Lengths may be numbers or arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render.math import clamp

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import TypeAlias

    Length: TypeAlias = mi.Float | float
    Vector: TypeAlias = mi.Vector3f | Sequence[float]

GYROID_SLOPE = 3**0.5
"""Largest slope of sin x cos y + sin y cos z + sin z cos x."""


def length(v: mi.Vector3f | mi.Vector2f) -> mi.Float:
    """|v|, with a derivative of zero at zero."""
    return dr.sqrt(dr.fmax(dr.squared_norm(v), 1e-24))


def sphere(p: mi.Point3f, radius: Length) -> mi.Float:
    """A ball."""
    return length(mi.Vector3f(p)) - radius


def ellipsoid(p: mi.Point3f, radii: Vector) -> mi.Float:
    """A ball stretched to half axes; a close bound, of the wrong slope far inside."""
    r = _vector(radii)
    inner, outer = length(p / r), length(p / (r * r))
    return inner * (inner - 1) / outer


def box(p: mi.Point3f, half: Vector) -> mi.Float:
    """A box of these half sides."""
    q = abs(mi.Vector3f(p)) - _vector(half)
    outside = mi.Vector3f(*(dr.fmax(x, 0) for x in q))
    return length(outside) + dr.fmin(dr.fmax(q.x, dr.fmax(q.y, q.z)), 0)


def torus(p: mi.Point3f, ring: Length, tube: Length) -> mi.Float:
    """A ring around the y axis: its radius, and that of its tube."""
    return length(mi.Vector2f(length(mi.Vector2f(p.x, p.z)) - ring, p.y)) - tube


def capsule(
    p: mi.Point3f, start: Vector, end: Vector, radius: Length, end_radius: Length | None = None
) -> mi.Float:
    """A tube with round ends from ``start`` to ``end``. With an ``end_radius`` it tapers, and this
    is a bound."""
    a, along = _vector(start), _vector(end) - _vector(start)
    squared = dr.fmax(dr.squared_norm(along), 1e-24)
    from_start = mi.Vector3f(p) - a
    h = clamp(dr.dot(from_start, along) / squared, 0, 1)
    away = length(from_start - along * h)
    if end_radius is None:
        return away - radius
    taper = end_radius - radius
    return (away - radius - taper * h) * dr.sqrt(squared / (squared + taper * taper))


def cylinder(p: mi.Point3f, radius: Length, half_height: Length) -> mi.Float:
    """A cylinder along the y axis with flat ends."""
    across = length(mi.Vector2f(p.x, p.z)) - radius
    along = abs(p.y) - half_height
    outside = length(mi.Vector2f(dr.fmax(across, 0), dr.fmax(along, 0)))
    return outside + dr.fmin(dr.fmax(across, along), 0)


def cone(p: mi.Point3f, bottom: Length, top: Length, half_height: Length) -> mi.Float:
    """A cone along the y axis with flat ends: its radius at the lower and at the upper one."""
    across, y = length(mi.Vector2f(p.x, p.z)), p.y
    slope, height = top - bottom, 2 * half_height
    # the nearest point of the end on this side, and of the slanted side
    at_end = across - dr.fmin(across, dr.select(y < 0, mi.Float(bottom), mi.Float(top)))
    over_end = abs(y) - half_height
    h = clamp(
        ((top - across) * slope + (half_height - y) * height) / (slope * slope + height * height),
        0,
        1,
    )
    at_side, over_side = across - top + slope * h, y - half_height + height * h
    inside = (at_side < 0) & (over_end < 0)
    nearest = dr.fmin(
        at_end * at_end + over_end * over_end, at_side * at_side + over_side * over_side
    )
    return dr.select(inside, -1, 1) * dr.sqrt(dr.fmax(nearest, 1e-24))


def plane(p: mi.Point3f, normal: Vector, offset: Length = 0.0) -> mi.Float:
    """All that lies below a plane at ``offset`` along its unit ``normal``."""
    return dr.dot(mi.Vector3f(p), _vector(normal)) - offset


def gyroid(p: mi.Point3f, period: Length, thickness: Length) -> mi.Float:
    """An endless sheet that parts space in two, about as thick as said; a bound."""
    k = 2 * dr.pi / period
    (sx, cx), (sy, cy), (sz, cz) = (dr.sincos(x * k) for x in p)
    sheet = abs(sx * cy + sy * cz + sz * cx) / (k * GYROID_SLOPE)
    return sheet - thickness / 2


def _vector(v: Vector) -> mi.Vector3f:
    return mi.Vector3f(*v)
