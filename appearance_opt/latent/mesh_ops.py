"""Differentiable operations on the latent mesh: normals and tangent bases of moving positions.

Each is a pure function of flat device buffers. The definitions are those of the exporter and of the
closed-form transfer (``asset.normals``, ``asset.tangents``): angle-weighted vertex normals
(Thuermer and Wuethrich 1998) and MikkTSpace's tangents.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from appearance_opt.asset.normals import CANCELLED
from appearance_opt.render.math import angle_of, at_least, unit

TINY = 1e-20


@dataclass
class Corners:
    """Fixed connectivity of F triangles over V welded vertices, G normals (see ``LatentMesh``) and
    R render vertices (split at UV seams and creases).

    ``vertex``: 3 index arrays of width F into the vertices; ``normal``, ``frame``: the same into
    the normals and into the render vertices; ``normal_vertex``: (G,) vertex of each normal, None
    where each vertex has one; ``frame_normal``: (R,) normal of each render vertex; ``uvs``: (2 R,)
    flat. ``local``, ``edge``: (G,) see ``LatentMesh``; None where normals are those of faces."""

    vertex: tuple[mi.UInt32, mi.UInt32, mi.UInt32]
    normal: tuple[mi.UInt32, mi.UInt32, mi.UInt32]
    frame: tuple[mi.UInt32, mi.UInt32, mi.UInt32]
    normal_vertex: mi.UInt32 | None
    frame_normal: mi.UInt32
    uvs: mi.Float
    edge: mi.UInt32 | None
    local: mi.Vector3f | None


def vertex_normals(positions: mi.Float, corners: Corners) -> mi.Vector3f:
    """Unit normals (G) of flat positions (3 V): face normals weighted by the corner's angle. Zero
    where they cancel, or at a vertex that no face uses: there, the face's own is taken
    (``render.surface``).

    Or, with ``corners.local``, vectors whose coordinates are constant in the basis of that normal
    as z, and an edge at the vertex, projected on its plane, as x: they turn with the mesh."""
    p = [dr.gather(mi.Point3f, positions, i) for i in corners.vertex]
    normal = unit(dr.cross(p[1] - p[0], p[2] - p[0]))
    own = corners.normal_vertex
    count = dr.width(positions) // 3 if own is None else dr.width(own)
    total, weight = dr.zeros(mi.Float, 3 * count), dr.zeros(mi.Float, count)
    for k in range(3):
        angle = _angle(unit(p[(k + 1) % 3] - p[k]), unit(p[(k + 2) % 3] - p[k]))
        dr.scatter_add(total, normal * angle, corners.normal[k])
        dr.scatter_add(weight, dr.detach(angle), corners.normal[k])
    out = _direction(dr.unravel(mi.Vector3f, total), weight, mi.Vector3f(0))
    if corners.local is None or corners.edge is None:
        return out
    here = dr.arange(mi.UInt32, count) if own is None else own
    edge = dr.gather(mi.Vector3f, positions, corners.edge)
    x = unit(_in_plane(edge - dr.gather(mi.Vector3f, positions, here), out))
    c = corners.local
    return unit(x * c.x + dr.cross(out, x) * c.y + out * c.z)


def vertex_tangents(positions: mi.Float, normals: mi.Vector3f, corners: Corners) -> mi.Vector3f:
    """Unit tangents (R): per corner the direction of growing u, projected on the plane of the
    corner's vertex normal, normalised, weighted by the angle in that plane (MikkTSpace)."""
    p = [dr.gather(mi.Point3f, positions, i) for i in corners.vertex]
    uv = [dr.gather(mi.Point2f, corners.uvs, i) for i in corners.frame]
    a, b = uv[1] - uv[0], uv[2] - uv[0]
    determinant = a.x * b.y - a.y * b.x
    along_u = ((p[1] - p[0]) * b.y - (p[2] - p[0]) * a.y) * dr.sign(determinant)
    usable = dr.abs(determinant) > TINY
    total = dr.zeros(mi.Float, 3 * dr.width(corners.frame_normal))
    weight = dr.zeros(mi.Float, dr.width(corners.frame_normal))
    for k in range(3):
        n = dr.gather(mi.Vector3f, normals, corners.normal[k])
        edge, other = p[(k + 1) % 3] - p[k], p[(k + 2) % 3] - p[k]
        angle = _angle(unit(_in_plane(edge, n)), unit(_in_plane(other, n)))
        value = dr.select(usable, unit(_in_plane(along_u, n)) * angle, 0)
        dr.scatter_add(total, value, corners.frame[k])
        dr.scatter_add(weight, dr.detach(angle), corners.frame[k])
    n = dr.gather(mi.Vector3f, normals, corners.frame_normal)
    n = dr.select(dr.squared_norm(n) > 0, n, mi.Vector3f(0, 0, 1))
    fallback = dr.normalize(
        dr.cross(n, dr.select(dr.abs(n.x) < 0.9, mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)))
    )
    return _direction(dr.unravel(mi.Vector3f, total), weight, fallback)


def _direction(summed: mi.Vector3f, weight: mi.Float, fallback: mi.Vector3f) -> mi.Vector3f:
    """Unit vector along a sum of unit vectors with the given total ``weight``; ``fallback`` where
    they cancel."""
    squared = dr.squared_norm(summed)
    ok = squared > dr.square(CANCELLED * weight)
    return dr.select(ok, summed * dr.rsqrt(dr.select(ok, squared, 1)), fallback)


def packed_vertices(
    positions: mi.Float, normals: mi.Vector3f, vertex: mi.UInt32 | None = None
) -> mi.Float:
    """Packets (8 G) of G normals and the positions they are at: position, 0, normal, 0.
    ``vertex`` (G,): which of the flat positions (3 V) that is; None: the one with its number."""
    if vertex is None:
        vertex = dr.arange(mi.UInt32, dr.width(positions) // 3)
    # not dr.unravel: its derivative overwrites what other uses of the same positions have handed
    # back
    p = dr.gather(mi.Point3f, positions, vertex)
    return interleave(p.x, p.y, p.z, mi.Float(0), normals.x, normals.y, normals.z, mi.Float(0))


def interleave(*columns: mi.Float) -> mi.Float:
    """Columns as packets, one after the other."""
    return dr.ravel(mi.ArrayXf(list(columns)), order="F")


def _in_plane(v: mi.Vector3f, n: mi.Vector3f) -> mi.Vector3f:
    return v - n * dr.dot(n, v)


def _angle(a: mi.Vector3f, b: mi.Vector3f) -> mi.Float:
    """Angle between vectors, as exact for thin corners as for wide ones (the arc cosine loses half
    of its digits there), with a finite derivative for parallel ones."""
    sine = dr.sqrt(at_least(dr.squared_norm(dr.cross(a, b)), 1e-16))
    return angle_of(sine, dr.dot(a, b))
