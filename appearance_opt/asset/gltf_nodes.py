"""Where the nodes of a glTF file put their meshes: transforms, instances, and skins at their rest
pose."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.instances import Instances
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from appearance_opt.asset.gltf_accessors import Document

INSTANCING = "EXT_mesh_gpu_instancing"


class Nodes:
    """The hierarchy of a file."""

    def __init__(self, document: Document) -> None:
        self.document, self.path = document, document.path
        self.nodes = document.items("nodes")
        self._parents = {
            child: k for k, node in enumerate(self.nodes) for child in node.get("children", [])
        }
        self._joints: dict[int, NDArray[np.float64]] = {}

    @cached_property
    def local(self) -> NDArray[np.float64]:
        """(N, 4, 4) transforms of the nodes relative to their parents: their matrices, or
        translation * rotation * scale."""
        given = [[n.get(key, default) for n in self.nodes] for key, default in _TRANSFORM.items()]
        out = compose(
            *(np.array(values, np.float64).reshape(len(self.nodes), -1) for values in given)
        )
        for k, node in enumerate(self.nodes):
            if "matrix" in node:
                out[k] = np.array(node["matrix"], np.float64).reshape(4, 4).T
        return out

    def roots(self) -> list[int]:
        """The nodes that are no one's children."""
        return [k for k in range(len(self.nodes)) if k not in self._parents]

    def visits(self, roots: Iterable[int]) -> int:
        """How many nodes a walk from ``roots`` meets. glTF asks for trees (2.0, 3.5.2); where nodes
        share children all the same, a walk may be far longer than the file. Raises InputError if a
        node is its own ancestor."""
        below: dict[int, int | None] = {}

        def count(index: int) -> int:
            known = below.get(index, 0)
            if known is None:
                raise InputError(f"{self.path}: node {index} is its own ancestor")
            if not known:
                below[index] = None
                below[index] = known = 1 + sum(
                    count(child) for child in self.nodes[index].get("children", [])
                )
            return known

        return sum(count(root) for root in roots)

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

    def placement(self, node: dict[str, Any], world: NDArray) -> Instances:
        """Where the mesh of a node that has no skin goes: to one place, or to that of each instance
        (EXT_mesh_gpu_instancing, whose transforms lie between the mesh and the node)."""
        if INSTANCING not in node.get("extensions", {}):
            return Instances(world[None])
        accessors = node["extensions"][INSTANCING]["attributes"]
        given = {
            key: self.document.accessor(accessors[key.upper()])
            for key in _TRANSFORM
            if key.upper() in accessors
        }
        counts = {len(v) for v in given.values()}
        if len(counts) > 1:
            raise InputError(
                f"{self.path}: the attributes of {INSTANCING} differ in length; export it again"
            )
        count = counts.pop() if counts else 0
        each = (
            np.broadcast_to(given.get(key, np.array(default)), (count, len(default)))
            for key, default in _TRANSFORM.items()
        )
        return Instances(world @ compose(*each))

    def skinned(
        self, skin: int, attributes: dict[str, Any], read: Callable[[str], NDArray]
    ) -> Instances:
        """Where the vertices of a skinned primitive are at rest (glTF 2.0, 3.7.3): the sum of
        weight * world of the joint * inverse bind matrix. The transform of the mesh's own node does
        not count. ``read``: an attribute."""
        joints = self._rest(skin)
        sets = [
            k
            for k in range(len(attributes))
            if f"JOINTS_{k}" in attributes and f"WEIGHTS_{k}" in attributes
        ]
        index = np.concatenate([read(f"JOINTS_{k}") for k in sets], axis=1).astype(np.int64)
        weights = np.concatenate([read(f"WEIGHTS_{k}") for k in sets], axis=1).astype(np.float64)
        weights[~np.any(weights, axis=1), 0] = (
            1.0  # a vertex without weights follows its first joint
        )
        weights /= weights.sum(axis=1, keepdims=True)
        blended = np.zeros((len(index), 4, 4))
        for k in range(index.shape[1]):
            blended += weights[:, k, None, None] * joints[index[:, k]]
        return Instances(blended, skinned=True)

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


_TRANSFORM = {
    "translation": (0.0, 0.0, 0.0),
    "rotation": (0.0, 0.0, 0.0, 1.0),
    "scale": (1.0, 1.0, 1.0),
}
"""What a node or an instance may say of its place, and what it means to leave it out."""


def compose(translation: NDArray, rotation: NDArray, scale: NDArray) -> NDArray[np.float64]:
    """(N, 4, 4) translation (N, 3) * rotation, unit quaternion (N, 4) as (x, y, z, w), * scale (N,
    3)."""
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
