"""A distance field as a ``Survey``: what starts, transfer and baking ask of it."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.asset.types import Asset, Material, Mesh
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.survey import (
    BACK,
    Appearance,
    Found,
    Geometry,
    MeshSurvey,
    Pick,
    Triangles,
)
from appearance_opt.sdf.sampling import isosurface
from appearance_opt.sdf.trace import TOLERANCE, sphere_trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.reference.sdf import SdfReference

LEAST_STEP, STEPS = 1 / 64, 96
"""Least step of a ray in search of a crossing, in units of its reach, and most steps."""

REFINEMENTS = 4

LIFT = 4 * TOLERANCE
"""How far from the surface rays start that ask whether it is hidden."""

CURVATURE_WIDTH = 5e-3
"""Half the width of the second differences that curvature is taken from."""


class SdfSurvey:
    """The surface that a ``SdfReference`` draws. ``Found.place`` is the point. ``wanted``: about how
    many ``triangles`` are a fine enough likeness."""

    unlit, emits, uniform_emission = False, False, None

    def __init__(self, reference: SdfReference, wanted: int) -> None:
        self._reference, self._wanted = reference, wanted

    @property
    def bounds(self) -> NDArray[np.floating]:
        """See ``Reference``."""
        return self._reference.bounds

    @cached_property
    def triangles(self) -> Triangles:
        """See ``Survey``: an isosurface, made when it is first asked for. Raises InputError."""
        field = self._reference.field
        positions, faces = isosurface(field.distance, field.bounds, self._wanted)
        closed = Material("closed", double_sided=False)
        mesh = Mesh(positions, faces, material=closed)
        return MeshSurvey(MeshReference(Asset((mesh,)))).triangles

    def spread(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See ``Survey``."""
        p = self.triangles.positions
        p = p[:: max(1, len(p) // count)]
        with dr.suspend_grad():
            normals = np.array(self._reference.normal(mi.Point3f(p.T))).T
        return p, np.ascontiguousarray(normals)

    def find(
        self, origin: mi.Point3f, direction: mi.Vector3f, reach: mi.Float, pick: Pick = "nearest"
    ) -> Found:
        """See ``Survey``: where rays leave the shape, or come from inside of it looked at from the
        other end."""
        with dr.suspend_grad():
            if pick == "outermost":
                start = dr.fma(direction, reach, origin)
                t = self._crossing(start, -direction, 2 * reach, leaving=False)
                distance, valid = reach - t, t < 2 * reach
            else:
                back = BACK * reach
                ahead = self._crossing(
                    dr.fma(-direction, back, origin), direction, reach + back, leaving=True
                )
                behind = self._crossing(
                    dr.fma(direction, back, origin), -direction, reach + back, leaving=False
                )
                t = dr.select(ahead < behind, ahead, behind) - back
                distance, valid = dr.select(ahead < behind, t, -t), t < reach
            place = dr.fma(direction, dr.select(valid, distance, 0), origin)
            return Found(distance, valid, mi.Point3f(place))

    def _crossing(
        self, origin: mi.Point3f, direction: mi.Vector3f, length: mi.Float, leaving: bool
    ) -> mi.Float:
        """Distance along rays to where they first leave the shape, or enter it; infinite if they do
        not within ``length``."""
        field, safety = self._reference.field, self._reference.tracing.safety
        least = LEAST_STEP * length

        def distance(t: mi.Float) -> mi.Float:
            value = field.distance(dr.fma(direction, t, origin))
            return value if leaving else -value  # below zero before the crossing

        def march(t, last, before, found, k):  # type: ignore[no-untyped-def]
            here = distance(t)
            found = (k > 0) & (before < 0) & (here >= 0)
            step = dr.fmax(abs(here) * safety, least)
            return (
                dr.select(found, t, t + step),
                dr.select(found, last, t),
                dr.select(found, before, here),
                found,
                k + 1,
            )

        def going(t, last, before, found, k):  # type: ignore[no-untyped-def]
            return ~found & (k < STEPS) & (t < length + least)

        width = max(dr.width(origin), dr.width(length))
        zero = dr.zeros(mi.Float, width)
        t, low, _, found, _ = dr.while_loop(
            (zero, zero, zero, mi.Bool(zero > 1), dr.zeros(mi.UInt32, width)),
            going,
            march,
            label="crossing",
        )
        high, d_low, d_high = t, distance(low), distance(t)
        for _ in range(REFINEMENTS):  # secants that keep the crossing between their ends
            middle = low + (high - low) * dr.fmin(
                dr.fmax(d_low / dr.fmin(d_low - d_high, -1e-12), 0.05), 0.95
            )
            d = distance(middle)
            low, d_low = dr.select(d < 0, middle, low), dr.select(d < 0, d, d_low)
            high, d_high = dr.select(d < 0, high, middle), dr.select(d < 0, d_high, d)
        at = dr.select(-d_low < d_high, low, high)
        out = dr.select(found & (at <= length), at, dr.inf)
        dr.eval(out)
        return out

    def geometry(self, found: Found) -> Geometry:
        """See ``Survey``."""
        with dr.suspend_grad():
            normal = self._reference.normal(found.place)
            return Geometry(found.place, normal, mi.Vector3f(normal))

    def appearance(self, found: Found, area: mi.Float) -> Appearance:
        """See ``Survey``; taken at the point itself."""
        with dr.suspend_grad():
            made = self._reference.material(found.place)
            width = dr.width(found.place)
            return Appearance(
                made.base_color + dr.zeros(mi.Color3f, width),
                made.roughness + dr.zeros(mi.Float, width),
                made.metalness + dr.zeros(mi.Float, width),
                self._reference.normal(found.place),
            )

    def emission(self, found: Found, area: mi.Float) -> list[mi.Float]:
        """See ``Survey``: none."""
        return [dr.zeros(mi.Float, dr.width(found.distance)) for _ in range(3)]

    def curvature(self, found: Found) -> mi.Float:
        """See ``Survey``: half the divergence of the unit normal."""
        normal, p, h = self._reference.normal, found.place, CURVATURE_WIDTH
        total = mi.Float(0)
        with dr.suspend_grad():
            for axis in range(3):
                step = mi.Vector3f(*(h * (k == axis) for k in range(3)))
                total += (normal(p + step) - normal(p - step))[axis]
        return total / (4 * h)

    def front_only(self, found: Found) -> mi.Bool | None:
        """See ``Survey``: nobody sees the inside of what is closed."""
        return None

    def blocked(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        """See ``Survey``."""
        with dr.suspend_grad():
            start, end = self._reference.clip(ray.o, ray.d)
            start = dr.select(active, dr.fmax(start, LIFT), dr.inf)
            field, tracing = self._reference.field, self._reference.tracing
            end = dr.fmin(end, ray.maxt)
            return sphere_trace(field.distance, ray.o, ray.d, start, end, tracing.safety).valid
