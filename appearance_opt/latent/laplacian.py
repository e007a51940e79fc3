"""Laplacian regularizer with uniform weights (Hasselgren et al. 2021, equation 5)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def edges_of(faces: NDArray) -> NDArray[np.int64]:
    """(E, 2) the edges of triangles (F, 3), each once, the lower index first."""
    corners = np.asarray(faces, np.int64)
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0)


class Laplacian:
    """L = mean over vertices of |delta_i - delta'_i|^2 / h_i^2.

    delta_i = v_i - mean of its one-ring; delta' that of the initial mesh (relative) or 0 (absolute,
    for a start that is no likeness: a sphere). Unlike in the paper, each vertex is measured in
    units of h_i, the length of the edges around it at the start, so that the weight means the same
    for every scale and in dense and coarse regions of one mesh.
    """

    def __init__(
        self, positions: NDArray, faces: NDArray, edge_length: NDArray, relative: bool
    ) -> None:
        pairs = edges_of(faces)
        degree = np.maximum(np.bincount(pairs.ravel(), minlength=len(positions)), 1)
        self._a = mi.UInt32(np.ascontiguousarray(pairs[:, 0], np.uint32))
        self._b = mi.UInt32(np.ascontiguousarray(pairs[:, 1], np.uint32))
        self._inverse_degree = mi.Float((1 / degree).astype(np.float32))
        self._scale = mi.Float((1 / edge_length).astype(np.float32))
        self._count = len(positions)
        self._start = (
            mi.Float(np.ascontiguousarray(positions, np.float32).ravel()) if relative else None
        )

    def __call__(self, positions: mi.Float) -> mi.Float:
        """The regularizer at flat positions (3 V); width 1, differentiable."""
        return dr.sum(self.per_vertex(positions))

    def per_vertex(self, positions: mi.Float) -> mi.Float:
        """Share of each vertex in the regularizer (V)."""
        offset = self._delta(positions) * self._scale
        return dr.squared_norm(offset) / self._count

    def _delta(self, positions: mi.Float) -> mi.Vector3f:
        """delta - delta', which is linear: of how far the vertices have moved. Where none around a
        vertex has, it is exactly 0; as a difference of two sums it would be rounding, of which Adam
        makes whole steps."""
        total = dr.zeros(mi.Float, 3 * self._count)
        dr.scatter_add(total, self._moved(positions, self._b), self._a)
        dr.scatter_add(total, self._moved(positions, self._a), self._b)
        own = self._moved(positions, dr.arange(mi.UInt32, self._count))
        return own - dr.unravel(mi.Vector3f, total) * self._inverse_degree

    def _moved(self, positions: mi.Float, index: mi.UInt32) -> mi.Vector3f:
        """Vertices relative to their start, if there is one."""
        now = dr.gather(mi.Vector3f, positions, index)
        return now if self._start is None else now - dr.gather(mi.Vector3f, self._start, index)
