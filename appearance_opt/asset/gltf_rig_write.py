"""A Rig to glTF 2.0: nodes, skins and animations."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.instances import Instances, place_copies
from appearance_opt.asset.rig import REST

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.gltf_buffers import Buffers
    from appearance_opt.asset.quantize import Grid
    from appearance_opt.asset.rig import Rig
    from appearance_opt.asset.types import Asset, Mesh


class RigWriter:
    """The nodes of a rigged asset, and what its meshes need to follow them.

    A mesh whose skin is rigid hangs on a node, in the node's own coordinates. All others share one
    skin; a second bone of a node gets a node of its own below it, as joints of a skin are unique.
    """

    def __init__(self, asset: Asset, rig: Rig) -> None:
        self.rig, self.asset = rig, asset
        self.nodes: list[dict[str, Any]] = [_node(rig, k) for k in range(len(rig.nodes))]
        self._joint: dict[int, int] = {}  # place in the skin of each bone
        hung = {
            int(m.skin.bones[0, 0]) for m in asset.meshes if m.skin is not None and m.skin.rigid
        }
        skinned = [m.skin for m in asset.meshes if m.skin is not None and not m.skin.rigid]
        worn = {int(b) for s in skinned for b in np.unique(s.bones[s.weights > 0])}
        self.joints: list[int] = []
        self._bones: list[int] = []
        if not skinned:
            return
        for bone, node in enumerate(rig.bone_nodes.tolist()):
            if bone in hung and bone not in worn:
                continue
            if node in self.joints:
                self.nodes[node].setdefault("children", []).append(len(self.nodes))
                self.nodes.append({"name": f"{rig.nodes[node].name}_bind"})
                node = len(self.nodes) - 1
            self._joint[bone] = len(self.joints)
            self.joints.append(node)
            self._bones.append(bone)

    @property
    def parts(self) -> tuple[list[Mesh], list[Mesh], list[Mesh]]:
        """The meshes that share the skin, with its joints for bones; those that hang on nodes, in
        their coordinates; and those that stand still."""
        skinned, hung, still = [], [], []
        for mesh in self.asset.meshes:
            if mesh.skin is None:
                still.append(mesh)
            elif mesh.skin.rigid:
                hung.append(hang(mesh, self.rig))
            else:
                bones = np.zeros(len(self.rig.bone_nodes), np.int32)
                bones[list(self._joint)] = list(self._joint.values())
                skin = replace(mesh.skin, bones=bones[mesh.skin.bones])
                skinned.append(replace(mesh, skin=skin))
        return skinned, hung, still

    def node_of(self, mesh: Mesh) -> int:
        """The node on which a mesh hangs."""
        assert mesh.skin is not None
        return int(self.rig.bone_nodes[mesh.skin.bones[0, 0]])

    def finish(self, out: Buffers, grid: Grid | None) -> dict[str, Any]:
        """The scene, nodes, skins and animations of the JSON. ``grid``: of the positions of the
        meshes that share the skin; inverse bind matrices undo it."""
        below = {child for node in self.nodes for child in node.get("children", [])}
        tops = [k for k in range(len(self.nodes)) if k not in below]
        roots = {self._top(joint) for joint in self.joints}
        if len(roots) > 1:  # joints of a skin must have a common root
            self.nodes.append({"name": self.asset.name, "children": sorted(roots)})
            tops = [k for k in tops if k not in roots] + [len(self.nodes) - 1]
        found: dict[str, Any] = {"scenes": [{"nodes": tops}], "nodes": self.nodes}
        if self.joints:
            inverse = self.rig.inverse_bind[self._bones]
            if grid is not None:
                undo = np.diag([grid.scale] * 3 + [1.0])
                undo[:3, 3] = grid.low
                inverse = inverse @ undo
            flat = inverse.transpose(0, 2, 1).reshape(-1, 16)
            flat[:, [3, 7, 11]], flat[:, 15] = 0.0, 1.0
            found["skins"] = [
                {
                    "name": (self.asset.contents.skins or ("skin",))[0],
                    "joints": self.joints,
                    "inverseBindMatrices": out.add_numbers(flat),
                }
            ]
        if self.rig.clips:
            found["animations"] = self._animations(out)
        return found

    def _top(self, node: int) -> int:
        parents = {c: k for k, n in enumerate(self.nodes) for c in n.get("children", [])}
        while node in parents:
            node = parents[node]
        return node

    def _animations(self, out: Buffers) -> list[dict[str, Any]]:
        inputs: dict[bytes, int] = {}
        found = []
        for clip in self.rig.clips:
            samplers, channels = [], []
            for channel in clip.channels:
                times = _increasing(channel.times)
                key = times.tobytes()
                if key not in inputs:
                    inputs[key] = out.add_numbers(times[:, None], bounds=True)
                values = channel.values.reshape(-1, len(REST[channel.path]))
                samplers.append(
                    {
                        "input": inputs[key],
                        "output": out.add_numbers(values),
                        "interpolation": channel.interpolation,
                    }
                )
                channels.append(
                    {
                        "sampler": len(samplers) - 1,
                        "target": {"node": channel.node, "path": channel.path},
                    }
                )
            entry: dict[str, Any] = {"name": clip.name, "samplers": samplers, "channels": channels}
            found.append(entry if clip.extras is None else {**entry, "extras": clip.extras})
        return found


def hang(mesh: Mesh, rig: Rig) -> Mesh:
    """A mesh with a rigid skin in the coordinates of the node of its bone, still with the skin."""
    assert mesh.skin is not None
    place = Instances(rig.inverse_bind[mesh.skin.bones[0, 0]][None])
    moved = place_copies(mesh, place, mesh.name)
    return replace(moved, positions=moved.positions.astype(np.float32), skin=mesh.skin)


def _node(rig: Rig, k: int) -> dict[str, Any]:
    node = rig.nodes[k]
    out: dict[str, Any] = {"name": node.name}
    children = [c for c, other in enumerate(rig.nodes) if other.parent == k]
    if children:
        out["children"] = children
    if node.matrix is not None:
        out["matrix"] = node.matrix.T.ravel().tolist()
    else:
        for path, nothing in REST.items():
            value = getattr(node, path)
            if tuple(value) != nothing:
                out[path] = [float(x) for x in value]
    return out if node.extras is None else {**out, "extras": node.extras}


def _increasing(times: NDArray) -> NDArray[np.float32]:
    """The same in single precision, each later than the one before, as glTF asks."""
    out = times.astype(np.float32)
    for k in np.flatnonzero(np.diff(out) <= 0).tolist():
        out[k + 1] = max(out[k + 1], np.nextafter(out[k], np.float32(np.inf)))
    return out
