"""Ambient occlusion at points of the heavy mesh, and which of them can be seen at all."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render.lattice import sub_pixel_offsets

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.reference.survey import Found, Survey

LIFT = 1e-4
"""How far rays start above the surface, in units of the object's radius (1 in local units)."""

TRIES = (1, 7, 24, 96)
"""Directions in which a way out is looked for, in several goes: most points see the sky along their
normal, and only those that have found no way out yet take part in the next go. A point visible from
less than a hundredth of all directions may be taken for hidden."""


def openness(
    survey: Survey, found: Found, seed: mi.UInt32, rays: int, distance: float, far: float
) -> mi.Float:
    """Cosine-weighted share of the hemisphere in which nothing is met within ``distance``, in [0,
    1].

    ``rays`` directions per point, a low-discrepancy sequence shifted by a hash of ``seed`` (Cranley
    and Patterson 1976). ``far``: a distance beyond which there is nothing.
    """
    there = survey.geometry(found)
    position, geometric, normal = there.position, there.normal, there.smooth
    tangent = dr.normalize(
        dr.cross(normal, dr.select(dr.abs(normal.x) < 0.9, mi.Vector3f(1, 0, 0), [0, 1, 0]))
    )
    bitangent = dr.cross(normal, tangent)
    origin = dr.fma(geometric, LIFT, position)
    length = dr.opaque(mi.Float, min(distance, far))
    shift_u, shift_v = mi.Float(_hash(seed)) * 2**-32, mi.Float(_hash(seed ^ 0x68BC21EB)) * 2**-32
    free = dr.zeros(mi.Float, dr.width(position))
    dr.eval(origin, geometric, normal, tangent, bitangent, shift_u, shift_v)
    for x, y in sub_pixel_offsets(rays):
        u, v = shift_u + dr.opaque(mi.Float, x), shift_v + dr.opaque(mi.Float, y)
        radius, angle = dr.sqrt(u - dr.floor(u)), v * (2 * dr.pi)
        s, c = dr.sincos(angle)
        height = dr.sqrt(dr.fmax(1 - dr.square(radius), 0))
        d = tangent * (radius * c) + bitangent * (radius * s) + normal * height
        # the interpolated normal's hemisphere dips below coarse faces: turn such rays up again
        below = dr.dot(d, geometric)
        d = dr.select(below < 0, d - geometric * (2 * below), d)
        hit = survey.blocked(mi.Ray3f(origin, d, length, 0, mi.Color0f()), found.valid)
        free += dr.select(hit, mi.Float(0), mi.Float(1))
        dr.eval(free)
    return free * dr.opaque(mi.Float, 1 / rays)


def exposed(
    blocked: Callable[[mi.Ray3f, mi.Bool], mi.Bool],
    position: mi.Point3f,
    normal: mi.Vector3f,
    active: mi.Bool,
    far: float,
    culled: mi.Bool | None = None,
) -> mi.Bool:
    """Which of the ``active`` points of a surface something outside can see, from either side:
    those from which some ray is not ``blocked`` (rays, which of them count). Where parts touch,
    both surfaces are hidden. ``far``: a distance beyond which there is nothing. ``culled``: points
    that are seen from the side of their ``normal`` only."""
    out = dr.zeros(mi.Bool, dr.width(position))
    left = dr.compress(active)
    length = dr.opaque(mi.Float, far)
    for number, count in enumerate(TRIES):
        if dr.width(left) == 0:
            break
        p, n = (dr.gather(type(x), x, left) for x in (position, normal))
        hidden = dr.full(mi.Bool, True, dr.width(left))
        front_only = None if culled is None else dr.gather(mi.Bool, culled, left)
        dr.eval(p, n, hidden, front_only)
        for x, y in sub_pixel_offsets(count):
            # the same directions everywhere: what is hidden is of one piece
            d = n if number == 0 else dr.opaque(mi.Vector3f, _on_sphere(float(x), float(y)))
            below = dr.dot(d, n) < 0
            if front_only is not None:
                d = dr.select(below & front_only, -d, d)
                below &= ~front_only
            side = dr.select(below, mi.Float(-LIFT), mi.Float(LIFT))
            hidden &= blocked(mi.Ray3f(dr.fma(n, side, p), d, length, 0, mi.Color0f()), hidden)
            dr.eval(hidden)
        dr.scatter(out, ~hidden, left)
        left = dr.gather(mi.UInt32, left, dr.compress(hidden))
        dr.eval(out, left)
    return out


def _on_sphere(u: float, v: float) -> tuple[float, float, float]:
    """Unit vector of a point of the unit square, area to area (that of ``mi.warp`` needs LLVM 17:
    see ``render/math.py``)."""
    z = 1 - 2 * v
    radius, azimuth = math.sqrt(max(1 - z * z, 0.0)), 2 * math.pi * u
    return radius * math.cos(azimuth), radius * math.sin(azimuth), z


def _hash(x: mi.UInt32) -> mi.UInt32:
    """Integer hash (Wellons 2018, lowbias32)."""
    x = (x ^ (x >> 16)) * 0x7FEB352D
    x = (x ^ (x >> 15)) * 0x846CA68B
    return x ^ (x >> 16)
