"""From host arrays to the device: surfaces and the scenes that rays are traced in."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from appearance_opt import backend

if TYPE_CHECKING:
    from numpy.typing import NDArray


def scene_of(positions: NDArray, faces: NDArray) -> mi.Scene:
    """Mitsuba scene (Embree or OptiX) of one triangle mesh. Its parameters ``mesh.vertex_positions``
    can be updated."""
    return mi.load_dict({"type": "scene", "mesh": _mesh_of(positions, faces)})


class MovingScene:
    """The ``scene`` of one triangle mesh that moves.

    On the CPU it is an instance of the mesh: Mitsuba asks Embree for the best BVH of a scene's own shapes, which splits
    triangles and takes two to four times as long as the plain one that it asks for what is instanced. Rays take longer,
    by up to two thirds.
    """

    def __init__(self, positions: NDArray, faces: NDArray) -> None:
        if mi.variant() == backend.CPU:
            group = {"type": "shapegroup", "id": "group", "mesh": _mesh_of(positions, faces)}
            instance = {"type": "instance", "shapes": {"type": "ref", "id": "group"}}
            self.scene = mi.load_dict({"type": "scene", "group": group, "instance": instance})
            self._name = "group.mesh.vertex_positions"
        else:
            self.scene, self._name = scene_of(positions, faces), "mesh.vertex_positions"
        self._parameters = mi.traverse(self.scene)

    def move(self, positions: mi.Float) -> None:
        """Rebuild the BVH at flat positions (3 V)."""
        self._parameters[self._name] = positions
        self._parameters.update()


def _mesh_of(positions: NDArray, faces: NDArray) -> mi.Mesh:
    mesh = mi.Mesh("mesh", len(positions), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(positions, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel())
    parameters.update()
    return mesh


def index_packets(triples: NDArray, fourth: NDArray | int = 0) -> mi.UInt32:
    """(F, 3) indices and a fourth number as packets of four."""
    out = np.empty((len(triples), 4), np.uint32)
    out[:, :3] = triples
    out[:, 3] = fourth
    return mi.UInt32(out.ravel())


def packets(channels: int, *columns: NDArray) -> mi.Float:
    """Columns (N, k) side by side, padded with zeros to ``channels`` floats per row."""
    rows = np.zeros((len(columns[0]), channels), np.float32)
    start = 0
    for column in columns:
        column = column[:, None] if column.ndim == 1 else column
        rows[:, start : start + column.shape[1]] = column
        start += column.shape[1]
    return mi.Float(rows.ravel())
