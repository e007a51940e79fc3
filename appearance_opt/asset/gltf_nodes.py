"""Where the nodes of a glTF file put their meshes: transforms, instances, and skins at their rest pose."""

from __future__ import annotations

from dataclasses import dataclass
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
    """Affine maps from a mesh to the world: ``matrix`` is (4, 4), or (V, 4, 4) with one for each vertex."""

    matrix: NDArray[np.float64]

    def points(self, p: NDArray) -> NDArray[np.float64]:
        """(V, 3) positions in the world."""
        return self.directions(p) + self.matrix[..., :3, 3]

    def directions(self, v: NDArray) -> NDArray[np.float64]:
        """(V, 3) tangents in the world, of any length."""
        return _times(self.matrix[..., :3, :3], v)

    def normals(self, n: NDArray) -> NDArray[np.float64]:
        """(V, 3) normals in the world, of any length."""
        return _times(_cofactor(self.matrix[..., :3, :3]), n)

    def mirrors(self, vertices: int) -> NDArray[np.bool_]:
        """(V,) is the mapping of a vertex a reflection?"""
        return np.broadcast_to(np.linalg.det(self.matrix[..., :3, :3]) < 0, (vertices,))


def _times(matrices: NDArray, v: NDArray) -> NDArray[np.float64]:
    return v @ matrices.T if matrices.ndim == 2 else np.einsum("vij,vj->vi", matrices, v)


def _cofactor(m: NDArray) -> NDArray:
    """Transforms normals, singular matrices included (inverse transpose times determinant, sign kept)."""
    a, b, c = m[..., 0, :], m[..., 1, :], m[..., 2, :]
    out = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)
    return np.where(np.linalg.det(m)[..., None, None] >= 0, out, -out)


class Nodes:
    """The hierarchy of a file."""

    def __init__(self, document: Document) -> None:
        self.document, self.path = document, document.path
        self.nodes = document.items("nodes")
        self._parents = {child: k for k, node in enumerate(self.nodes) for child in node.get("children", [])}

    def roots(self) -> list[int]:
        """The nodes that are no one's children."""
        return [k for k in range(len(self.nodes)) if k not in self._parents]

    def world(self, index: int) -> NDArray[np.float64]:
        """(4, 4) transform of a node. Raises InputError if it is its own ancestor."""
        out, steps, at = np.eye(4), 0, index
        while True:
            out = local_transform(self.nodes[at]) @ out
            if at not in self._parents:
                return out
            at, steps = self._parents[at], steps + 1
            if steps > len(self.nodes):
                raise InputError(f"{self.path}: node {index} is its own ancestor")

    def placements(self, node: dict[str, Any], world: NDArray) -> list[Placement]:
        """Where the mesh of a node that has no skin goes: once, or once for each instance (EXT_mesh_gpu_instancing,
        whose transforms lie between the mesh and the node)."""
        if INSTANCING not in node.get("extensions", {}):
            return [Placement(world)]
        accessors = node["extensions"][INSTANCING]["attributes"]
        given = {
            key: self.document.accessor(accessors[name])
            for key, name in (("translation", "TRANSLATION"), ("rotation", "ROTATION"), ("scale", "SCALE"))
            if name in accessors
        }
        counts = {len(v) for v in given.values()}
        if len(counts) > 1:
            raise InputError(f"{self.path}: the attributes of {INSTANCING} differ in length; export it again")
        return [
            Placement(world @ local_transform({k: v[i].tolist() for k, v in given.items()}))
            for i in range(counts.pop() if counts else 0)
        ]

    def skinned(self, skin: int, attributes: dict[str, Any], read: Callable[[str], NDArray]) -> Placement:
        """Where the vertices of a skinned primitive are at rest (glTF 2.0, 3.7.3): the sum of weight * world of the
        joint * inverse bind matrix. The transform of the mesh's own node does not count. ``read``: an attribute."""
        given = self.document.items("skins")[skin]
        joints = np.stack([self.world(j) for j in given["joints"]])
        if "inverseBindMatrices" in given:
            inverse = self.document.accessor(given["inverseBindMatrices"]).astype(np.float64)
            joints = joints @ inverse.reshape(-1, 4, 4).transpose(0, 2, 1)[: len(joints)]
        sets = [k for k in range(len(attributes)) if f"JOINTS_{k}" in attributes and f"WEIGHTS_{k}" in attributes]
        index = np.concatenate([read(f"JOINTS_{k}") for k in sets], axis=1).astype(np.int64)
        weights = np.concatenate([read(f"WEIGHTS_{k}") for k in sets], axis=1).astype(np.float64)
        weights[~np.any(weights, axis=1), 0] = 1.0  # a vertex without weights follows its first joint
        weights /= weights.sum(axis=1, keepdims=True)
        blended = np.zeros((len(index), 4, 4))
        for k in range(index.shape[1]):
            blended += weights[:, k, None, None] * joints[index[:, k]]
        return Placement(blended)


def local_transform(node: dict[str, Any]) -> NDArray[np.float64]:
    """(4, 4) of a node relative to its parent: its matrix, or translation * rotation * scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = (float(q) for q in node.get("rotation", (0, 0, 0, 1)))
    out = np.eye(4)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    out[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64)
    out[:3, 3] = node.get("translation", (0, 0, 0))
    return out
