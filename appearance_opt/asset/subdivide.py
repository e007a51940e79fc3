"""Subdivision surfaces: Catmull-Clark refinement (Catmull and Clark 1978), vectorised.

Boundaries follow their own cubic curve; corners of the boundary (one face) stay. Creases and
corners may be semi-sharp (DeRose, Kass and Truong 1998): each level takes 1 off their sharpness,
below 1 rules are blended. Vertices lie on the refined mesh, not on the limit surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.normals import accumulate
from appearance_opt.asset.polygons import Polygons


@dataclass(frozen=True)
class Sharpness:
    """For how many levels edges and vertices stay sharp: ``edge`` (E,) of the ``edges`` (E, 2),
    ``corner`` (V,)."""

    edges: NDArray[np.int64]
    edge: NDArray[np.float64]
    corner: NDArray[np.float64]

    @classmethod
    def none(cls, vertices: int) -> Sharpness:
        """Nothing is sharp."""
        return cls(np.empty((0, 2), np.int64), np.empty(0), np.zeros(vertices))

    def of(self, keys: NDArray[np.int64], vertices: int) -> NDArray[np.float64]:
        """Sharpness of edges, whose ``keys`` (lower vertex times ``vertices`` plus higher one) are
        in order."""
        out = np.zeros(len(keys))
        own = self.edges.min(axis=1, initial=vertices) * vertices + self.edges.max(
            axis=1, initial=0
        )
        at = np.searchsorted(keys, own)
        there = (at < len(keys)) & (keys[np.minimum(at, len(keys) - 1)] == own)
        np.maximum.at(out, at[there], self.edge[there])
        return out


def catmull_clark(
    values: NDArray, polygons: Polygons, pinned_boundary: bool, sharpness: Sharpness | None = None
) -> tuple[NDArray, Polygons, Sharpness]:
    """One level: values (V, k) of vertices, the quads of the refined mesh, and what is still sharp
    of it. ``pinned_boundary`` keeps boundary vertices where they are (texture coordinates: seams
    stay put)."""
    n, faces = len(values), len(polygons.counts)
    sharpness = Sharpness.none(n) if sharpness is None else sharpness
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
    inner, creased = uses == 2, sharpness.of(keys, n)
    share = np.where(inner, np.minimum(creased, 1), 1)[:, None]
    edge_point = (1 - share) * (2 * middle + around) / 4 + share * middle
    rim = _Rim(ends, middle, ~inner, share[:, 0])
    moved = _vertex_points(values, corner, centre[face_of], rim, sharpness.corner, pinned_boundary)

    previous = np.empty(len(corner), np.int64)
    previous[polygons.next()] = edge_of
    quads = np.stack([corner, n + edge_of, n + len(keys) + face_of, n + previous], axis=1)
    refined = Polygons(np.full(len(quads), 4), quads.ravel())
    return (
        np.concatenate([moved, edge_point, centre]),
        refined,
        _next_sharpness(sharpness.corner, ends, creased, faces),
    )


@dataclass(frozen=True)
class _Rim:
    """Edges: their ends (E, 2) and middles, which lie on the ``boundary``, and how sharp each is, 0
    to 1."""

    ends: NDArray
    middle: NDArray
    boundary: NDArray
    share: NDArray


def _vertex_points(
    values: NDArray,
    corner: NDArray,
    centre: NDArray,
    rim: _Rim,
    corner_sharpness: NDArray,
    pinned_boundary: bool,
) -> NDArray:
    """Where the vertices go. ``centre``: of the face of each ``corner``."""
    n, ends = len(values), rim.ends
    faces_around = np.bincount(corner, minlength=n)[:, None]
    mean_face, mean_edge, along = (np.zeros_like(values, dtype=np.float64) for _ in range(3))
    accumulate(mean_face, corner, centre)
    valence = np.bincount(ends.ravel(), minlength=n)[:, None]
    sharp = rim.share > 0
    for k in (0, 1):
        accumulate(mean_edge, ends[:, k], rim.middle)
        accumulate(along, ends[sharp, k], rim.middle[sharp])
    on_rim = np.bincount(ends[rim.boundary].ravel(), minlength=n)[:, None] > 0
    creases = np.bincount(ends[sharp].ravel(), minlength=n)[:, None]
    shares = np.bincount(ends.ravel(), np.repeat(rim.share, 2), minlength=n)[:, None] / np.maximum(
        creases, 1
    )
    f, e = np.maximum(faces_around, 1), np.maximum(valence, 1)
    smooth = (mean_face / f + 2 * mean_edge / e + (valence - 3) * values) / e
    curve = np.where((creases == 2) & (faces_around > 1), (along / 2 + values) / 2, values)
    # the end of a single crease is smooth
    weight = np.where(on_rim, 1.0, np.where(creases >= 2, shares, 0.0))
    out = (1 - weight) * smooth + weight * np.where(on_rim & pinned_boundary, values, curve)
    pinned = np.minimum(corner_sharpness, 1)[:, None]
    out = (1 - pinned) * out + pinned * values
    return np.where(faces_around > 0, out, values)


def _next_sharpness(corner: NDArray, ends: NDArray, creased: NDArray, faces: int) -> Sharpness:
    """What is left for the refined mesh: both halves of a crease, and the old vertices."""
    n, left = len(corner), np.flatnonzero(creased > 1)
    halves = np.concatenate([np.stack([ends[left, k], n + left], axis=1) for k in (0, 1)])
    edge = np.tile(creased[left] - 1, 2)
    new = np.zeros(len(ends) + faces)
    return Sharpness(halves, edge, np.concatenate([np.maximum(corner - 1, 0), new]))
