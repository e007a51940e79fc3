"""Polygons of any size, and the triangles that they are drawn as."""

from __future__ import annotations

from dataclasses import dataclass

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.normals import accumulate

MOST_CORNERS = 1 << 14
"""Corners of a face that is not convex: the time to cut ears off one that crosses itself grows with
their square."""

SIMPLE = 64
"""A face of more corners that is at fewer than half as many places is no polygon, and drawn as a
fan: ears would take a time that grows with the cube of the corners."""


@dataclass(frozen=True)
class Polygons:
    """Polygons of any size: ``counts`` (F,) corners of each face, ``indices`` (sum of counts,)."""

    counts: NDArray[np.int64]
    indices: NDArray[np.int64]

    def next(self) -> NDArray[np.int64]:
        """For each corner, the position in ``indices`` of the next corner of its face."""
        out = np.arange(1, len(self.indices) + 1)
        ends = np.cumsum(self.counts) - 1
        out[ends] = ends - self.counts + 1
        return out


def triangulate(polygons: Polygons, points: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(T, 3) positions in ``indices`` and (T,) the face of each triangle, in the order of the
    faces.

    Fans from the first corner; where a fan would leave its polygon, which is not convex then, ears
    are cut instead, in the plane of its mean normal. ``points`` (V, 3): what ``indices`` refer to.
    """
    start = np.cumsum(polygons.counts) - polygons.counts
    fans = np.maximum(polygons.counts - 2, 0)
    face = np.repeat(np.arange(len(fans)), fans)
    k = np.arange(len(face)) - np.repeat(np.cumsum(fans) - fans, fans)
    first = start[face]
    triangles = np.stack([first, first + k + 1, first + k + 2], axis=1)
    if polygons.counts.max(initial=0) <= 3:  # no fan of one triangle leaves it
        return triangles, face
    p = np.asarray(points, np.float64)[polygons.indices[triangles]]
    normals = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    total = np.zeros((len(fans), 3))
    accumulate(total, face, normals)
    leaves = np.zeros(len(fans), bool)
    leaves[face[np.sum(normals * total[face], axis=1) < 0]] = True
    if not leaves.any():
        return triangles, face
    cut = []
    for f in np.flatnonzero(leaves):
        corners = np.arange(start[f], start[f] + polygons.counts[f])
        places = np.asarray(points, np.float64)[polygons.indices[corners]]
        if len(corners) > MOST_CORNERS:
            raise ValueError(
                f"a face has {len(corners)} corners, at most {MOST_CORNERS} are supported: triangulate it"
            )
        if len(corners) > SIMPLE and len(np.unique(places, axis=0)) < len(corners) / 2:
            leaves[f] = False
            continue
        cut.append(corners[_ears(places, total[f])])
    if not cut:
        return triangles, face
    kept = ~leaves[face]
    triangles = np.concatenate([triangles[kept], *cut])
    face = np.concatenate([face[kept], np.repeat(np.flatnonzero(leaves), [len(c) for c in cut])])
    order = np.argsort(face, kind="stable")
    return triangles[order], face[order]


def _ears(corners: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.int64]:
    """(n, 3) triangles of a polygon with the given ``corners`` (N, 3) and mean normal, wound as it
    is."""
    axis = int(np.argmax(np.abs(normal)))
    # two axes in the order in which the polygon runs counterclockwise, as ears do
    axes = [(axis + 1) % 3, (axis + 2) % 3][:: 1 if normal[axis] > 0 else -1]
    flat = np.ascontiguousarray(corners[:, axes])
    return (
        mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32))
        .astype(np.int64)
        .reshape(-1, 3)
    )
