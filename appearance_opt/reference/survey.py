"""What starts, transfer and baking ask of the surface that a reference shows: places on it, and how
it looks there.

All lengths are in local units (see ``placement``). Methods that return device arrays work within
``dr.suspend_grad``; what is not asked for costs no kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.asset.packing import EMISSION
from appearance_opt.reference.curvature import mean_curvature
from appearance_opt.render import upload
from appearance_opt.render.material import evaluate, shading_normal
from appearance_opt.render.passing import blocked, numbers_of, parts_of, scene_in
from appearance_opt.render.surface import face_normal, interpolate_at, interpolate_packets

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.reference.mesh import MeshReference
    from appearance_opt.render.passing import Half, Scene

LAYERS = 3
"""Surfaces that a ray passes through in search of one that faces the same way."""

BACK = 1e-3
"""How far before the surface rays start, in units of their reach."""

Pick = Literal["nearest", "outermost"]


@dataclass
class Found:
    """What N rays found. ``distance``: signed, along the ray (positive ahead of its origin);
    ``valid``: is there anything at all? ``place``: where on the surface, in terms that only the
    survey that found it reads (of a mesh: triangle and barycentric coordinates)."""

    distance: mi.Float
    valid: mi.Bool
    place: Any


@dataclass
class Geometry:
    """``position``; unit vectors: ``normal`` of the surface itself, ``smooth`` the one it is shaded
    with, turned to the same side."""

    position: mi.Point3f
    normal: mi.Vector3f
    smooth: mi.Vector3f


@dataclass
class Appearance:
    """Linear base colour, roughness, metalness, unit shading normal in local space."""

    base_color: mi.Color3f
    roughness: mi.Float
    metalness: mi.Float
    normal: mi.Vector3f


@dataclass(frozen=True)
class Triangles:
    """The surface as triangles, from which starts are decimated. ``positions`` (V, 3); ``faces``
    (F, 3); ``single`` (F,): faces that are seen from their front only; ``scene``: the same for
    rays; ``owner`` (F,): number of the part to which each belongs, None for one part; ``poses``:
    where they are seen instead, if they move."""

    positions: NDArray[np.float32]
    faces: NDArray[np.int32]
    single: NDArray[np.bool_]
    scene: Scene
    owner: NDArray[np.int32] | None = None
    poses: tuple[Scene, ...] = ()


class Survey(Protocol):
    """A surface that can be asked.

    ``bounds`` (2, 3): as for ``Reference``. ``unlit``: does all of it show its base colour whatever
    the light? ``emits``: does any of it give off light? ``uniform_emission``: linear RGB by channel
    name where it gives off the same everywhere, else None. ``triangles``: itself, or a fine enough
    likeness.
    """

    @property
    def bounds(self) -> NDArray[np.floating]: ...
    @property
    def unlit(self) -> bool: ...
    @property
    def emits(self) -> bool: ...
    @property
    def uniform_emission(self) -> dict[str, float] | None: ...
    @property
    def triangles(self) -> Triangles: ...

    def spread(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """About ``count`` points of the surface (N, 3), and their unit normals."""
        ...

    def find(
        self, origin: mi.Point3f, direction: mi.Vector3f, reach: mi.Float, pick: Pick = "nearest"
    ) -> Found:
        """The surface that faces the way of ``direction`` (unit vectors), within ``reach`` along
        the ray.

        "nearest": the nearest one in either direction. "outermost": the first one met from the cage
        inward, as most bakers do it; it picks up neighbouring layers wherever parts lie close
        together, but sees parts that float above the surface (docs/trials.md: transfer).
        """
        ...

    def geometry(self, found: Found) -> Geometry:
        """Position and normals where something was found."""
        ...

    def appearance(self, found: Found, area: mi.Float) -> Appearance:
        """What the surface looks like there, averaged over a patch of ``area`` (square units)."""
        ...

    def emission(self, found: Found, area: mi.Float) -> list[mi.Float]:
        """Linear RGB that it gives off there. Only for a survey that ``emits``."""
        ...

    def curvature(self, found: Found) -> mi.Float:
        """Mean curvature (k1 + k2) / 2 there, in 1 / unit of length, positive where it is convex."""
        ...

    def front_only(self, found: Found) -> mi.Bool | None:
        """Is the surface there not to be seen from behind? None if all of it may be."""
        ...

    def blocked(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        """Does anything hide the origin of rays from someone at their far end, looking back?"""
        ...


@dataclass
class Place:
    """N points of a mesh: triangles, and barycentric coordinates of their second and third
    corners."""

    triangle: mi.UInt32
    b1: mi.Float
    b2: mi.Float


class MeshSurvey:
    """A ``Survey`` of the mesh that a ``MeshReference`` draws. ``poses``: see
    ``Triangles``."""

    def __init__(self, reference: MeshReference, poses: tuple[Scene, ...] = ()) -> None:
        self._reference, self._poses = reference, poses

    @property
    def bounds(self) -> NDArray[np.floating]:
        """See ``Reference``."""
        return self._reference.bounds

    @property
    def unlit(self) -> bool:
        """See ``Survey``."""
        return self._reference.unlit

    @property
    def emits(self) -> bool:
        """See ``Survey``."""
        return self._reference.emission is not None

    @property
    def uniform_emission(self) -> dict[str, float] | None:
        """See ``Survey``."""
        emission = self._reference.emission
        if emission is None or emission.layers:
            return None
        return {name: emission.constants[name] for name in EMISSION}

    @property
    def triangles(self) -> Triangles:
        """See ``Survey``."""
        r = self._reference
        m = r.merged
        return Triangles(m.positions, m.faces, r.single, r.scene, r.owner, self._poses)

    def spread(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See ``Survey``."""
        merged = self._reference.merged
        every = max(1, len(merged.positions) // count)
        return merged.positions[::every], merged.normals[::every]

    def find(
        self, origin: mi.Point3f, direction: mi.Vector3f, reach: mi.Float, pick: Pick = "nearest"
    ) -> Found:
        """See ``Survey``. Passes through at most ``LAYERS`` surfaces that face the other way."""
        if pick == "outermost":
            start = dr.fma(direction, reach, origin)
            place, t = self._facing_hit(start, -direction, direction, 2 * reach)
            return Found(reach - t, t < 2 * reach, place)
        # a ray from a surface does not meet that surface: start a little before it, for where the
        # two meshes coincide
        back = BACK * reach
        a, ahead = self._facing_hit(
            dr.fma(-direction, back, origin), direction, direction, reach + back
        )
        b, behind = self._facing_hit(
            dr.fma(direction, back, origin), -direction, direction, reach + back
        )
        take = ahead < behind
        t = dr.select(take, ahead, behind) - back
        return Found(dr.select(take, t, -t), t < reach, _select(take, a, b))

    def _facing_hit(
        self, origin: mi.Point3f, direction: mi.Vector3f, facing: mi.Vector3f, length: mi.Float
    ) -> tuple[Place, mi.Float]:
        """(place, distance) of the first hit of rays whose triangle faces the way of ``facing``;
        infinite distance if there is none."""
        found = [
            self._first_facing(part, origin, direction, facing, length)
            for part in parts_of(self._reference.scene)
        ]
        if len(found) == 1:
            return found[0]
        (a, ahead), (b, behind) = found
        first = ahead <= behind
        return _select(first, a, b), dr.select(first, ahead, behind)

    def _first_facing(
        self,
        part: mi.Scene | Half,
        origin: mi.Point3f,
        direction: mi.Vector3f,
        facing: mi.Vector3f,
        length: mi.Float,
    ) -> tuple[Place, mi.Float]:
        """The same among the faces of one part of the scene."""
        scene, surface = scene_in(part), self._reference.surface
        start = mi.Float(0)
        prim, b1, b2 = mi.UInt32(0), mi.Float(0), mi.Float(0)
        distance = dr.full(mi.Float, dr.inf, dr.width(origin))
        for _ in range(LAYERS):
            open_ = ~dr.isfinite(distance) & (start < length)
            ray = mi.Ray3f(dr.fma(direction, start, origin), direction, length, 0, mi.Color0f())
            hit = scene.ray_intersect_preliminary(ray, coherent=False, active=open_)
            valid = hit.is_valid() & open_
            at, number = start + hit.t, numbers_of(part, hit.prim_index, valid)
            same = valid & (dr.dot(face_normal(surface, number, valid), facing) > 0)
            prim = dr.select(same, number, prim)
            b1, b2 = dr.select(same, hit.prim_uv.x, b1), dr.select(same, hit.prim_uv.y, b2)
            distance = dr.select(same, at, distance)
            start = dr.select(valid, at * (1 + 1e-4) + 1e-6 * length, dr.inf)
            dr.eval(prim, b1, b2, distance, start)
        return Place(prim, b1, b2), distance

    def geometry(self, found: Found) -> Geometry:
        """See ``Survey``. ``Geometry.normal`` is the triangle's by its winding."""
        surface, (prim, b1, b2) = self._reference.surface, _address(found)
        with dr.suspend_grad():
            hit = interpolate_at(surface, prim, b1, b2, mi.Float(0))
            flat = face_normal(surface, prim, mi.Bool(True))
            flat *= dr.rsqrt(dr.fmax(dr.squared_norm(flat), 1e-30))
            smooth = dr.select(dr.dot(hit.normal, flat) < 0, -hit.normal, hit.normal)
            return Geometry(hit.position, flat, smooth)

    def appearance(self, found: Found, area: mi.Float) -> Appearance:
        """See ``Survey``."""
        reference, (prim, b1, b2) = self._reference, _address(found)
        with dr.suspend_grad():
            hit = interpolate_at(reference.surface, prim, b1, b2, area)
            sample = evaluate(reference.maps, hit)
            return Appearance(
                sample.base_color, sample.roughness, sample.metalness, shading_normal(hit, sample)
            )

    def emission(self, found: Found, area: mi.Float) -> list[mi.Float]:
        """See ``Survey``."""
        emission = self._reference.emission
        assert emission is not None
        if not emission.layers:
            return [mi.Float(emission.constants[name]) for name in EMISSION]
        prim, b1, b2 = _address(found)
        with dr.suspend_grad():
            hit = interpolate_at(self._reference.surface, prim, b1, b2, area)
            return emission.layers[0].at(hit)[:3]

    def curvature(self, found: Found) -> mi.Float:
        """See ``Survey``."""
        prim, b1, b2 = _address(found)
        return interpolate_packets(self._reference.surface, self._curvature, prim, b1, b2, 1)[0]

    @cached_property
    def _curvature(self) -> mi.Float:
        """Of the vertices."""
        merged = self._reference.merged
        return upload.packets(1, mean_curvature(merged.positions, merged.faces))

    def front_only(self, found: Found) -> mi.Bool | None:
        """See ``Survey``."""
        culled = self._reference.surface.culled
        return None if culled is None else dr.gather(mi.Bool, culled, _address(found)[0])

    def blocked(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        """See ``Survey``."""
        return blocked(self._reference.scene, ray, active)


def _select(first: mi.Bool, a: Place, b: Place) -> Place:
    return Place(
        dr.select(first, a.triangle, b.triangle),
        dr.select(first, a.b1, b.b1),
        dr.select(first, a.b2, b.b2),
    )


def _address(found: Found) -> tuple[mi.UInt32, mi.Float, mi.Float]:
    """(triangle, its barycentric coordinates), of any triangle where nothing was found."""
    place: Place = found.place
    return dr.select(found.valid, place.triangle, 0), place.b1, place.b2
