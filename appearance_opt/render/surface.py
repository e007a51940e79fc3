"""Posed geometry on the device, and its attributes at the samples of an image."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from appearance_opt.render.math import at_least
from appearance_opt.render.rays import Camera, Samples, direction

GRAZING_COSINE = 0.2
"""Mip levels are chosen as if no surface were seen at a flatter angle than this: isotropic lookups at
grazing angles would otherwise blur everything along the short axis of the footprint, too."""


@dataclass
class Surface:
    """A triangle mesh ready to be shaded. All buffers are flat, padded to packets.

    ``faces`` (4 F): three vertex indices and a material index. ``vertices`` (8 V): position, 0,
    normal, 0. ``corners`` (4 F): three indices into ``frames`` and 0, or None where they equal the
    vertex indices. ``frames`` (8 R): u, v, handedness, 0, tangent, 0; or (2 R): u, v without a normal
    map; or None without texture coordinates. ``colors`` (4 V): linear vertex colour, 0, or None.
    ``vertices`` and ``frames`` may carry gradients.
    """

    faces: mi.UInt32
    vertices: mi.Float
    corners: mi.UInt32 | None = None
    frames: mi.Float | None = None
    colors: mi.Float | None = None
    has_tangents: bool = True


@dataclass
class Hit:
    """What the shader needs at each sample. Directions are unit vectors in world space.

    ``footprint``: area of the sample in UV space, detached. ``handedness``: sign of the bitangent.
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


def interpolate(surface: Surface, camera: Camera, samples: Samples, resolution: mi.Float, width: mi.Float) -> Hit:
    """Attributes where the camera rays of ``samples`` (all hits) meet their triangles.

    Barycentric coordinates are recomputed from the vertex positions (Moeller and Trumbore 1997), so
    that gradients flow to the positions: the ray stands still, the surface moves under it. ``width``:
    width of a sample in pixels. The normal is turned towards the viewer when the back of the triangle
    is seen.
    """
    count = dr.width(samples.triangle)
    face = dr.gather(mi.ArrayXu, surface.faces, samples.triangle, shape=(4, count))
    rows = [_packet(surface.vertices, face[k], 8) for k in range(3)]
    p = [mi.Point3f(r[0], r[1], r[2]) for r in rows]
    e1, e2 = p[1] - p[0], p[2] - p[0]
    d = direction(camera, samples.x, samples.y, resolution)
    q = dr.cross(d, e2)
    determinant = dr.dot(e1, q)
    inverse = dr.rcp(dr.select(dr.abs(determinant) > 1e-30, determinant, 1e-30))
    o = camera.eye - p[0]
    b1 = dr.dot(o, q) * inverse
    r = dr.cross(o, e1)
    b2 = dr.dot(d, r) * inverse
    depth = dr.dot(e2, r) * inverse
    b0 = 1 - b1 - b2

    def mix(values: list) -> mi.Float:
        return dr.fma(values[0], b0, dr.fma(values[1], b1, values[2] * b2))

    facing = dr.detach(dr.cross(e1, e2))
    back = dr.dot(facing, d) > 0
    normal = dr.normalize(mi.Vector3f(*(mix([v[c] for v in rows]) for c in (4, 5, 6))))
    hit = Hit(
        position=dr.fma(d, depth, camera.eye),
        normal=dr.select(back, -normal, normal),
        to_viewer=-dr.normalize(d),
        material=face[3],
    )
    if surface.colors is not None:
        c = [_packet(surface.colors, face[k], 4) for k in range(3)]
        hit.color = mi.Color3f(*(mix([v[k] for v in c]) for k in range(3)))
    if surface.frames is None:
        return hit

    pixel = 2 * width / resolution * dr.norm(camera.right)  # width of a sample at depth 1
    corner = face
    if surface.corners is not None:
        corner = dr.gather(mi.ArrayXu, surface.corners, samples.triangle, shape=(4, count))
    f = [_packet(surface.frames, corner[k], 8 if surface.has_tangents else 2) for k in range(3)]
    hit.uv = mi.Point2f(mix([v[0] for v in f]), mix([v[1] for v in f]))
    hit.footprint = _uv_footprint([mi.Point2f(v[0], v[1]) for v in f], facing, d, dr.detach(depth) * pixel)
    if surface.has_tangents:
        hit.tangent = dr.normalize(mi.Vector3f(*(mix([v[c] for v in f]) for c in (4, 5, 6))))
        hit.handedness = f[0][2]
        # turning the normal over also turns the bitangent: undone here, so that the map's frame stays
        hit.handedness = dr.select(back, -hit.handedness, hit.handedness)
    return hit


def _packet(buffer: mi.Float, index: mi.UInt32, channels: int) -> mi.ArrayXf:
    return dr.gather(mi.ArrayXf, buffer, index, mode=dr.ReduceMode.Expand, shape=(channels, dr.width(index)))


def _uv_footprint(uv: list, facing: mi.Vector3f, d: mi.Vector3f, width: mi.Float) -> mi.Float:
    """Area in UV space of a sample of the given world-space width across the ray."""
    a, b = dr.detach(uv[1] - uv[0]), dr.detach(uv[2] - uv[0])
    uv_area = dr.abs(a.x * b.y - a.y * b.x)
    area = at_least(dr.norm(facing), 1e-30)
    cosine = dr.abs(dr.dot(facing, d)) * dr.rsqrt(dr.squared_norm(d)) / area
    return dr.square(width) / at_least(cosine, GRAZING_COSINE) * (uv_area / area)
