"""The tessellated, displaced mesh: v_i^d = v_i + tex2d(t_i) n_i (Hasselgren et al. 2021, equation
3).

v_i and n_i are position and unit normal interpolated from the base mesh, whose vertices may move;
tex2d is a scalar map in the units of the positions. A vertex on a UV seam has several texture
coordinates t_i: its displacement is the mean of their lookups, so that it stays one vertex and no
seam can open.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.latent import mesh_ops
from appearance_opt.latent.mesh import (
    LatentMesh,
    corners_of,
    edges_around,
    local_edge_length,
    without_creases,
)
from appearance_opt.latent.parts import Part, Pose
from appearance_opt.latent.subdivision import tessellate
from appearance_opt.latent.texels import PackedMaps
from appearance_opt.render.math import unit

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from appearance_opt.latent.parameter import Rates
    from appearance_opt.render.material import TexelLayer

DISPLACEMENT, TESSELLATION = "displacement", "tessellation"
"""Names of the parts; the first is also that of the channel."""


class Tessellator:
    """From base positions and a displacement map to the positions of one tessellation level.

    ``mesh``: the tessellated mesh, not displaced. Precomputed are the base vertices and weights of
    each of its vertices, where it reads the map and how finely.
    """

    def __init__(self, base: LatentMesh, level: int) -> None:
        fine = tessellate(base, level)
        self.mesh = fine.mesh
        # along the smooth normals of the faces, whatever it is shaded with: no gap may open
        self._base = corners_of(without_creases(base))
        self._parents = [
            mi.UInt32(np.ascontiguousarray(fine.parents[:, k], np.uint32)) for k in range(3)
        ]
        self._weights = [mi.Float(np.ascontiguousarray(fine.weights[:, k])) for k in range(3)]
        self._uv = mi.Point2f(np.ascontiguousarray(fine.mesh.uvs.T))
        self._footprint = mi.Float(footprint(fine.mesh))
        self._vertex = mi.UInt32(np.ascontiguousarray(fine.mesh.frame_vertex, np.uint32))
        self._share = mi.Float(share(fine.mesh))
        dr.eval(self._parents, self._weights, self._uv, self._footprint, self._vertex, self._share)

    def __call__(self, positions: mi.Float, relief: TexelLayer | None) -> mi.Float:
        """Flat positions (3 N) of the tessellated mesh from flat base positions (3 V) and the
        displacement map; differentiable in the positions (also through the normals) and the map's
        texels."""
        if relief is None:
            rows = [
                mi.ArrayXf(dr.gather(mi.Point3f, positions, i, mode=dr.ReduceMode.Expand))
                for i in self._parents
            ]
            return dr.ravel(mi.Point3f(*self._mix(rows, 0)))
        base = mesh_ops.packed_vertices(positions, mesh_ops.vertex_normals(positions, self._base))
        # Expand: hundreds of vertices hang on one base vertex, whose gradient atomics would
        # serialise
        rows = [
            dr.gather(mi.ArrayXf, base, i, mode=dr.ReduceMode.Expand, shape=(8, dr.width(i)))
            for i in self._parents
        ]
        point, normal = mi.Point3f(*self._mix(rows, 0)), unit(mi.Vector3f(*self._mix(rows, 4)))
        return dr.ravel(point + normal * self.amount(relief))

    def amount(self, relief: TexelLayer) -> mi.Float:
        """Displacement (N) of each vertex: the mean of its render vertices' lookups."""
        value = relief.pyramid.lookup(None, self._uv, self._footprint)[
            relief.channels.index(DISPLACEMENT)
        ]
        total = dr.zeros(mi.Float, len(self.mesh.positions))
        dr.scatter_add(total, value * self._share, self._vertex)
        return total

    def _mix(self, rows: list[mi.ArrayXf], first: int) -> list[mi.Float]:
        """Three channels from ``first`` on, of the three parents by their weights."""
        w = self._weights
        return [
            dr.fma(rows[0][c], w[0], dr.fma(rows[1][c], w[1], rows[2][c] * w[2]))
            for c in range(first, first + 3)
        ]


class Tessellation(Part):
    """The mesh drawn with more triangles, at one of some ``levels`` at a time; nothing of it is
    stored. ``base``: the mesh of level 0."""

    places = True

    def __init__(self, base: LatentMesh, levels: Iterable[int]) -> None:
        super().__init__(TESSELLATION)
        self._levels = tessellators(base, levels)

    def mesh(self, before: LatentMesh, level: int) -> LatentMesh:
        return self._levels[level].mesh

    def place(self, vertices: mi.Float, decoded: None, pose: Pose) -> mi.Float:
        return self._levels[pose.level](vertices, None)

    def fixed(self) -> tuple:
        return (self._levels,)


class Height(PackedMaps):
    """The displacement map, and the tessellated mesh that it displaces. ``image``: (size, size) in
    the units of the positions."""

    places = True

    def __init__(
        self, base: LatentMesh, levels: Iterable[int], image: NDArray, fitted: bool
    ) -> None:
        super().__init__(DISPLACEMENT, {DISPLACEMENT: image}, fitted)
        self._levels = tessellators(base, levels)

    def mesh(self, before: LatentMesh, level: int) -> LatentMesh:
        return self._levels[level].mesh

    def place(self, vertices: mi.Float, decoded: TexelLayer, pose: Pose) -> mi.Float:
        return self._levels[pose.level](vertices, decoded)

    def fixed(self) -> tuple:
        return (*super().fixed(), self._levels)

    def set_rates(self, rates: Rates) -> None:
        assert self.parameter is not None
        finest = self._levels[max(self._levels)].mesh
        edge = float(local_edge_length(finest.positions, finest.faces).mean())
        self.parameter.rate = mi.Float(edge * rates.displacement)

    def export(self) -> dict[str, NDArray[np.float32]]:
        size = self.codec.size
        texels = np.array(self.now().pyramid.texels)[: size * size]
        return {DISPLACEMENT: texels.reshape(size, size)}


def tessellators(base: LatentMesh, levels: Iterable[int]) -> dict[int, Tessellator]:
    """One for each level."""
    return {level: Tessellator(base, level) for level in levels}


def footprint(mesh: LatentMesh) -> NDArray[np.float32]:
    """(R,) UV area that a render vertex stands for: the square of half the mean UV length of the
    edges of the faces around it.

    A lookup with it reads the mip level at which a texel is half as long as an edge, and a bilinear
    one, whose weights reach a texel far on both sides, averages over one edge in all: finer detail
    could not be held by this mesh, and would alias (docs/trials.md: displacement).
    """
    length, count = edges_around(mesh.uvs, mesh.frame_faces)
    return np.square(0.5 * length / np.maximum(count, 1)).astype(np.float32)


def share(mesh: LatentMesh) -> NDArray[np.float32]:
    """(R,) one over the number of render vertices of the same vertex, those counted that a face
    uses; 0 for the others."""
    used = np.zeros(len(mesh.uvs), bool)
    used[mesh.frame_faces.ravel()] = True
    count = np.bincount(mesh.frame_vertex[used], minlength=len(mesh.positions))
    return np.where(used, 1 / np.maximum(count, 1)[mesh.frame_vertex], 0).astype(np.float32)
