"""Where the nodes of a glTF file put their meshes: transforms, instances, and skins at their rest pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from appearance_opt.asset.gltf_accessors import Document

INSTANCING = "EXT_mesh_gpu_instancing"


@dataclass(frozen=True)
class Placement:
    """Affine maps from a mesh to the world: ``matrix`` is (P, 4, 4), the places of P copies, or, if it is ``skinned``,
    (V, 4, 4) with one for each vertex of a single copy. The copies lie one after the other in what is returned."""

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
        return values if values is None or self.skinned or len(self.matrix) == 1 else np.tile(values, (self._copies, 1))

    def mirrored(self, vertices: int) -> NDArray[np.bool_]:
        """(P V,) is the mapping of a vertex a reflection?"""
        return self._mirrors if self.skinned else np.repeat(self._mirrors, vertices)

    def faces(self, faces: NDArray, vertices: int) -> NDArray[np.int32]:
        """(P F, 3) faces (F, 3), wound the other way where they are mirrored."""
        if self.skinned:
            turned = self._mirrors[faces[:, 0]][:, None]
            return np.where(turned, faces[:, ::-1], faces).astype(np.int32)
        out = np.repeat(faces[None], self._copies, axis=0) + (np.arange(self._copies) * vertices)[:, None, None]
        if self._mirrors.any():
            out[self._mirrors] = out[self._mirrors][..., ::-1]
        return out.reshape(-1, 3).astype(np.int32)

    @property
    def _copies(self) -> int:
        return 1 if self.skinned else len(self.matrix)

    @cached_property
    def _mirrors(self) -> NDArray[np.bool_]:
        return np.linalg.det(self.matrix[:, :3, :3]) < 0

    def _mapped(self, linear: NDArray, v: NDArray, offset: NDArray | None = None) -> NDArray[np.float64]:
        if self.skinned:
            out = np.einsum("vij,vj->vi", linear, v)
            return out if offset is None else out + offset
        out = np.matmul(v, linear.transpose(0, 2, 1))
        return (out if offset is None else out + offset[:, None]).reshape(-1, 3)


_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])


def _cofactors(m: NDArray) -> NDArray[np.float64]:
    """(N, 3, 3) of the linear parts: they transform normals, of singular matrices too (inverse transpose times
    determinant)."""
    i, j, k, n = _NEXT[:, None], _NEXT, _AFTER[:, None], _AFTER
    return m[:, i, j] * m[:, k, n] - m[:, i, n] * m[:, k, j]


class Nodes:
    """The hierarchy of a file."""

    def __init__(self, document: Document) -> None:
        self.document, self.path = document, document.path
        self.nodes = document.items("nodes")
        self._parents = {child: k for k, node in enumerate(self.nodes) for child in node.get("children", [])}
        self._joints: dict[int, NDArray[np.float64]] = {}

    @cached_property
    def local(self) -> NDArray[np.float64]:
        """(N, 4, 4) transforms of the nodes relative to their parents: their matrices, or translation * rotation *
        scale."""
        given = [[n.get(key, default) for n in self.nodes] for key, default in _TRANSFORM.items()]
        out = composed(*(np.array(values, np.float64).reshape(len(self.nodes), -1) for values in given))
        for k, node in enumerate(self.nodes):
            if "matrix" in node:
                out[k] = np.array(node["matrix"], np.float64).reshape(4, 4).T
        return out

    def roots(self) -> list[int]:
        """The nodes that are no one's children."""
        return [k for k in range(len(self.nodes)) if k not in self._parents]

    def world(self, index: int) -> NDArray[np.float64]:
        """(4, 4) transform of a node. Raises InputError if it is its own ancestor."""
        out, steps, at = np.eye(4), 0, index
        while True:
            out = self.local[at] @ out
            if at not in self._parents:
                return out
            at, steps = self._parents[at], steps + 1
            if steps > len(self.nodes):
                raise InputError(f"{self.path}: node {index} is its own ancestor")

    def placement(self, node: dict[str, Any], world: NDArray) -> Placement:
        """Where the mesh of a node that has no skin goes: to one place, or to that of each instance
        (EXT_mesh_gpu_instancing, whose transforms lie between the mesh and the node)."""
        if INSTANCING not in node.get("extensions", {}):
            return Placement(world[None])
        accessors = node["extensions"][INSTANCING]["attributes"]
        given = {key: self.document.accessor(accessors[key.upper()]) for key in _TRANSFORM if key.upper() in accessors}
        counts = {len(v) for v in given.values()}
        if len(counts) > 1:
            raise InputError(f"{self.path}: the attributes of {INSTANCING} differ in length; export it again")
        count = counts.pop() if counts else 0
        each = (
            np.broadcast_to(given.get(key, np.array(default)), (count, len(default)))
            for key, default in _TRANSFORM.items()
        )
        return Placement(world @ composed(*each))

    def skinned(self, skin: int, attributes: dict[str, Any], read: Callable[[str], NDArray]) -> Placement:
        """Where the vertices of a skinned primitive are at rest (glTF 2.0, 3.7.3): the sum of weight * world of the
        joint * inverse bind matrix. The transform of the mesh's own node does not count. ``read``: an attribute."""
        joints = self._rest(skin)
        sets = [k for k in range(len(attributes)) if f"JOINTS_{k}" in attributes and f"WEIGHTS_{k}" in attributes]
        index = np.concatenate([read(f"JOINTS_{k}") for k in sets], axis=1).astype(np.int64)
        weights = np.concatenate([read(f"WEIGHTS_{k}") for k in sets], axis=1).astype(np.float64)
        weights[~np.any(weights, axis=1), 0] = 1.0  # a vertex without weights follows its first joint
        weights /= weights.sum(axis=1, keepdims=True)
        blended = np.zeros((len(index), 4, 4))
        for k in range(index.shape[1]):
            blended += weights[:, k, None, None] * joints[index[:, k]]
        return Placement(blended, skinned=True)

    def _rest(self, skin: int) -> NDArray[np.float64]:
        """(J, 4, 4) world of the joint * inverse bind matrix, for each joint of a skin."""
        if skin not in self._joints:
            given = self.document.items("skins")[skin]
            joints = np.stack([self.world(j) for j in given["joints"]])
            if "inverseBindMatrices" in given:
                inverse = self.document.accessor(given["inverseBindMatrices"]).astype(np.float64)
                joints = joints @ inverse.reshape(-1, 4, 4).transpose(0, 2, 1)[: len(joints)]
            self._joints[skin] = joints
        return self._joints[skin]


_TRANSFORM = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
"""What a node or an instance may say of its place, and what it means to leave it out."""


def composed(translation: NDArray, rotation: NDArray, scale: NDArray) -> NDArray[np.float64]:
    """(N, 4, 4) translation (N, 3) * rotation, unit quaternion (N, 4) as (x, y, z, w), * scale (N, 3)."""
    x, y, z, w = np.asarray(rotation, np.float64).T
    out = np.zeros((len(x), 4, 4))
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:, :3, :3] = np.moveaxis(np.array(turn), 2, 0) * np.asarray(scale, np.float64)[:, None]
    out[:, :3, 3] = translation
    out[:, 3, 3] = 1.0
    return out
