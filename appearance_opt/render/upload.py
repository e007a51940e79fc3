"""From host arrays to the device: surfaces and the scenes that rays are traced in."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def scene_of(positions: NDArray, faces: NDArray) -> mi.Scene:
    """Mitsuba scene (Embree or OptiX) of one triangle mesh. Its parameters ``mesh.vertex_positions``
    can be updated."""
    mesh = mi.Mesh("mesh", len(positions), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(positions, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel())
    parameters.update()
    return mi.load_dict({"type": "scene", "mesh": mesh})


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
