"""Mean curvature of a triangle mesh at its vertices."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.normals import unit, weld

if TYPE_CHECKING:
    from numpy.typing import NDArray


def mean_curvature(positions: NDArray, faces: NDArray) -> NDArray[np.float32]:
    """(V,) mean curvature (k1 + k2) / 2 in 1 / unit of length, positive where the surface is
    convex.

    Steiner's formula, as in Cohen-Steiner and Morvan 2003: an edge carries half its length times
    the angle between its faces; a vertex has half of what its edges carry, over the area around it
    that is nearer to it than to its neighbours (Meyer et al. 2003). Vertices at one place count as
    one. Open and non-manifold edges carry nothing.
    """
    first, place = weld(np.asarray(positions))
    p = np.asarray(positions, np.float64)[first]
    f = place[np.asarray(faces)].astype(np.int64)
    cross = np.cross(p[f[:, 1]] - p[f[:, 0]], p[f[:, 2]] - p[f[:, 0]])
    normal = unit(cross)
    n = len(p)
    area = np.bincount(f.ravel(), _corner_areas(p[f]).ravel(), n)
    start, end = f.T.ravel(), f[:, [1, 2, 0]].T.ravel()
    face = np.tile(np.arange(len(f)), 3)
    key = (np.minimum(start, end) << 32) | np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    _, begin, uses = np.unique(key[order], return_index=True, return_counts=True)
    one, two = order[begin[uses == 2]], order[begin[uses == 2] + 1]
    a, b = start[one], end[one]
    edge = p[b] - p[a]
    length = np.linalg.norm(edge, axis=1)
    n1, n2 = normal[face[one]], normal[face[two]]
    sine = np.sum(np.cross(n1, n2) * edge, axis=1) / np.maximum(length, 1e-300)
    angle = np.arctan2(sine, np.sum(n1 * n2, axis=1))
    angle[start[two] == a] = 0.0  # faces that wind against each other have no common outside
    carried = length * angle / 4
    total = np.bincount(a, carried, n) + np.bincount(b, carried, n)
    return (total / np.maximum(area, 1e-300))[place].astype(np.float32)


def _corner_areas(corners: NDArray) -> NDArray[np.float64]:
    """(F, 3) share of each corner in the area of its triangle (F, 3, 3): its Voronoi region, or in
    obtuse triangles half of the area for the obtuse corner and a quarter for the others."""
    sides = np.stack(
        [
            np.sum((corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3]) ** 2, axis=1)
            for k in range(3)
        ],
        1,
    )
    double = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    # cotangent of the angle at each corner: dot product of its two edges over the doubled area
    dot = (sides.sum(axis=1, keepdims=True) - 2 * sides) / 2
    weighted = sides * dot / np.maximum(double, 1e-300)[:, None]
    voronoi = (weighted.sum(axis=1, keepdims=True) - weighted) / 8
    blunt = dot < 0
    share = np.where(blunt, 0.5, 0.25) * (double / 2)[:, None]
    return np.where(blunt.any(axis=1, keepdims=True), share, voronoi)
