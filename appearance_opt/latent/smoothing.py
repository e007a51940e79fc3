"""Preconditioned steps of vertex positions, for starts that are far from their goal.

A step along the gradient moves every vertex for itself; far from the goal the mesh crumples, and
stays so. Nicolet, Jacobson and Jakob (2021, "Large Steps in Inverse Rendering of Geometry") step in
u = (I + lambda L) x instead, L the combinatorial Laplacian: neighbours move together, and the mesh
stays smooth without a regularizer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, identity
from scipy.sparse.linalg import splu

from appearance_opt.latent.laplacian import edges_of

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Smoother:
    """x -> (I + ``strength`` L)^-1 x for flat positions (3 V) of a mesh with ``vertices`` vertices
    and ``faces`` (F, 3). ``strength`` is the number of rings squared over which a motion spreads.
    Factorised once; solved on the host (docs/trials.md: spheres)."""

    def __init__(self, vertices: int, faces: NDArray, strength: float) -> None:
        pairs = edges_of(faces)
        i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
        adjacency = coo_matrix((np.ones(len(i)), (i, j)), (vertices, vertices)).tocsc()
        degree = np.asarray(adjacency.sum(axis=1)).ravel()
        laplacian = (
            csc_matrix((degree, (np.arange(vertices),) * 2), (vertices, vertices)) - adjacency
        )
        self._factor = splu((identity(vertices, format="csc") + strength * laplacian).tocsc())

    def __call__(self, flat: mi.Float) -> mi.Float:
        """The smoothed field. The matrix is symmetric: this is also its own adjoint."""
        field = np.array(flat, dtype=np.float64).reshape(-1, 3)
        return mi.Float(np.ascontiguousarray(self._factor.solve(field).ravel(), np.float32))
