"""Where the nodes of a glTF file put their meshes: transforms, instances, and skins at their rest
pose."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.influences import repair_influences
from appearance_opt.asset.instances import Instances
from appearance_opt.asset.posing import blend
from appearance_opt.asset.transforms import compose
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from appearance_opt.asset.gltf_accessors import Document
    from appearance_opt.asset.rig import Skin

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

    @cached_property
    def joints(self) -> frozenset[int]:
        """Nodes that belong to skeletons."""
        skins = self.document.items("skins")
        return frozenset(j for skin in skins for j in skin.get("joints", []))

    def roots(self) -> list[int]:
        """The nodes that are no one's children."""
        return [k for k in range(len(self.nodes)) if k not in self._parents]

    def parent(self, index: int) -> int | None:
        """The node that a node is a child of; None at the top."""
        return self._parents.get(index)

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

    def influences(
        self, skin: int, attributes: dict[str, Any], read: Callable[[str], NDArray], name: str
    ) -> Skin:
        """How the vertices of a skinned primitive follow the joints of a skin; ``read``: an
        attribute; ``name``: of the mesh, for notes."""
        sets = [
            k
            for k in range(len(attributes))
            if f"JOINTS_{k}" in attributes and f"WEIGHTS_{k}" in attributes
        ]
        if not sets:
            raise InputError(
                f"{self.path}, mesh '{name}': it has JOINTS_0 without WEIGHTS_0; export it again"
            )
        return repair_influences(
            np.concatenate([read(f"JOINTS_{k}") for k in sets], axis=1),
            np.concatenate([read(f"WEIGHTS_{k}") for k in sets], axis=1),
            len(self.document.items("skins")[skin]["joints"]),
            name,
            str(self.path),
            self.document.companions.note,
        )

    def skinned(self, skin: int, influences: Skin) -> Instances:
        """Where the vertices of a skinned primitive are at rest (glTF 2.0, 3.7.3): the sum of
        weight * world of the joint * inverse bind matrix. The transform of the mesh's own node does
        not count."""
        return Instances(blend(influences, self._rest(skin)), skinned=True)

    def inverse_bind(self, skin: int) -> NDArray[np.float64]:
        """(J, 4, 4) inverse bind matrices of a skin; identities where it has none."""
        given = self.document.items("skins")[skin]
        count = len(given["joints"])
        if "inverseBindMatrices" not in given:
            return np.broadcast_to(np.eye(4), (count, 4, 4))
        flat = self.document.accessor(given["inverseBindMatrices"]).astype(np.float64)
        if len(flat) < count:
            raise InputError(
                f"{self.path}: skin {skin} has {len(flat)} inverse bind matrices for {count} joints; "
                "export it again"
            )
        return flat.reshape(-1, 4, 4).transpose(0, 2, 1)[:count]

    def _rest(self, skin: int) -> NDArray[np.float64]:
        """(J, 4, 4) world of the joint * inverse bind matrix, for each joint of a skin."""
        if skin not in self._joints:
            given = self.document.items("skins")[skin]
            worlds = np.stack([self.world(j) for j in given["joints"]])
            self._joints[skin] = worlds @ self.inverse_bind(skin)
        return self._joints[skin]


_TRANSFORM = {
    "translation": (0.0, 0.0, 0.0),
    "rotation": (0.0, 0.0, 0.0, 1.0),
    "scale": (1.0, 1.0, 1.0),
}
"""What a node or an instance may say of its place, and what it means to leave it out."""
