"""Meshes one after the other in common arrays: a step over many small ones costs what one over a
large one does."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.normals import split_where_cancelled, summed_normals

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Mesh

WIDTHS = {"positions": (3,), "normals": (3,), "uvs": (2,), "tangents": (4,), "colors": (3, 4)}
"""Attributes of vertices, and how many numbers each may have."""


@dataclass(frozen=True)
class Batch:
    """``meshes``, M of them, with V vertices and F faces in all; see the properties."""

    meshes: Sequence[Mesh]

    @cached_property
    def vertex_counts(self) -> NDArray[np.int64]:
        """(M,)"""
        return np.array([len(m.positions) for m in self.meshes], np.int64)

    @cached_property
    def face_counts(self) -> NDArray[np.int64]:
        """(M,)"""
        return np.array([len(m.faces) for m in self.meshes], np.int64)

    @cached_property
    def first_vertex(self) -> NDArray[np.int64]:
        """(M,) number of each mesh's first vertex among all."""
        return np.cumsum(self.vertex_counts) - self.vertex_counts

    @cached_property
    def mesh_of_vertex(self) -> NDArray[np.int64]:
        """(V,)"""
        return np.repeat(np.arange(len(self.meshes)), self.vertex_counts)

    @cached_property
    def mesh_of_face(self) -> NDArray[np.int64]:
        """(F,)"""
        return np.repeat(np.arange(len(self.meshes)), self.face_counts)

    @cached_property
    def own_faces(self) -> NDArray[np.integer]:
        """(F, 3) corners by their number in their own mesh."""
        return np.concatenate([m.faces for m in self.meshes] or [np.empty((0, 3), np.int32)])

    @cached_property
    def faces(self) -> NDArray[np.integer]:
        """(F, 3) corners by their number among all vertices, in 32 bits if these do."""
        kind: type[np.integer] = np.int64 if self.vertex_counts.sum() >= 2**31 else np.int32
        first: NDArray[np.integer] = self.first_vertex.astype(kind)
        return self.own_faces + first[self.mesh_of_face][:, None]

    def have(self, name: str) -> NDArray[np.bool_]:
        """(M,) which meshes have an attribute?"""
        return np.array([getattr(m, name) is not None for m in self.meshes], bool)

    def joined(self, name: str, default: float = 0.0) -> NDArray:
        """(V, width) an attribute of all meshes; ``default`` where one lacks it, or its last column
        (the alpha of colours)."""
        own = [getattr(m, name) for m in self.meshes]
        width = max((v.shape[1] for v in own if v is not None), default=WIDTHS[name][0])
        rows = []
        for values, n in zip(own, self.vertex_counts.tolist(), strict=True):
            if values is None or values.shape[1] < width:
                full = np.full((n, width), default, np.float32)
                if values is not None:
                    full[:, : values.shape[1]] = values
                values = full
            rows.append(values)
        return np.concatenate(rows or [np.empty((0, width), np.float32)])

    def reindexed(self, index: NDArray, faces: NDArray, **attributes: NDArray | None) -> list[Mesh]:
        """The meshes with new vertices and faces. ``index`` (N,): vertex that each new one comes
        from, in any order; ``faces`` (F, 3): the same faces by their corners among the new
        vertices; ``attributes``: (N, width) new values instead of the old, or None to drop one."""
        order = np.argsort(self.mesh_of_vertex[index], kind="stable")
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        old = index[order] - self.first_vertex[self.mesh_of_vertex[index[order]]]
        ends = np.cumsum(np.bincount(self.mesh_of_vertex[index], minlength=len(self.meshes)))
        new = {
            name: None if values is None else values[order] for name, values in attributes.items()
        }
        corners, face_ends = place[faces], np.cumsum(self.face_counts).tolist()
        out, start, first_face = [], 0, 0
        for mesh, end, last_face in zip(self.meshes, ends.tolist(), face_ends, strict=True):
            rows = old[start:end]
            changed: dict[str, Any] = {
                name: values[rows] for name in WIDTHS if (values := getattr(mesh, name)) is not None
            }
            changed |= {
                name: None if values is None else values[start:end] for name, values in new.items()
            }
            changed["skin"] = None if mesh.skin is None else mesh.skin.take(rows)
            changed["faces"] = (corners[first_face:last_face] - start).astype(np.int32)
            out.append(replace(mesh, **changed))
            start, first_face = end, last_face
        return out


def in_range(mesh: Mesh) -> bool:
    """Do all its corners exist? (If not, ``repair`` refuses it, and counts them.)"""
    faces = mesh.faces
    return not len(faces) or bool(faces.min() >= 0 and faces.max() < len(mesh.positions))


def fill_normals(meshes: Sequence[Mesh]) -> list[Mesh]:
    """The meshes, those without normals with angle-weighted ones (see ``summed_normals``)."""

    def filled(batch: Batch) -> list[Mesh]:
        positions, faces = batch.joined("positions"), batch.faces
        normals = summed_normals(positions, faces, mesh_of=batch.mesh_of_vertex)
        index, faces, normals = split_where_cancelled(positions, faces, normals)
        return batch.reindexed(index, faces, normals=normals, tangents=None)

    return replace_chosen(meshes, [m.normals is None for m in meshes], filled)


def replace_chosen(
    meshes: Sequence[Mesh], chosen: Sequence[bool], change: Callable[[Batch], list[Mesh]]
) -> list[Mesh]:
    """The meshes, those that are chosen as ``change`` makes them, all in one go."""
    out = list(meshes)
    numbers = [k for k, yes in enumerate(chosen) if yes]
    if numbers:
        for k, mesh in zip(numbers, change(Batch([meshes[k] for k in numbers])), strict=True):
            out[k] = mesh
    return out
