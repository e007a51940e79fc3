"""Closed-form transfer: what a reference mesh looks like, written into the maps of a simpler one.

For every texel, a ray along the interpolated normal of the simple mesh finds the point of the reference that
the texel stands for. No image, no optimisation: seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.initial.fill import fill
from appearance_opt.latent.latent import LatentMesh, LatentTopology
from appearance_opt.render import upload
from appearance_opt.render.rays import sub_pixel_offsets
from appearance_opt.render.surface import Hit, Surface, face_normal, interpolate_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.reference.mesh import MeshReference, SurfaceSample

CHANNELS = ("red", "green", "blue", "roughness", "metalness", "normal_x", "normal_y", "normal_z")
SAMPLES = 1
"""Rays per texel. More blur the maps: a texel is read bilinearly, which averages once already."""

LAYERS = 3
"""Surfaces that a ray passes through in search of one that faces the same way."""

REACH = 4.0
"""How far rays go, in units of the distance within which nearly all of the reference lies."""

QUANTILE = 0.999


@dataclass(frozen=True)
class TransferredMaps:
    """``maps``: channel name -> (size, size), natural units, filled everywhere. ``covered``: texels that
    belong to a triangle of the atlas. ``missed``: those among them whose rays found nothing."""

    maps: dict[str, NDArray[np.float32]]
    covered: NDArray[np.bool_]
    missed: NDArray[np.bool_]


def transfer(reference: MeshReference, mesh: LatentMesh, size: int) -> TransferredMaps:
    """Base colour, roughness, metalness and tangent-space normals of the reference in ``size`` x ``size``
    maps of ``mesh``."""
    with dr.suspend_grad():
        topology = LatentTopology(mesh, tangents=True)
        surface = topology.surface(mi.Float(np.ascontiguousarray(mesh.positions, np.float32).ravel()))
        atlas = atlas_scene(mesh)
        reach = dr.opaque(mi.Float, REACH * deviation(reference, mesh))
        total = dr.zeros(mi.Float, size * size * 16)
        for dx, dy in sub_pixel_offsets(SAMPLES):
            _add_sample(total, reference, surface, atlas, reach, size, float(dx), float(dy))
        sums = np.array(total).reshape(size, size, 16)
    hits, inside = sums[..., 8], sums[..., 9] > 0
    found = hits > 0
    mean = sums[..., :8] / np.maximum(hits, 1)[..., None]
    length = np.linalg.norm(mean[..., 5:8], axis=-1, keepdims=True)
    mean[..., 5:8] /= np.maximum(length, 1e-6)
    filled = fill(mean, found)
    return TransferredMaps({n: filled[..., k] for k, n in enumerate(CHANNELS)}, inside, inside & ~found)


def atlas_scene(mesh: LatentMesh) -> mi.Scene:
    """The atlas as a flat mesh in the plane z = 0: a ray down at (u, v) tells which triangle a texel
    belongs to."""
    flat = np.concatenate([mesh.uvs, np.zeros((len(mesh.uvs), 1), np.float32)], axis=1)
    return upload.scene_of(flat, mesh.frame_faces)


def texel_coverage(mesh: LatentMesh, size: int) -> NDArray[np.bool_]:
    """(size, size) texels whose centre lies in a triangle of the atlas."""
    i = dr.arange(mi.UInt32, size * size)
    hit = _atlas_hit(atlas_scene(mesh), i, size, 0.5, 0.5)
    return np.array(hit.is_valid()).reshape(size, size)


def deviation(reference: MeshReference, mesh: LatentMesh) -> float:
    """Distance within which nearly all of the reference (its quantile ``QUANTILE``) lies from the simple
    mesh, measured along the reference's normals."""
    merged = reference.merged
    every = max(1, len(merged.positions) // 50_000)
    p, n = merged.positions[::every], merged.normals[::every]
    scene = upload.scene_of(mesh.positions, mesh.faces)
    position, normal = mi.Point3f(p.T), mi.Vector3f(n.T)
    out = scene.ray_intersect_preliminary(mi.Ray3f(position, normal), coherent=False).t
    back = scene.ray_intersect_preliminary(mi.Ray3f(position, -normal), coherent=False).t
    nearest = np.array(dr.fmin(out, back))
    nearest = nearest[np.isfinite(nearest)]
    diagonal = float(np.linalg.norm(np.ptp(merged.positions, axis=0)))
    if not len(nearest):
        return 0.02 * diagonal
    # rays that find nothing near hit the far side of the object: they say nothing about the distance
    near = nearest[nearest < 0.05 * diagonal]
    return float(np.quantile(near, QUANTILE)) if len(near) else 0.02 * diagonal


def _atlas_hit(atlas: mi.Scene, texel: mi.UInt32, size: int, dx: float, dy: float) -> mi.PreliminaryIntersection3f:
    """What a ray down through a point of each texel meets in the flat atlas."""
    scale = dr.opaque(mi.Float, 1 / size)
    u = (mi.Float(texel % size) + dr.opaque(mi.Float, dx)) * scale
    v = (mi.Float(texel // size) + dr.opaque(mi.Float, dy)) * scale
    return atlas.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(u, v, 1), mi.Vector3f(0, 0, -1)), coherent=True)


def _add_sample(
    total: mi.Float,
    reference: MeshReference,
    surface: Surface,
    atlas: mi.Scene,
    reach: mi.Float,
    size: int,
    dx: float,
    dy: float,
) -> None:
    """Add one sample of every texel to its sums: 8 channels, hits, texels inside a chart."""
    i = dr.arange(mi.UInt32, size * size)
    scale = dr.opaque(mi.Float, 1 / size)
    hit = _atlas_hit(atlas, i, size, dx, dy)
    triangle, b1, b2 = mi.UInt32(hit.prim_index), hit.prim_uv.x, hit.prim_uv.y
    valid = hit.is_valid()
    dr.eval(triangle, b1, b2, valid)
    texel = dr.compress(valid)
    if dr.width(texel) == 0:
        return
    triangle, b1, b2 = (dr.gather(type(x), x, texel) for x in (triangle, b1, b2))
    here = interpolate_at(surface, triangle, b1, b2, mi.Float(0))
    area = _texel_area(surface, triangle, scale)
    prim, c1, c2, found = _nearest(reference, here, reach)
    dr.eval(prim, c1, c2, found)
    sample = reference.sample(dr.select(found, prim, 0), c1, c2, area)
    value = _in_frame(here, sample)
    rows = [dr.select(found, x, 0) for x in value] + [dr.select(found, mi.Float(1), 0), mi.Float(1)]
    rows += [mi.Float(0)] * (16 - len(rows))
    dr.scatter_reduce(dr.ReduceOp.Add, total, mi.ArrayXf(rows), texel, mode=dr.ReduceMode.NoConflicts)
    dr.eval(total)


def _nearest(reference: MeshReference, here: Hit, reach: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float, mi.Bool]:
    """The reference point of each texel: the nearest one along the normal, in either direction, whose
    surface faces the same way. Taking the first hit from a cage instead picks up neighbouring layers
    wherever parts lie close together (it costs 2 to 4 dB on such assets)."""
    ahead = _facing_hit(reference, here, here.normal, reach)
    behind = _facing_hit(reference, here, -here.normal, reach)
    take = ahead[3] < behind[3]
    prim, b1, b2, distance = (dr.select(take, a, b) for a, b in zip(ahead, behind, strict=True))
    return prim, b1, b2, distance < reach


def _facing_hit(
    reference: MeshReference, here: Hit, along: mi.Vector3f, reach: mi.Float
) -> tuple[mi.UInt32, mi.Float, mi.Float, mi.Float]:
    """(triangle, barycentrics, distance) of the first hit along a direction whose triangle faces the
    texel's way, passing through at most ``LAYERS`` others; infinite distance if there is none."""
    merged = reference.surface
    start = mi.Float(0)
    prim, b1, b2 = mi.UInt32(0), mi.Float(0), mi.Float(0)
    distance = dr.full(mi.Float, dr.inf, dr.width(here.position))
    for _ in range(LAYERS):
        open_ = ~dr.isfinite(distance) & (start < reach)
        ray = mi.Ray3f(dr.fma(along, start, here.position), along, reach, 0, mi.Color0f())
        hit = reference.scene.ray_intersect_preliminary(ray, coherent=False, active=open_)
        valid = hit.is_valid() & open_
        at = start + hit.t
        same = valid & (dr.dot(face_normal(merged, hit.prim_index, valid), here.normal) > 0)
        prim = dr.select(same, hit.prim_index, prim)
        b1, b2 = dr.select(same, hit.prim_uv.x, b1), dr.select(same, hit.prim_uv.y, b2)
        distance = dr.select(same, at, distance)
        start = dr.select(valid, at * (1 + 1e-4) + 1e-6 * reach, dr.inf)
        dr.eval(prim, b1, b2, distance, start)
    return prim, b1, b2, distance


def _in_frame(here: Hit, sample: SurfaceSample) -> list[mi.Float]:
    """Channels of a texel: the world-space normal expressed in the shader's frame, whose tangent need not
    be perpendicular to the interpolated normal."""
    n, t = here.normal, here.tangent
    assert t is not None and here.handedness is not None
    s = dr.select(dr.dot(sample.normal, n) < 0, -sample.normal, sample.normal)
    bitangent = dr.cross(n, t) * here.handedness
    c = dr.dot(n, t)
    scale = dr.rcp(dr.fmax(1 - c * c, 1e-3))
    x = (dr.dot(s, t) - c * dr.dot(s, n)) * scale
    y = dr.dot(s, bitangent) * scale
    z = (dr.dot(s, n) - c * dr.dot(s, t)) * scale
    color = sample.base_color
    return [color.x, color.y, color.z, sample.roughness, sample.metalness, x, y, dr.fmax(z, 0.05)]


def _texel_area(surface: Surface, triangle: mi.UInt32, scale: mi.Float) -> mi.Float:
    """World-space area of a texel of each triangle, for as many samples as a texel has."""
    hit = interpolate_at(surface, triangle, mi.Float(1 / 3), mi.Float(1 / 3), mi.Float(1))
    assert hit.footprint is not None
    return dr.square(scale) / (dr.fmax(hit.footprint, 1e-20) * SAMPLES)
