"""Meshes from their own coordinates to the places where a file puts them, all copies at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.types import Mesh


@dataclass(frozen=True)
class Instances:
    """Affine maps from a mesh to the world: ``matrix`` is (P, 4, 4), the places of P copies, or, if
    it is ``skinned``, (V, 4, 4) with one for each vertex of a single copy. The copies lie one after
    the other in what is returned."""

    matrix: NDArray[np.float64]
    skinned: bool = False

    def points(self, p: NDArray) -> NDArray[np.float64]:
        """(P V, 3) positions (V, 3) in the world."""
        return self._mapped(self.matrix[:, :3, :3], p, self.matrix[:, :3, 3])

    def directions(self, v: NDArray) -> NDArray[np.float64]:
        """(P V, 3) tangents (V, 3) in the world, of any length."""
        return self._mapped(self.matrix[:, :3, :3], v)

    def normals(self, n: NDArray) -> NDArray[np.float64]:
        """(P V, 3) normals (V, 3) in the world, of any length."""
        cofactors = _cofactors(self.matrix)
        return self._mapped(np.where(self._mirrors[:, None, None], -cofactors, cofactors), n)

    def repeated(self, values: NDArray | None) -> NDArray | None:
        """(P V, width) what all copies have alike."""
        return (
            values
            if values is None or self.skinned or len(self.matrix) == 1
            else np.tile(values, (self.copies, 1))
        )

    def volumes(self) -> NDArray[np.float64]:
        """How many times as large as in its own coordinates anything is at each place."""
        return np.abs(np.linalg.det(self.matrix[:, :3, :3]))

    def mirrored(self, vertices: int) -> NDArray[np.bool_]:
        """(P V,) is the mapping of a vertex a reflection?"""
        return self._mirrors if self.skinned else np.repeat(self._mirrors, vertices)

    def faces(self, faces: NDArray, vertices: int) -> NDArray[np.int32]:
        """(P F, 3) faces (F, 3), wound the other way where they are mirrored."""
        if self.skinned:
            turned = self._mirrors[faces[:, 0]][:, None]
            return np.where(turned, faces[:, ::-1], faces).astype(np.int32)
        out = (
            np.repeat(faces[None], self.copies, axis=0)
            + (np.arange(self.copies) * vertices)[:, None, None]
        )
        if self._mirrors.any():
            out[self._mirrors] = out[self._mirrors][..., ::-1]
        return out.reshape(-1, 3).astype(np.int32)

    @property
    def copies(self) -> int:
        """P: how often a mesh is placed."""
        return 1 if self.skinned else len(self.matrix)

    @cached_property
    def _mirrors(self) -> NDArray[np.bool_]:
        return np.linalg.det(self.matrix[:, :3, :3]) < 0

    def _mapped(
        self, linear: NDArray, v: NDArray, offset: NDArray | None = None
    ) -> NDArray[np.float64]:
        if self.skinned:
            out = np.einsum("vij,vj->vi", linear, v)
            return out if offset is None else out + offset
        out = np.matmul(v, linear.transpose(0, 2, 1))
        return (out if offset is None else out + offset[:, None]).reshape(-1, 3)


_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])


def _cofactors(m: NDArray) -> NDArray[np.float64]:
    """(N, 3, 3) of the linear parts: they transform normals, of singular matrices too (inverse
    transpose times determinant)."""
    i, j, k, n = _NEXT[:, None], _NEXT, _AFTER[:, None], _AFTER
    return m[:, i, j] * m[:, k, n] - m[:, i, n] * m[:, k, j]


def place_copies(mesh: Mesh, place: Instances, name: str) -> Mesh:
    """A mesh at all its places in the world, positions still in double precision."""
    vertices = len(mesh.positions)
    normals, tangents = mesh.normals, mesh.tangents
    if normals is not None:
        normals = _normalize(place.normals(normals))
    if tangents is not None:
        # a reflection turns cross(normal, tangent) over, but not the bitangent
        negative = place.repeated(tangents[:, 3:4] < 0)
        w = np.where(negative != place.mirrored(vertices)[:, None], -1, 1)
        tangents = np.concatenate([_normalize(place.directions(tangents[:, :3])), w], axis=1)
    return Mesh(
        positions=place.points(mesh.positions),  # type: ignore[arg-type]
        faces=place.faces(mesh.faces, vertices),
        normals=None if normals is None else normals.astype(np.float32),
        uvs=place.repeated(mesh.uvs),
        tangents=None if tangents is None else tangents.astype(np.float32),
        colors=place.repeated(mesh.colors),
        material=mesh.material,
        name=name,
    )


def _normalize(v: NDArray) -> NDArray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-30)
