"""The point of the heavy mesh that each texel stands for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.render import upload
from appearance_opt.render.passing import meet, numbers_of, parts_of, scene_in
from appearance_opt.render.surface import face_normal

if TYPE_CHECKING:
    from appearance_opt.baking.texel_points import Points
    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.reference.mesh import MeshReference
    from appearance_opt.render.passing import Half

LAYERS = 3
"""Surfaces that a ray passes through in search of one that faces the same way."""

REACH = 4.0
"""How far rays go, in units of the distance within which nearly all of the reference lies."""

QUANTILE = 0.999

LEAST = 1e-3
"""Rays go at least this share of the reference's size, for meshes that coincide."""

BACK = 1e-3
"""How far before the surface rays start, in units of their reach."""

Pick = Literal["nearest", "outermost"]


@dataclass
class Found:
    """Per point: triangle and barycentrics of the reference, signed distance along the ray
    (positive outward), and whether there is one at all."""

    triangle: mi.UInt32
    b1: mi.Float
    b2: mi.Float
    distance: mi.Float
    valid: mi.Bool


def find(
    reference: MeshReference, points: Points, reach: mi.Float, pick: Pick = "nearest"
) -> Found:
    """The reference's point of each texel within ``reach``, whose triangle faces the way of the
    ray.

    "nearest": the nearest one along the ray in either direction. "outermost": the first one met
    from the cage inward, as most bakers do it; it picks up neighbouring layers wherever parts lie
    close together (it costs 2 to 4 dB on such assets), but sees parts that float above the surface.
    """
    along, position = points.along, points.here.position
    if pick == "outermost":
        start = dr.fma(along, reach, position)
        triangle, b1, b2, t = _facing_hit(reference, start, -along, along, 2 * reach)
        return Found(triangle, b1, b2, reach - t, t < 2 * reach)
    # a ray from a surface does not meet that surface: start a little before it, for where the two
    # meshes coincide
    back = BACK * reach
    ahead = _facing_hit(reference, dr.fma(-along, back, position), along, along, reach + back)
    behind = _facing_hit(reference, dr.fma(along, back, position), -along, along, reach + back)
    take = ahead[3] < behind[3]
    triangle, b1, b2, t = (dr.select(take, a, b) for a, b in zip(ahead, behind, strict=True))
    t -= back
    return Found(triangle, b1, b2, dr.select(take, t, -t), t < reach)


def _facing_hit(
    reference: MeshReference,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    facing: mi.Vector3f,
    length: mi.Float,
) -> tuple[mi.UInt32, mi.Float, mi.Float, mi.Float]:
    """(triangle, barycentrics, distance) of the first hit of rays whose triangle faces the way of
    ``facing``, passing through at most ``LAYERS`` others; infinite distance if there is none."""
    found = [
        _first_facing(reference, p, origin, direction, facing, length)
        for p in parts_of(reference.scene)
    ]
    if len(found) == 1:
        return found[0]
    first = found[0][3] <= found[1][3]
    prim, b1, b2, distance = (dr.select(first, a, b) for a, b in zip(*found, strict=True))
    return prim, b1, b2, distance


def _first_facing(
    reference: MeshReference,
    part: mi.Scene | Half,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    facing: mi.Vector3f,
    length: mi.Float,
) -> tuple[mi.UInt32, mi.Float, mi.Float, mi.Float]:
    """The same among the faces of one part of the reference's scene."""
    scene = scene_in(part)
    start = mi.Float(0)
    prim, b1, b2 = mi.UInt32(0), mi.Float(0), mi.Float(0)
    distance = dr.full(mi.Float, dr.inf, dr.width(origin))
    for _ in range(LAYERS):
        open_ = ~dr.isfinite(distance) & (start < length)
        ray = mi.Ray3f(dr.fma(direction, start, origin), direction, length, 0, mi.Color0f())
        hit = scene.ray_intersect_preliminary(ray, coherent=False, active=open_)
        valid = hit.is_valid() & open_
        at, number = start + hit.t, numbers_of(part, hit.prim_index, valid)
        same = valid & (dr.dot(face_normal(reference.surface, number, valid), facing) > 0)
        prim = dr.select(same, number, prim)
        b1, b2 = dr.select(same, hit.prim_uv.x, b1), dr.select(same, hit.prim_uv.y, b2)
        distance = dr.select(same, at, distance)
        start = dr.select(valid, at * (1 + 1e-4) + 1e-6 * length, dr.inf)
        dr.eval(prim, b1, b2, distance, start)
    return prim, b1, b2, distance


def automatic_reach(reference: MeshReference, mesh: LatentMesh) -> float:
    """The automatic cage: ``REACH`` times the distance within which nearly all of the reference
    lies."""
    diagonal = float(np.linalg.norm(np.ptp(reference.merged.positions, axis=0)))
    return max(REACH * deviation(reference, mesh), LEAST * diagonal)


def deviation(reference: MeshReference, mesh: LatentMesh) -> float:
    """Distance within which nearly all of the reference (its quantile ``QUANTILE``) lies from the
    simple mesh, measured along the reference's normals."""
    merged = reference.merged
    every = max(1, len(merged.positions) // 50_000)
    p, normals = merged.positions[::every], merged.normals[::every]
    scene = upload.scene_of(mesh.positions, mesh.faces)
    position, normal = mi.Point3f(p.T), mi.Vector3f(normals.T)
    out, back = (meet(scene, mi.Ray3f(position, n)).t for n in (normal, -normal))
    nearest = np.array(dr.fmin(out, back))
    nearest = nearest[np.isfinite(nearest)]
    diagonal = float(np.linalg.norm(np.ptp(merged.positions, axis=0)))
    if not len(nearest):
        return 0.02 * diagonal
    # rays that find nothing near hit the far side of the object: they say nothing about the
    # distance
    near = nearest[nearest < 0.05 * diagonal]
    return float(np.quantile(near, QUANTILE)) if len(near) else 0.02 * diagonal
