"""The mesh of a latent: its fixed connectivity and atlas, on the host and on the device."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.asset.normals import weld
from appearance_opt.asset.sides import culled
from appearance_opt.latent import mesh_ops
from appearance_opt.latent.mesh_ops import Corners
from appearance_opt.render import upload
from appearance_opt.render.drawn import Drawn
from appearance_opt.render.edge_list import EdgeList, edge_list, walkable
from appearance_opt.render.surface import Surface
from appearance_opt.render.upload import MeshArrays

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.render.material import MaterialMaps
    from appearance_opt.render.passing import Scene


@dataclass(frozen=True)
class LatentMesh:
    """Host description of a latent: V welded vertices, F faces, and its atlas.

    ``positions`` (V, 3); ``faces`` (F, 3) into them; ``frame_vertex`` (R,): the vertex of each
    render vertex; ``frame_faces`` (F, 3) into the render vertices; ``uvs`` (R, 2). Render vertices
    are split at UV seams and where the handedness of the mapping changes.

    ``normals`` (V, 3), ``tangents`` (R, 4), given together: frames of a mesh that keeps its shape
    and its own normals. Its vertices are then split at hard edges, too, and only texels can be
    fitted.

    ``single`` (F,): faces that are seen from their front only; None: all are seen from both sides.
    ``owner`` (F,): number of the node of the asset to which each face belongs, -1 for none; None
    where there are no nodes.

    ``normal_vertex`` (G,), ``normal_faces`` (F, 3), given together: of G vertex normals, the vertex
    of each, and those of the corners of each face; the first V are at the vertices of their number.
    Corners of one vertex that have different normals meet at a crease, and have render vertices of
    their own. None: each vertex has one normal, and its number.

    ``normal_local`` (G, 3), ``normal_edge`` (G,), given together: vertex normals that are not those
    of the faces around, as unit vectors in a basis that moves and turns with the mesh (see
    ``mesh_ops.vertex_normals``), and the vertex at the other end of the edge that it is aligned
    with.
    """

    positions: NDArray[np.float32]
    faces: NDArray[np.int32]
    frame_vertex: NDArray[np.int32]
    frame_faces: NDArray[np.int32]
    uvs: NDArray[np.float32]
    normals: NDArray[np.float32] | None = None
    tangents: NDArray[np.float32] | None = None
    single: NDArray[np.bool_] | None = None
    owner: NDArray[np.int32] | None = None
    normal_vertex: NDArray[np.int32] | None = None
    normal_faces: NDArray[np.int32] | None = None
    normal_local: NDArray[np.float32] | None = None
    normal_edge: NDArray[np.int32] | None = None

    @property
    def shading_faces(self) -> NDArray[np.int32]:
        """(F, 3) the normals of the corners of each face."""
        return self.faces if self.normal_faces is None else self.normal_faces

    @property
    def shading_vertex(self) -> NDArray[np.int32]:
        """(G,) the vertex of each normal."""
        if self.normal_vertex is None:
            return np.arange(len(self.positions), dtype=np.int32)
        return self.normal_vertex

    @property
    def frame_normal(self) -> NDArray[np.int32]:
        """(R,) the normal of each render vertex."""
        if self.normal_faces is None:
            return self.frame_vertex
        out = self.frame_vertex.copy()
        out[self.frame_faces.ravel()] = self.normal_faces.ravel()
        return out


class LatentTopology:
    """Everything about a latent that never changes during a fit, precomputed once. ``culled`` (F,):
    faces that are not to be seen from behind (see ``asset.sides``), None without any."""

    def __init__(self, mesh: LatentMesh, tangents: bool) -> None:
        self.mesh = mesh
        self.tangents = tangents
        self.corners = corners_of(mesh)
        self.faces = upload.index_packets(mesh.shading_faces)
        self.frame_faces = upload.index_packets(mesh.frame_faces)
        # silhouettes run along welded edges: a seam is none
        self.welded_faces = (
            mesh.faces if mesh.normals is None else weld_faces(mesh.positions, mesh.faces)
        )
        self.culled = culled(mesh.positions, mesh.faces, mesh.single)
        self._culled = None if self.culled is None else mi.Bool(self.culled)
        self.edges = edge_list(self.welded_faces, self.culled, mesh.normal_faces)
        self.handedness = mi.Float(handedness(mesh))
        self._fixed = self._fixed_surface() if mesh.normals is not None else None

    @cached_property
    def walkable(self) -> EdgeList:
        """The edges with what lies around each face; made when first asked for."""
        return walkable(self.edges, self.welded_faces)

    def surface(self, positions: mi.Float) -> Surface:
        """Surface of flat positions (3 V); differentiable in them. A mesh with its own normals
        ignores ``positions``: it does not move."""
        if self._fixed is not None:
            return self._fixed
        normals = mesh_ops.vertex_normals(positions, self.corners)
        vertices = mesh_ops.packed_vertices(positions, normals, self.corners.normal_vertex)
        uv = dr.unravel(mi.Point2f, self.corners.uvs)
        if self.tangents:
            t = mesh_ops.vertex_tangents(positions, normals, self.corners)
            frames = mesh_ops.interleave(
                uv.x, uv.y, self.handedness, mi.Float(0), t.x, t.y, t.z, mi.Float(0)
            )
        else:
            frames = self.corners.uvs
        dr.eval(vertices, frames)
        return Surface(
            self.faces, vertices, self.frame_faces, frames, None, self.tangents, self._culled
        )

    def scene(self) -> Scene:
        """The mesh where it was at first, for tracing rays."""
        return upload.scene_of(self.mesh.positions, self.mesh.faces, self.culled)

    def drawn(self, maps: MaterialMaps) -> Drawn:
        """The mesh where it was at first, ready to be drawn with ``maps``."""
        positions = mi.Float(np.ascontiguousarray(self.mesh.positions, np.float32).ravel())
        return Drawn(self.scene(), self.surface(positions), maps)

    def _fixed_surface(self) -> Surface:
        m = self.mesh
        assert m.normals is not None and m.tangents is not None
        tangents = m.tangents if self.tangents else None
        mesh = MeshArrays(
            m.positions, m.normals, m.faces, m.uvs, tangents, m.frame_faces, culled=self.culled
        )
        return upload.surface_of(mesh)


def without_creases(mesh: LatentMesh) -> LatentMesh:
    """The mesh with one normal per vertex, the mean of the faces around."""
    return replace(mesh, normal_vertex=None, normal_faces=None, normal_local=None, normal_edge=None)


def weld_faces(positions: NDArray, faces: NDArray) -> NDArray[np.intp]:
    """(F, 3) the same faces through one representative vertex per place."""
    first, place = weld(positions)
    return first[place[faces]]


def corners_of(mesh: LatentMesh) -> Corners:
    """Connectivity of a mesh on the device."""
    vertex = _columns(mesh.faces)
    creased = mesh.normal_faces is not None
    local, edge = mesh.normal_local, mesh.normal_edge
    return Corners(
        vertex=vertex,
        normal=_columns(mesh.shading_faces) if creased else vertex,
        frame=_columns(mesh.frame_faces),
        normal_vertex=_indices(mesh.shading_vertex) if creased else None,
        frame_normal=_indices(mesh.frame_normal),
        uvs=mi.Float(np.ascontiguousarray(mesh.uvs, np.float32).ravel()),
        edge=None if edge is None else _indices(edge),
        local=None if local is None else mi.Vector3f(np.ascontiguousarray(local.T)),
    )


def _columns(faces: NDArray) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
    return _indices(faces[:, 0]), _indices(faces[:, 1]), _indices(faces[:, 2])


def _indices(values: NDArray) -> mi.UInt32:
    return mi.UInt32(np.ascontiguousarray(values, np.uint32))


def handedness(mesh: LatentMesh) -> NDArray[np.float32]:
    """(R,) sign of the bitangent of each render vertex: +1 where v, which grows downward, makes the
    mapping mirror-free (glTF's convention), -1 where the UVs are mirrored."""
    uv = mesh.uvs[mesh.frame_faces]
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    sign = np.where(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0, -1.0, 1.0)
    out = np.ones(len(mesh.uvs), np.float32)
    out[mesh.frame_faces.ravel()] = np.repeat(sign, 3)
    return out


def edges_around(points: NDArray, faces: NDArray) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Total length and number (V,) of the edges at each of the points (V, D), of all faces (F, 3)
    around it: an edge counts once for each of its faces."""
    length, count = np.zeros(len(points)), np.zeros(len(points), np.int64)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        i, j = faces[:, a], faces[:, b]
        edge = np.linalg.norm(points[i].astype(np.float64) - points[j], axis=1)
        for k in (i, j):
            length += np.bincount(k, edge, len(points))
            count += np.bincount(k, minlength=len(points))
    return length, count


def local_edge_length(positions: NDArray, faces: NDArray) -> NDArray[np.float32]:
    """(V,) mean length of the edges at each vertex, of all faces around it, positive; the mesh's
    mean for vertices without one."""
    length, count = edges_around(positions, faces)
    used = count > 0
    mean = length[used].sum() / max(int(count[used].sum()), 1)
    # divisors elsewhere: corners that all lie at one place still get a length
    floor = max(1e-6 * mean, 1e-12)
    return np.maximum(np.where(used, length / np.maximum(count, 1), mean), floor).astype(np.float32)
