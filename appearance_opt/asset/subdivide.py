"""Subdivision surfaces: Catmull-Clark refinement (Catmull and Clark 1978), vectorised.

Boundaries follow their own cubic curve; corners of the boundary (one face) stay. Crease and corner
sharpness of the file is not evaluated. Vertices lie on the refined mesh, not on the limit surface.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.normals import accumulate
from appearance_opt.asset.polygons import Polygons


def catmull_clark(values: NDArray, polygons: Polygons, pinned_boundary: bool) -> tuple[NDArray, Polygons]:
    """One level: values (V, k) of vertices and the quads of the refined mesh. ``pinned_boundary`` keeps
    boundary vertices where they are (texture coordinates: seams stay put)."""
    n, faces = len(values), len(polygons.counts)
    face_of = np.repeat(np.arange(faces), polygons.counts)
    corner, after = polygons.indices, polygons.indices[polygons.next()]
    low, high = np.minimum(corner, after), np.maximum(corner, after)
    keys, edge_of, uses = np.unique(low * n + high, return_inverse=True, return_counts=True)
    ends = np.stack([keys // n, keys % n], axis=1)

    centre = np.zeros((faces, values.shape[1]))
    accumulate(centre, face_of, values[corner])
    centre /= polygons.counts[:, None]
    middle = (values[ends[:, 0]] + values[ends[:, 1]]) / 2
    around = np.zeros_like(middle)
    accumulate(around, edge_of, centre[face_of])
    inner = uses == 2
    edge_point = np.where(inner[:, None], (2 * middle + around) / 4, middle)
    moved = _vertex_points(values, corner, face_of, centre, ends, middle, inner, pinned_boundary)

    previous = np.empty(len(corner), np.int64)
    previous[polygons.next()] = edge_of
    quads = np.stack([corner, n + edge_of, n + len(keys) + face_of, n + previous], axis=1)
    refined = Polygons(np.full(len(quads), 4), quads.ravel())
    return np.concatenate([moved, edge_point, centre]), refined


def _vertex_points(
    values: NDArray,
    corner: NDArray,
    face_of: NDArray,
    centre: NDArray,
    ends: NDArray,
    middle: NDArray,
    inner: NDArray,
    pinned_boundary: bool,
) -> NDArray:
    n = len(values)
    faces_around = np.bincount(corner, minlength=n)[:, None]
    mean_face, mean_edge, rim = (np.zeros_like(values, dtype=np.float64) for _ in range(3))
    accumulate(mean_face, corner, centre[face_of])
    valence = np.bincount(ends.ravel(), minlength=n)[:, None]
    for k in (0, 1):
        accumulate(mean_edge, ends[:, k], middle)
        accumulate(rim, ends[~inner, k], middle[~inner])
    on_rim = np.bincount(ends[~inner].ravel(), minlength=n)[:, None]
    f, e = np.maximum(faces_around, 1), np.maximum(valence, 1)
    smooth = (mean_face / f + 2 * mean_edge / e + (valence - 3) * values) / e
    curve = np.where((on_rim == 2) & (faces_around > 1), (rim / 2 + values) / 2, values)
    out = np.where(on_rim > 0, values if pinned_boundary else curve, smooth)
    return np.where(faces_around > 0, out, values)
