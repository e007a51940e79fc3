"""Rays that go on: the first of what a ray meets that counts.

A ray does not stop at the back of a single-sided face (glTF 2.0, 3.9.6; UsdGeomGprim.doubleSided),
nor at whatever else a caller says does not count. Two sheets back to back lie at exactly the same
distance, so that no step along the ray separates them: a scene with single-sided faces is therefore
two scenes, one of the faces that look to one side of a plane, one of the others
(``upload.scene_of``). What is back to back is never in the same one; each is searched by itself,
and the nearest that counts of both is seen. A scene without such faces is a plain ``mi.Scene``, and
costs what it always did.

To let rays pass through something else (cut-out or transparent texels), hand ``meet`` a predicate
``counts``: it is traced into the loop, so that it may look up textures. For layers one behind the
other call ``meet`` again with ``after``, the distance of the layer before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import drjit as dr
import mitsuba as mi

if TYPE_CHECKING:
    from collections.abc import Callable

    Scene: TypeAlias = "mi.Scene | SidedScene"
    """What rays are traced in."""

    Counts = Callable[["Met", mi.Vector3f], mi.Bool]
    """Does a ray of that direction stop at what it met?"""

MISS = 0xFFFFFFFF
"""Number of the triangle of a ray that hits none."""

MOST = 64
"""Faces that a ray passes through before it is taken for a miss."""

STEP = 2e-6
"""How far behind a face that does not count a ray starts anew, relative to the distance and to one
unit: some roundings. Where it meets the same face once more, that one does not count either."""


@dataclass
class Met:
    """What rays meet: number of the ``triangle`` or ``MISS``, barycentric coordinates ``b1``,
    ``b2`` of its second and third vertex, and the distance ``t`` along the ray (infinite for a
    miss)."""

    triangle: mi.UInt32
    b1: mi.Float
    b2: mi.Float
    t: mi.Float


@dataclass
class Half:
    """Some faces of a mesh. ``scene``: they alone; ``triangle``: their numbers in the whole mesh;
    ``normals`` (4 F): packets of what is at right angles to single-sided faces, by their winding,
    of any length, and of zeros for faces that are seen from both sides."""

    scene: mi.Scene
    triangle: mi.UInt32
    normals: mi.Float


@dataclass
class SidedScene:
    """A mesh with faces that are seen from one side only. No half holds two faces that lie back to
    back."""

    halves: list[Half]


def meet(
    scene: Scene,
    ray: mi.Ray3f,
    counts: Counts | None = None,
    after: mi.Float | None = None,
    active: mi.Bool | bool = True,
    coherent: bool = False,
) -> Met:
    """Find what rays see: the nearest face, within ``ray.maxt``, that does not turn its back to
    them (if it is single-sided) and that ``counts`` (all by default), farther than ``after`` along
    the ray (from its origin on by default). ``coherent``: as in Mitsuba. Directions are unit
    vectors."""
    if counts is None and after is None and not isinstance(scene, SidedScene):
        hit = scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
        return Met(
            dr.select(hit.is_valid(), hit.prim_index, MISS), hit.prim_uv.x, hit.prim_uv.y, hit.t
        )
    found = [_search(part, ray, counts, after, active, coherent) for part in parts_of(scene)]
    return found[0] if len(found) == 1 else _nearer(*found)


def blocked(scene: Scene, ray: mi.Ray3f, active: mi.Bool | bool = True) -> mi.Bool:
    """Tell whether anything hides the origin of rays from someone at their far end, looking back.
    What stands in the way is seen from there: a single-sided face that turns its front to the
    origin hides nothing."""
    if not isinstance(scene, SidedScene):
        return scene.ray_test(ray, active=active)
    out = mi.Bool(False)
    for half in scene.halves:
        out |= _search(half, ray, None, None, active & ~out, False, -1.0).triangle != MISS
    return out


def parts_of(scene: Scene) -> list[mi.Scene | Half]:
    """List the scenes to be searched one by one."""
    return list(scene.halves) if isinstance(scene, SidedScene) else [scene]


def scene_in(part: mi.Scene | Half) -> mi.Scene:
    """Return the Mitsuba scene of one part of a scene."""
    return part.scene if isinstance(part, Half) else part


def numbers_of(part: mi.Scene | Half, prim: mi.UInt32, valid: mi.Bool) -> mi.UInt32:
    """Return the numbers in the whole mesh of the triangles ``prim`` of one part of a scene;
    ``MISS`` where not ``valid``."""
    number = dr.gather(mi.UInt32, part.triangle, prim, valid) if isinstance(part, Half) else prim
    return dr.select(valid, number, MISS)


def _search(
    part: mi.Scene | Half,
    ray: mi.Ray3f,
    counts: Counts | None,
    after: mi.Float | None,
    active: mi.Bool | bool,
    coherent: bool,
    facing: float = 1.0,
) -> Met:
    """``meet`` in one part. ``facing``: 1 passes through backs, -1 through fronts of single-sided
    faces."""
    scene = scene_in(part)
    width = dr.width(ray)

    def visit(
        start: mi.Float,
        going: mi.Bool,
        number: mi.UInt32,
        triangle: mi.UInt32,
        b1: mi.Float,
        b2: mi.Float,
        t: mi.Float,
    ) -> tuple:
        on = mi.Ray3f(dr.fma(ray.d, start, ray.o), ray.d, ray.maxt - start, 0, mi.Color0f())
        hit = scene.ray_intersect_preliminary(on, coherent=coherent, active=going)
        going &= hit.is_valid()
        at = start + hit.t
        met = Met(numbers_of(part, hit.prim_index, going), hit.prim_uv.x, hit.prim_uv.y, at)
        stops = mi.Bool(going)
        if isinstance(part, Half):
            n = dr.gather(mi.ArrayXf, part.normals, hit.prim_index, going, shape=(4, width))
            stops &= facing * dr.dot(mi.Vector3f(n[0], n[1], n[2]), ray.d) <= 0
        if counts is not None:
            stops &= counts(met, ray.d)
        triangle = dr.select(stops, met.triangle, triangle)
        b1, b2, t = (
            dr.select(stops, new, old) for new, old in ((met.b1, b1), (met.b2, b2), (at, t))
        )
        going &= ~stops
        return (
            dr.select(going, dr.fma(STEP, at + 1, at), start),
            going,
            number + 1,
            triangle,
            b1,
            b2,
            t,
        )

    zero = dr.zeros(mi.Float, width)
    begin = zero if after is None else dr.fma(STEP, after + 1, after)
    state = (
        begin,
        mi.Bool(active) & (begin < ray.maxt),
        dr.zeros(mi.UInt32, width),
        dr.full(mi.UInt32, MISS, width),
        zero,
        mi.Float(zero),
        dr.full(mi.Float, dr.inf, width),
    )
    out = dr.while_loop(state, lambda _, going, number, *__: going & (number < MOST), visit)
    return Met(*out[3:])


def _nearer(one: Met, other: Met) -> Met:
    """Of two finds on the same ray the nearer."""
    first = one.t <= other.t
    fields = ((getattr(one, f), getattr(other, f)) for f in ("triangle", "b1", "b2", "t"))
    return Met(*(dr.select(first, a, b) for a, b in fields))
