"""What shapes are put together with: operations on distances, and on positions before a shape is
asked for its distance there.

Formulas: Inigo Quilez, https://iquilezles.org/articles/distfunctions/ and .../smin/. What says that
it bends space changes distances by more than it seems: the fields that come out may change by more
than 1 per unit of length, for which steps of rays are shortened (see ``sdf.check``).
"""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render.math import clamp

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import TypeAlias

    Length: TypeAlias = mi.Float | float
    Vector: TypeAlias = mi.Vector3f | Sequence[float]


def union(*distances: mi.Float) -> mi.Float:
    """All that is in any of the shapes."""
    return reduce(dr.fmin, distances)


def intersection(*distances: mi.Float) -> mi.Float:
    """All that is in every one of the shapes; a bound."""
    return reduce(dr.fmax, distances)


def difference(a: mi.Float, b: mi.Float) -> mi.Float:
    """What is in a and not in b; a bound."""
    return dr.fmax(a, -b)


def smooth_union(a: mi.Float, b: mi.Float, width: Length) -> mi.Float:
    """The union with a fillet where the two distances differ by less than ``width``."""
    h = dr.fmax(width - abs(a - b), 0) / width
    return dr.fmin(a, b) - h * h * width * 0.25


def smooth_intersection(a: mi.Float, b: mi.Float, width: Length) -> mi.Float:
    """The intersection with its edge rounded off over ``width``."""
    return -smooth_union(-a, -b, width)


def smooth_difference(a: mi.Float, b: mi.Float, width: Length) -> mi.Float:
    """The difference with its edge rounded off over ``width``."""
    return -smooth_union(-a, b, width)


def share(a: mi.Float, b: mi.Float, width: Length) -> mi.Float:
    """How much of b there is where a and b meet, from 0 to 1, changing over ``width``: for materials
    to follow a ``smooth_union``."""
    return clamp(0.5 + 0.5 * (a - b) / width, 0, 1)


def mix(x: mi.Color3f | mi.Float, y: mi.Color3f | mi.Float, weight: mi.Float) -> mi.Color3f:
    """x where ``weight`` is 0, y where it is 1. Of colours (three numbers will do) or numbers."""
    if not isinstance(x, (int, float, mi.Float)) or not isinstance(y, (int, float, mi.Float)):
        x, y = mi.Color3f(x), mi.Color3f(y)
    return x + (y - x) * weight


def step(edge: Length, x: mi.Float, width: Length) -> mi.Float:
    """0 below ``edge``, 1 above it, smooth over ``width``."""
    t = clamp((x - edge) / width + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def round_off(distance: mi.Float, radius: Length) -> mi.Float:
    """The shape, thicker by ``radius``, with its edges rounded off."""
    return distance - radius


def onion(distance: mi.Float, thickness: Length) -> mi.Float:
    """A shell of this thickness around the surface."""
    return abs(distance) - thickness / 2


def translate(p: mi.Point3f, offset: Vector) -> mi.Point3f:
    """Move what is asked for its distance at the result."""
    return p - mi.Vector3f(*offset)


def rotate(p: mi.Point3f, axis: Vector, degrees: Length) -> mi.Point3f:
    """Turn it about an axis through the origin, counterclockwise when the axis points at the
    viewer."""
    k, v = dr.normalize(mi.Vector3f(*axis)), mi.Vector3f(p)
    sine, cosine = dr.sincos(mi.Float(-degrees * (dr.pi / 180)))
    turned = v * cosine + dr.cross(k, v) * sine + k * (dr.dot(k, v) * (1 - cosine))
    return mi.Point3f(turned)


def scale(shape: Callable[[mi.Point3f], mi.Float], p: mi.Point3f, factor: Length) -> mi.Float:
    """The distance at p of ``shape``, a function of position, made larger by ``factor``."""
    return shape(p / factor) * factor


def mirror(p: mi.Point3f, axis: str = "x") -> mi.Point3f:
    """What lies on the positive side of an axis is on its negative one, too."""
    return mi.Point3f(*(abs(v) if n == axis else v for n, v in zip("xyz", p, strict=True)))


def twist(p: mi.Point3f, rate: Length) -> mi.Point3f:
    """Turn it about the y axis by ``rate`` radians per unit of height. Bends space."""
    sine, cosine = dr.sincos(p.y * rate)
    return mi.Point3f(cosine * p.x - sine * p.z, p.y, sine * p.x + cosine * p.z)


def repeat(p: mi.Point3f, period: Vector, counts: Sequence[int] | None = None) -> mi.Point3f:
    """Copies of it along the axes, one ``period`` apart (0: none along this axis), the middle one
    where it was. ``counts``: how many to either side; None: endless. A copy must not reach beyond
    half a period."""
    out = []
    for k, (x, one) in enumerate(zip(p, period, strict=True)):
        if isinstance(one, (int, float)) and one == 0:
            out.append(x)
            continue
        number = dr.floor(dr.detach(x) / one + 0.5)
        if counts is not None:
            number = clamp(number, -counts[k], counts[k])
        out.append(x - number * one)
    return mi.Point3f(*out)


def elongate(p: mi.Point3f, half: Vector) -> mi.Point3f:
    """Cut it in the middle and pull it apart by ``half`` to either side. A bound inside."""
    return mi.Point3f(*(x - clamp(x, -h, h) for x, h in zip(p, half, strict=True)))
