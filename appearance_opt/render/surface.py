"""Posed geometry on the device, and its attributes at the samples of an image."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from appearance_opt.render.camera import Camera, direction
from appearance_opt.render.math import at_least, at_most, clamp, unit
from appearance_opt.render.samples import Samples

GRAZING_COSINE = 0.2
"""Mip levels are chosen as if no surface were seen at a flatter angle than this: isotropic lookups
at grazing angles would otherwise blur everything along the short axis of the footprint, too."""

EDGE_ON_COSINE = 0.05
"""Surfaces seen at a flatter angle pass on less of the derivative of the place that a ray hits, in
proportion. It grows with the inverse of the cosine while the chance of a ray to hit falls with the
cosine: the few that do would drown all others in noise."""

SLACK = 0.1
"""How far barycentric coordinates may lie outside of the triangle that was hit: rounding of healthy
triangles moves them by 1e-3 at most, and gradients end at the bounds."""


@dataclass
class Surface:
    """A triangle mesh ready to be shaded. All buffers are flat, padded to packets.

    ``faces`` (4 F): three vertex indices and a material index. ``vertices`` (8 V): position, 0,
    normal, 0. ``corners`` (4 F): three indices into ``frames`` and 0, or None where they equal the
    vertex indices. ``frames`` (8 R): u, v, handedness, 0, tangent, 0; or (2 R): u, v without a
    normal map (``has_tangents`` is False then); or None without texture coordinates. ``colors`` (4
    V): linear vertex colour, alpha, or None. ``vertices`` and ``frames`` may carry gradients.
    ``culled`` (F,): faces that are not to be seen from behind (see ``asset.sides.culled``), or None
    without any.
    """

    faces: mi.UInt32
    vertices: mi.Float
    corners: mi.UInt32 | None = None
    frames: mi.Float | None = None
    colors: mi.Float | None = None
    has_tangents: bool = True
    culled: mi.Bool | None = None


@dataclass
class Hit:
    """What the shader needs at each sample. Directions are unit vectors in world space.

    ``footprint``: area of the sample in UV space, detached. ``handedness``: sign of the bitangent.
    ``color``, ``alpha``: of the vertices.
    """

    position: mi.Point3f
    normal: mi.Vector3f
    to_viewer: mi.Vector3f
    material: mi.UInt32
    uv: mi.Point2f | None = None
    footprint: mi.Float | None = None
    tangent: mi.Vector3f | None = None
    handedness: mi.Float | None = None
    color: mi.Color3f | None = None
    alpha: mi.Float | None = None


def interpolate(
    surface: Surface, camera: Camera, samples: Samples, resolution: mi.Float, width: mi.Float
) -> Hit:
    """Interpolate attributes where the camera rays of ``samples`` (all hits) meet their triangles.

    Barycentric coordinates are recomputed from the vertex positions (Moeller and Trumbore 1997), so
    that gradients flow to the positions: the ray stands still, the surface moves under it.
    ``width``: width of a sample in pixels. The normal is turned towards the viewer when the back of
    the triangle is seen.
    """
    triangle = _gather(surface, samples.triangle)
    p = triangle.positions
    e1, e2 = p[1] - p[0], p[2] - p[0]
    d = direction(camera, samples.x, samples.y, resolution)
    q = dr.cross(d, e2)
    determinant = dr.dot(e1, q)
    inverse = dr.rcp(dr.select(dr.abs(determinant) > 1e-30, determinant, 1e-30))
    o = camera.eye - p[0]
    # within the triangle, where a sliver or a grazing ray leaves no digit of them
    b1 = clamp(dr.dot(o, q) * inverse, -SLACK, 1 + SLACK)
    r = dr.cross(o, e1)
    b2 = clamp(dr.dot(d, r) * inverse, -SLACK, 1 + SLACK)
    depth = dr.detach(dr.dot(e2, r) * inverse)

    facing = dr.detach(dr.cross(e1, e2))
    length = dr.norm(d)
    cosine = dr.dot(facing, d) / (length * at_least(dr.norm(facing), 1e-30))
    if dr.grad_enabled(b1, b2):
        share = at_most(dr.abs(cosine) * (1 / EDGE_ON_COSINE), 1)
        b1, b2 = (dr.detach(x) + share * (x - dr.detach(x)) for x in (b1, b2))
    # from the corners, not along the ray: that is within the triangle whatever became of the depth
    position = dr.fma(e1, b1, dr.fma(e2, b2, p[0]))
    hit = Hit(position, mi.Vector3f(0), d / -length, triangle.face[3])
    pixel = depth * (2 * width / resolution) * dr.norm(camera.right)
    area = dr.square(pixel) / at_least(dr.abs(cosine), GRAZING_COSINE)
    _attributes(hit, surface, triangle, (b1, b2), facing, area)
    # the back of a triangle is seen: turning the normal over also turns the bitangent, which the
    # sign of the handedness undoes
    back = cosine > 0
    hit.normal = dr.select(back, -hit.normal, hit.normal)
    if hit.handedness is not None:
        hit.handedness = dr.select(back, -hit.handedness, hit.handedness)
    return hit


def interpolate_at(
    surface: Surface, triangle: mi.UInt32, b1: mi.Float, b2: mi.Float, area: mi.Float
) -> Hit:
    """Interpolate attributes at barycentric points of triangles, seen from outside; ``area`` of the
    patch that a point stands for, in world units squared. ``to_viewer`` is zero."""
    here = _gather(surface, triangle)
    p = here.positions
    facing = dr.cross(p[1] - p[0], p[2] - p[0])
    position = p[0] * (1 - b1 - b2) + p[1] * b1 + p[2] * b2
    hit = Hit(position, mi.Vector3f(0), mi.Vector3f(0), here.face[3])
    _attributes(hit, surface, here, (b1, b2), facing, area)
    return hit


def face_normal(surface: Surface, triangle: mi.UInt32, active: mi.Bool) -> mi.Vector3f:
    """Return the normal of triangles by their winding, not normalised; zero where inactive."""
    face = dr.gather(mi.ArrayXu, surface.faces, triangle, active, shape=(4, dr.width(triangle)))
    p = []
    for k in range(3):
        row = dr.gather(
            mi.ArrayXf, surface.vertices, face[k], active, shape=(8, dr.width(triangle))
        )
        p.append(mi.Point3f(row[0], row[1], row[2]))
    return dr.cross(p[1] - p[0], p[2] - p[0])


def vertex_position(surface: Surface, index: mi.UInt32) -> mi.Point3f:
    """Gather the positions of vertices; differentiable."""
    v = _packet(surface.vertices, index, 8)
    return mi.Point3f(v[0], v[1], v[2])


@dataclass
class _Triangle:
    """Triangles of the numbers ``index``: packets of their ``face`` and of their three vertices."""

    index: mi.UInt32
    face: mi.ArrayXu
    vertices: list

    @property
    def positions(self) -> list:
        return [mi.Point3f(v[0], v[1], v[2]) for v in self.vertices]


def _gather(surface: Surface, triangle: mi.UInt32) -> _Triangle:
    face = dr.gather(mi.ArrayXu, surface.faces, triangle, shape=(4, dr.width(triangle)))
    return _Triangle(triangle, face, [_packet(surface.vertices, face[k], 8) for k in range(3)])


def _attributes(
    hit: Hit,
    surface: Surface,
    triangle: _Triangle,
    barycentric: tuple[mi.Float, mi.Float],
    facing: mi.Vector3f,
    area: mi.Float,
) -> None:
    """Fill in the interpolated attributes of ``hit``: normal, and what the surface has of vertex
    colours, texture coordinates and tangents. ``facing``: normal of the triangle by its winding,
    twice its area long; it is taken where vertices have no normal. ``area`` of a sample on the
    surface becomes its UV footprint."""
    (b1, b2), face = barycentric, triangle.face
    b0 = 1 - b1 - b2

    def mix(values: list) -> mi.Float:
        return dr.fma(values[0], b0, dr.fma(values[1], b1, values[2] * b2))

    normal = unit(mi.Vector3f(*(mix([v[c] for v in triangle.vertices]) for c in (4, 5, 6))))
    hit.normal = dr.select(dr.squared_norm(normal) > 0, normal, unit(dr.detach(facing)))
    if surface.colors is not None:
        c = [_packet(surface.colors, face[k], 4) for k in range(3)]
        hit.color = mi.Color3f(*(mix([v[k] for v in c]) for k in range(3)))
        hit.alpha = mix([v[3] for v in c])
    if surface.frames is None:
        return
    corner = face
    if surface.corners is not None:
        shape = (4, dr.width(triangle.index))
        corner = dr.gather(mi.ArrayXu, surface.corners, triangle.index, shape=shape)
    f = [_packet(surface.frames, corner[k], 8 if surface.has_tangents else 2) for k in range(3)]
    hit.uv = mi.Point2f(mix([v[0] for v in f]), mix([v[1] for v in f]))
    a, b = (dr.detach(mi.Point2f(f[k][0] - f[0][0], f[k][1] - f[0][1])) for k in (1, 2))
    uv_area = dr.abs(a.x * b.y - a.y * b.x)
    hit.footprint = area * uv_area / at_least(dr.norm(dr.detach(facing)), 1e-30)
    if surface.has_tangents:
        hit.tangent = unit(mi.Vector3f(*(mix([v[c] for v in f]) for c in (4, 5, 6))))
        hit.handedness = f[0][2]


def _packet(buffer: mi.Float, index: mi.UInt32, channels: int) -> mi.ArrayXf:
    return dr.gather(
        mi.ArrayXf, buffer, index, mode=dr.ReduceMode.Expand, shape=(channels, dr.width(index))
    )


def interpolate_packets(
    surface: Surface,
    values: mi.Float,
    triangle: mi.UInt32,
    b1: mi.Float,
    b2: mi.Float,
    channels: int,
) -> list[mi.Float]:
    """Interpolate values per vertex (packets of ``channels``) at barycentric points of
    triangles."""
    n = dr.width(triangle)
    face = dr.gather(mi.ArrayXu, surface.faces, triangle, shape=(4, n))
    rows = [dr.gather(mi.ArrayXf, values, face[k], shape=(channels, n)) for k in range(3)]
    b0 = 1 - b1 - b2
    return [
        dr.fma(rows[0][c], b0, dr.fma(rows[1][c], b1, rows[2][c] * b2)) for c in range(channels)
    ]
