"""Which faces are seen from one side only, and of which of them anybody could see the back."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from appearance_opt.asset.batch import Batch
from appearance_opt.asset.normals import weld
from appearance_opt.asset.types import Displacement, Texture

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Material, Mesh

THIN = 1e-3
"""Volume over area^1.5 of a closed part, below which it is as good as two sheets back to back: a
square plate a 350th as thick as it is wide. A ball has 0.094."""


def single_sided(meshes: tuple[Mesh, ...]) -> NDArray[np.bool_]:
    """(F,) faces of all meshes, one mesh after the other, that are seen from their front only."""
    one_way = np.array([not m.material.double_sided for m in meshes], bool)
    return np.repeat(one_way, np.array([len(m.faces) for m in meshes], np.int64))


def counted(meshes: tuple[Mesh, ...]) -> tuple[int, int]:
    """(single-sided faces, those among them whose backs may come into sight: see ``culled``)."""
    single, batch = single_sided(meshes), Batch(meshes)
    in_sight = culled(batch.joined("positions"), batch.faces, single)
    return int(single.sum()), 0 if in_sight is None else int(in_sight.sum())


def apart_from_sides(material: Material) -> tuple:
    """Equal for materials with equal values and the same textures, whatever the sides: formats
    whose materials do not know of sides need one for them all."""
    values = (getattr(material, f.name) for f in fields(material) if f.name != "double_sided")
    return tuple(id(v) if isinstance(v, Texture | Displacement) else v for v in values)


def culled(
    positions: NDArray,
    faces: NDArray,
    single: NDArray[np.bool_] | None,
    passing: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_] | None:
    """(F,) faces that are not to be seen from behind although someone outside might look at their
    backs; None if there are none, so that nothing has to be done about it.

    ``single``: see ``single_sided``; None for none. Of a closed part whose faces look outward
    nobody sees a back: every edge has two faces that run along it in opposite directions, and its
    volume is positive (more than ``THIN``). Where such a part passes through itself backs can show;
    they are drawn. ``passing`` (F,): faces that light passes, through which backs are seen, and
    which close no part; None for none.
    """
    if single is None or not single.any():
        return None
    first, place = weld(np.asarray(positions))
    f = place[np.asarray(faces)].astype(np.int64)
    part = connected_parts(f, len(first))
    blocking = np.ones(len(f), bool) if passing is None else ~passing
    solid = _solid(
        np.asarray(positions, np.float64)[first], f[blocking], part[blocking], int(part.max()) + 1
    )
    out = single & ~(solid[part] & blocking)
    return out if out.any() else None


def connected_parts(faces: NDArray, vertices: int) -> NDArray[np.int32]:
    """(F,) the connected part that each face of a welded mesh of so many vertices belongs to."""
    ends = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(ends[0]), np.int8), ends), (vertices, vertices))
    return connected_components(graph, directed=False)[1][faces[:, 0]]


def _solid(positions: NDArray, faces: NDArray, part: NDArray, count: int) -> NDArray[np.bool_]:
    """By part, of ``count``: is it closed, do its faces look outward, and is there room inside?
    Faces whose corners coincide are passed over."""
    proper = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    faces, part = faces[proper], part[proper]
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, edge = np.unique(low * len(positions) + high, return_inverse=True)
    uses = np.bincount(edge)
    forward = np.bincount(edge, start < end)
    torn = ((uses != 2) | (forward != 1))[edge]
    closed = np.bincount(np.repeat(part, 3)[torn], minlength=count) == 0
    a, b, c = (positions[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.bincount(part, 0.5 * np.linalg.norm(normal, axis=1), count)
    volume = np.bincount(part, np.sum((a - positions.mean(axis=0)) * normal, axis=1) / 6, count)
    return closed & (volume > THIN * area**1.5)
