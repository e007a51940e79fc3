"""Edge-midpoint subdivision of a latent mesh: topology once, on the host.

Every triangle becomes four. A new vertex is the mean of its two parents, so after any number of
levels each vertex is a fixed combination of at most three base vertices, with weights that are
multiples of 2^-level (exact in floating point). Positions and normals of all levels therefore
follow from the base mesh in one gather (see ``displacement``); nothing is refined level by level
during a fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from appearance_opt.latent.mesh import LatentMesh

MAX_LEVEL = 4
"""Deepest tessellation: 256 triangles for each one of the base mesh."""


@dataclass(frozen=True)
class Tessellation:
    """A latent mesh of F triangles after ``level`` subdivisions.

    ``mesh``: F 4^level triangles over N welded vertices; the base vertices come first. ``parents``
    (N, 3): base vertices that each vertex is made of; ``weights`` (N, 3): their shares, which sum
    to 1 (0 for parents that are not used).
    """

    level: int
    mesh: LatentMesh
    parents: NDArray[np.int32]
    weights: NDArray[np.float32]


def tessellate(mesh: LatentMesh, level: int) -> Tessellation:
    """Subdivide ``level`` times. Welded vertices and render vertices are split in step: a midpoint
    on a UV seam is one vertex with a render vertex in each chart, its texture coordinates the mean
    of the parents' in that chart."""
    if not 0 <= level <= MAX_LEVEL:
        raise ValueError(f"subdivision level {level} is not in 0..{MAX_LEVEL}")
    faces, frames = mesh.faces, mesh.frame_faces
    frame_vertex, uvs = mesh.frame_vertex, mesh.uvs
    combination = sp.identity(len(mesh.positions), np.float32, "csr")
    for _ in range(level):
        edges, edge_of = _edges(faces)
        seams, seam_of = _edges(frames)
        vertex_of = np.empty(len(seams), np.int32)
        vertex_of[seam_of.ravel()] = combination.shape[0] + edge_of.ravel()
        faces = _split(faces, combination.shape[0] + edge_of)
        frames = _split(frames, len(uvs) + seam_of)
        frame_vertex = np.concatenate([frame_vertex, vertex_of])
        uvs = np.concatenate([uvs, (uvs[seams[:, 0]] + uvs[seams[:, 1]]) * np.float32(0.5)])
        middle = (combination[edges[:, 0]] + combination[edges[:, 1]]) * np.float32(0.5)
        combination = sp.vstack([combination, middle], "csr")
    parents, weights = _rows(combination)
    positions = np.einsum("nk,nkc->nc", weights, mesh.positions[parents])
    single = None if mesh.single is None else np.repeat(mesh.single, 4**level)
    owner = None if mesh.owner is None else np.repeat(mesh.owner, 4**level)
    fine = LatentMesh(
        positions.astype(np.float32),
        faces,
        frame_vertex,
        frames,
        uvs,
        single=single,
        owner=owner,
    )
    return Tessellation(level, fine, parents, weights)


def _edges(faces: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """(edges (E, 2), index of the edge after each corner (F, 3))."""
    after = np.roll(faces, -1, axis=1).astype(np.int64)
    low, high = np.minimum(faces, after), np.maximum(faces, after)
    count = int(faces.max()) + 1
    keys, edge_of = np.unique(low * count + high, return_inverse=True)
    return np.stack([keys // count, keys % count], axis=1), edge_of.reshape(faces.shape).astype(
        np.int32
    )


def _split(faces: NDArray, middle: NDArray) -> NDArray[np.int32]:
    """The four children of each face, given the vertices (F, 3) in the middle of its edges::

              c
             / \\
           ca---bc
           / \\ / \\
          a---ab--b
    """
    a, b, c = faces.T
    ab, bc, ca = middle.T
    children = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return (
        np.stack([np.stack(child, axis=1) for child in children], axis=1)
        .reshape(-1, 3)
        .astype(np.int32)
    )


def _rows(matrix: sp.csr_matrix) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The at most three entries of each row: (columns (N, 3), values (N, 3))."""
    matrix.sort_indices()
    count = np.diff(matrix.indptr)
    slot = np.arange(len(matrix.indices)) - np.repeat(matrix.indptr[:-1], count)
    row = np.repeat(np.arange(len(count)), count)
    columns, values = np.zeros((len(count), 3), np.int32), np.zeros((len(count), 3), np.float32)
    columns[row, slot], values[row, slot] = matrix.indices, matrix.data
    return columns, values
