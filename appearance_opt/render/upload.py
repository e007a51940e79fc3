"""From host arrays to the device: surfaces and the scenes that rays are traced in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt import backend
from appearance_opt.render.passing import Half, SidedScene
from appearance_opt.render.surface import Surface

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.render.passing import Scene

ACROSS = (0.48, 0.65, 0.59)
"""Single-sided faces are told apart by the sign of the component of their normals along this
direction, which hardly any plane contains."""


@dataclass(frozen=True)
class MeshArrays:
    """A triangle mesh on the host, as it is uploaded.

    ``positions``, ``normals`` (V, 3); ``faces`` (F, 3) into them. ``uvs`` (R, 2), ``tangents``
    (R, 4) with the handedness last, and the indices ``corners`` (F, 3) into both, None where they
    equal ``faces``; ``colors`` (V, 4) linear, with alpha. ``material`` (F,): its index.
    ``culled`` (F,): faces that are not to be seen from behind (see ``asset.sides.culled``). What is
    None is not there.
    """

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    faces: NDArray[np.int32]
    uvs: NDArray[np.float32] | None = None
    tangents: NDArray[np.float32] | None = None
    corners: NDArray[np.int32] | None = None
    colors: NDArray[np.float32] | None = None
    material: NDArray[np.int32] | int = 0
    culled: NDArray[np.bool_] | None = None


def surface_of(mesh: MeshArrays) -> Surface:
    """Upload the mesh, ready to be shaded."""
    frames = None
    if mesh.uvs is not None and mesh.tangents is None:
        frames = packets(2, mesh.uvs)
    elif mesh.uvs is not None and mesh.tangents is not None:
        zeros = np.zeros(len(mesh.uvs))
        frames = packets(8, mesh.uvs, mesh.tangents[:, 3], zeros, mesh.tangents[:, :3])
    return Surface(
        faces=index_packets(mesh.faces, mesh.material),
        vertices=packets(8, mesh.positions, np.zeros(len(mesh.positions)), mesh.normals),
        corners=None if mesh.corners is None else index_packets(mesh.corners),
        frames=frames,
        colors=None if mesh.colors is None else packets(4, mesh.colors),
        has_tangents=mesh.tangents is not None,
        culled=None if mesh.culled is None else mi.Bool(mesh.culled),
    )


def scene_of(positions: NDArray, faces: NDArray, culled: NDArray | None = None) -> Scene:
    """Make what rays through one triangle mesh are traced in: a Mitsuba scene (Embree or OptiX),
    or, with faces that are ``culled`` (F,) when seen from behind, two of them."""
    if culled is None:
        return mi.load_dict({"type": "scene", "mesh": _mesh_of(positions, faces)})
    normals = _normals(positions, faces)
    halves = []
    for own in _halves(normals, culled):
        scene = mi.load_dict({"type": "scene", "mesh": _mesh_of(positions, faces[own])})
        facing = packets(4, np.where(culled[own, None], normals[own], 0))
        halves.append(Half(scene, mi.UInt32(own.astype(np.uint32)), facing))
    return SidedScene(halves)


def _halves(normals: NDArray, culled: NDArray) -> list[NDArray]:
    """Numbers of the faces of each half of a sided scene, none of which is empty."""
    second = culled & (normals @ np.array(ACROSS) < 0)
    return [own for own in (np.flatnonzero(~second), np.flatnonzero(second)) if len(own)]


def _normals(positions: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """(F, 3) normals of faces by their winding, twice their area long."""
    a, b, c = (np.asarray(positions, np.float64)[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


class MovingScene:
    """The ``scene`` of one triangle mesh that moves. ``culled``: as in ``scene_of``.

    On the CPU it is an instance of the mesh: Mitsuba asks Embree for the best BVH of a scene's own
    shapes, which splits triangles and takes longer to build than the plain one that it asks for
    what is instanced (docs/trials.md: kernels).
    """

    def __init__(self, positions: NDArray, faces: NDArray, culled: NDArray | None = None) -> None:
        self._parts: list[_MovingHalf] = []
        if culled is None:
            self.scene: Scene = _moving(positions, faces)
            self._meshes = [_parameters(self.scene)]
            return
        halves = []
        for own in _halves(_normals(positions, faces), culled):
            half = Half(
                _moving(positions, faces[own]), mi.UInt32(own.astype(np.uint32)), mi.Float()
            )
            self._parts.append(_MovingHalf(half, faces[own], culled[own]))
            halves.append(half)
        self.scene = SidedScene(halves)
        self._meshes = [_parameters(h.scene) for h in halves]
        self.move(mi.Float(np.ascontiguousarray(positions, np.float32).ravel()))

    def move(self, positions: mi.Float) -> None:
        """Rebuild the BVH at flat positions (3 V)."""
        for parameters, name in self._meshes:
            parameters[name] = positions
            parameters.update()
        for part in self._parts:
            part.turn(positions)


def _parameters(scene: mi.Scene) -> tuple[mi.SceneParameters, str]:
    """(what can be changed in a scene, the name of its mesh's positions)."""
    parameters = mi.traverse(scene)
    return parameters, next(k for k, _ in parameters if k.endswith("mesh.vertex_positions"))


class _MovingHalf:
    """Keeps the normals of a half of a sided scene up to date."""

    def __init__(self, half: Half, faces: NDArray, culled: NDArray) -> None:
        self.half = half
        self._corners = [mi.UInt32(np.ascontiguousarray(faces[:, k], np.uint32)) for k in range(3)]
        self._culled = mi.Float(culled.astype(np.float32))

    def turn(self, positions: mi.Float) -> None:
        """Take over flat positions (3 V) of all vertices."""
        a, b, c = (dr.gather(mi.Point3f, positions, k) for k in self._corners)
        n = dr.cross(b - a, c - a) * self._culled
        out = dr.empty(mi.Float, 4 * dr.width(self._culled))
        index = dr.arange(mi.UInt32, dr.width(self._culled))
        dr.scatter(out, mi.ArrayXf([n.x, n.y, n.z, mi.Float(0)]), index, mode=dr.ReduceMode.Permute)
        dr.eval(out)
        self.half.normals = out


def _moving(positions: NDArray, faces: NDArray) -> mi.Scene:
    """A scene whose mesh can be moved."""
    mesh = _mesh_of(positions, faces)
    if mi.variant() != backend.CPU:
        return mi.load_dict({"type": "scene", "mesh": mesh})
    group = {"type": "shapegroup", "id": "group", "mesh": mesh}
    instance = {"type": "instance", "shapes": {"type": "ref", "id": "group"}}
    return mi.load_dict({"type": "scene", "group": group, "instance": instance})


def _mesh_of(positions: NDArray, faces: NDArray) -> mi.Mesh:
    mesh = mi.Mesh("mesh", len(positions), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(positions, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel())
    parameters.update()
    return mesh


def index_packets(triples: NDArray, fourth: NDArray | int = 0) -> mi.UInt32:
    """Pack (F, 3) indices and a fourth number as packets of four."""
    out = np.empty((len(triples), 4), np.uint32)
    out[:, :3] = triples
    out[:, 3] = fourth
    return mi.UInt32(out.ravel())


def packets(channels: int, *columns: NDArray) -> mi.Float:
    """Pack columns (N, k) side by side, padded with zeros to ``channels`` floats per row."""
    rows = np.zeros((len(columns[0]), channels), np.float32)
    start = 0
    for column in columns:
        column = column[:, None] if column.ndim == 1 else column
        rows[:, start : start + column.shape[1]] = column
        start += column.shape[1]
    return mi.Float(rows.ravel())
