"""Which points of a mesh the texels of its atlas stand for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.asset.normals import vertex_normals
from appearance_opt.latent.mesh import LatentMesh, LatentTopology
from appearance_opt.render import upload
from appearance_opt.render.surface import Hit, interpolate_at, interpolate_packets

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.render.passing import Scene

BAND = 1 << 20
"""Texels worked on at once: more saves no time and costs memory."""


@dataclass
class Points:
    """Points of a mesh that lie under texels of one band, one per texel.

    ``texel``: index into the band; ``here``: attributes of the mesh; ``along``: unit direction of
    the texel's ray; ``area``: world-space area that the point stands for; ``triangle``: of the
    mesh.
    """

    texel: mi.UInt32
    here: Hit
    along: mi.Vector3f
    area: mi.Float
    triangle: mi.UInt32


class TexelPoints:
    """The atlas of a mesh as a flat scene, and the mesh under it.

    Rays follow the mesh's smooth normals, averaged over all faces at a place, so that no gap opens
    at a hard edge; what they find is expressed in the mesh's own tangent bases.
    """

    def __init__(self, mesh: LatentMesh, size: int, samples: int = 1) -> None:
        self.mesh, self.size, self.samples = mesh, size, samples
        self.rows = max(1, min(size, BAND // size))
        positions = np.ascontiguousarray(mesh.positions, np.float32)
        self._topology = LatentTopology(mesh, tangents=True)
        self.surface = self._topology.surface(mi.Float(positions.ravel()))
        self.atlas = atlas_scene(mesh)
        self._directions: mi.Float | None = None
        follows = mesh.normal_faces is not None or mesh.normal_local is not None
        if follows or mesh.normals is not None:
            # a latent's vertices are one at each place, but where sheets lie back to back
            smooth = vertex_normals(positions, mesh.faces, welded=mesh.normals is None)
            self._directions = upload.packets(4, smooth[mesh.shading_vertex])

    @cached_property
    def scene(self) -> Scene:
        """The mesh itself, for rays; made when first asked for."""
        return self._topology.scene()

    def band(self, row: int, dx: float, dy: float) -> Points | None:
        """Points under (dx, dy), in texels, of the texels of ``rows`` rows from ``row`` on; None if
        there are none."""
        i = dr.arange(mi.UInt32, self.rows * self.size)
        scale = dr.opaque(mi.Float, 1 / self.size)
        hit = _atlas_hit(self.atlas, i, self.size, row, dx, dy)
        triangle, b1, b2 = mi.UInt32(hit.prim_index), hit.prim_uv.x, hit.prim_uv.y
        last = dr.opaque(mi.UInt32, (self.size - row) * self.size)
        valid = hit.is_valid() & (i < last)
        dr.eval(triangle, b1, b2, valid)
        texel = dr.compress(valid)
        if dr.width(texel) == 0:
            return None
        triangle, b1, b2 = (dr.gather(type(x), x, texel) for x in (triangle, b1, b2))
        here = interpolate_at(self.surface, triangle, b1, b2, mi.Float(1))
        assert here.footprint is not None
        # the footprint of a unit area is the inverse of the area of the whole texture
        area = dr.square(scale) / (dr.fmax(here.footprint, 1e-20) * self.samples)
        return Points(texel, here, self._direction(here, triangle, b1, b2), area, triangle)

    def _direction(self, here: Hit, triangle: mi.UInt32, b1: mi.Float, b2: mi.Float) -> mi.Vector3f:
        if self._directions is None:
            return here.normal
        return dr.normalize(
            mi.Vector3f(
                *interpolate_packets(self.surface, self._directions, triangle, b1, b2, 4)[:3]
            )
        )


def atlas_scene(mesh: LatentMesh) -> mi.Scene:
    """The atlas as a flat mesh in the plane z = 0: a ray down at (u, v) tells which triangle a
    texel belongs to."""
    flat = np.concatenate([mesh.uvs, np.zeros((len(mesh.uvs), 1), np.float32)], axis=1)
    return upload.scene_of(flat, mesh.frame_faces)


def texel_coverage(mesh: LatentMesh, size: int) -> NDArray[np.bool_]:
    """(size, size) texels whose centre lies in a triangle of the atlas."""
    i = dr.arange(mi.UInt32, size * size)
    hit = _atlas_hit(atlas_scene(mesh), i, size, 0, 0.5, 0.5)
    return np.array(hit.is_valid()).reshape(size, size)


def _atlas_hit(
    atlas: mi.Scene, texel: mi.UInt32, size: int, row: int, dx: float, dy: float
) -> mi.PreliminaryIntersection3f:
    """What a ray down through a point of each texel meets in the flat atlas."""
    scale = dr.opaque(mi.Float, 1 / size)
    u = (mi.Float(texel % size) + dr.opaque(mi.Float, dx)) * scale
    v = (mi.Float(texel // size) + dr.opaque(mi.Float, row + dy)) * scale
    return atlas.ray_intersect_preliminary(
        mi.Ray3f(mi.Point3f(u, v, 1), mi.Vector3f(0, 0, -1)), coherent=True
    )
