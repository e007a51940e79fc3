"""Skins and animations of a glTF file to a Rig: all nodes of the scene, and every clip."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.instances import Instances
from appearance_opt.asset.rig import (
    REST,
    Bones,
    Channel,
    Clip,
    Joint,
    Rig,
    Skin,
    check_keys,
    estimate_rate,
    usable,
)
from appearance_opt.asset.transforms import decompose, normalized
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.gltf_nodes import Nodes
    from appearance_opt.asset.instances import Instances as Placement

INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")


class RigReader:
    """Brings the meshes of a file to one bind space, and collects what moves them.

    ``roots``: nodes at the top of the scene. The bind space is the world at rest wherever the bind
    pose is the pose at rest, and else as near to it as the topmost joint of each skin says.
    """

    def __init__(self, nodes: Nodes, roots: list[int]) -> None:
        self.nodes, self.document, self.path = nodes, nodes.document, nodes.path
        self.note = self.document.companions.note
        self.order = self._walk(roots)
        self.number = {index: k for k, index in enumerate(self.order)}
        self.worlds = self._worlds()
        self.bones = Bones()
        self._skins: dict[int, tuple[NDArray, NDArray]] = {}
        self._driven = self._driven_nodes()
        self._moving = self._moved_nodes()

    def _walk(self, roots: list[int]) -> list[int]:
        """The nodes below ``roots`` and the joints of skins with their ancestors, parents first."""
        out: dict[int, None] = {}

        def visit(index: int) -> None:
            if index in out:
                raise InputError(f"{self.path}: node {index} has several parents; export it again")
            out[index] = None
            for child in self.nodes.nodes[index].get("children", []):
                visit(child)

        for root in roots:
            visit(root)
        for skin in self.document.items("skins"):
            for joint in skin["joints"]:
                self.nodes.world(joint)  # no node is its own ancestor
                top = joint
                while (parent := self.nodes.parent(top)) is not None:
                    top = parent
                if top not in out:
                    visit(top)
        return list(out)

    def _worlds(self) -> NDArray[np.float64]:
        """(N, 4, 4) transforms of the nodes at rest."""
        out = np.empty((len(self.order), 4, 4))
        for k, index in enumerate(self.order):
            parent = self.nodes.parent(index)
            local = self.nodes.local[index]
            out[k] = local if parent is None else out[self.number[parent]] @ local
        return out

    def _driven_nodes(self) -> set[int]:
        """Nodes of the file that are joints, or that a clip moves."""
        out = {j for skin in self.document.items("skins") for j in skin["joints"]}
        for animation in self.document.items("animations"):
            for channel in animation.get("channels", []):
                target = channel.get("target", {})
                if target.get("path") in REST and "node" in target:
                    out.add(target["node"])
        return out

    def _moved_nodes(self) -> set[int]:
        """Nodes of the file that are driven, or lie below such."""
        out: set[int] = set()
        for index in self.order:
            if index in self._driven or self.nodes.parent(index) in out:
                out.add(index)
        return out

    def skinned(self, skin: int, influences: Skin, name: str) -> tuple[Placement, Skin]:
        """(from the coordinates of a skinned mesh to bind space, its influences on bones of the
        rig). ``influences``: on the joints of the skin. Raises InputError where an inverse bind
        matrix that counts cannot be inverted."""
        if skin not in self._skins:
            self._skins[skin] = self._bind(skin, influences, name)
        to_bind, bones = self._skins[skin]
        self._refuse_singular(skin, influences, name)
        return Instances(to_bind[None]), Skin(bones[influences.bones], influences.weights)

    def _refuse_singular(self, skin: int, influences: Skin, name: str) -> None:
        bad = ~usable(self.nodes.inverse_bind(skin))
        hit = np.unique(influences.bones[bad[influences.bones] & (influences.weights > 0)])
        if len(hit):
            joint = self.document.items("skins")[skin]["joints"][hit[0]]
            raise InputError(
                f"{self.path}, mesh '{name}': the inverse bind matrix of joint "
                f"'{self._name(joint)}' is singular or no number; export it again"
            )

    def _bind(self, skin: int, influences: Skin, name: str) -> tuple[NDArray, NDArray]:
        """((4, 4) from the coordinates of meshes of a skin to bind space, (J,) bones of its
        joints)."""
        self._refuse_singular(skin, influences, name)
        joints = [self.number[j] for j in self.document.items("skins")[skin]["joints"]]
        inverse = self.nodes.inverse_bind(skin)
        counts = np.flatnonzero(usable(inverse))
        known = [k for k in counts if self.bones.bind(joints[k]) is not None]
        if known:
            bind = self.bones.bind(joints[known[0]])
            assert bind is not None
            to_bind = bind @ inverse[known[0]]
        else:
            worn = {int(b) for b in np.unique(influences.bones[influences.weights > 0])}
            top = min((k for k in counts if k in worn), key=lambda k: joints[k])
            to_bind = self.worlds[joints[top]] @ inverse[top]
            if not usable(to_bind[None])[0]:  # a joint that is a point at rest
                to_bind = np.eye(4)
        back = np.linalg.inv(to_bind)
        return to_bind, np.array(
            [self.bones.add(j, m @ back) for j, m in zip(joints, inverse, strict=True)]
        )

    def rigid(self, index: int, place: Placement, world: NDArray) -> tuple[Placement, int | None]:
        """(where a mesh without a skin goes in bind space, its bone) for a node of the file; its
        place in the world and no bone if nothing moves it."""
        if index not in self._moving:
            return place, None
        known = self._bound_ancestor(index)
        to_bind = world
        if known is not None:
            bind, ancestor = known
            to_bind = bind @ np.linalg.inv(self.worlds[ancestor]) @ world
        if not usable(to_bind[None])[0]:  # hidden by a scale of zero at rest
            return Instances(_relative(place, world)), self.bones.add(self.number[index], np.eye(4))
        moved = place.matrix if known is None else to_bind @ np.linalg.inv(world) @ place.matrix
        node = self._carrier(index)
        inverse = self._local_between(node, index) @ np.linalg.inv(to_bind)
        return Instances(moved), self.bones.add(self.number[node], inverse)

    def _bound_ancestor(self, index: int) -> tuple[NDArray, int] | None:
        at: int | None = index
        while at is not None:
            bind = self.bones.bind(self.number[at])
            if bind is not None and usable(self.worlds[self.number[at]][None])[0]:
                return bind, self.number[at]
            at = self.nodes.parent(at)
        return None

    def _carrier(self, index: int) -> int:
        """The node that moves a mesh: its parent where its own is nothing but its place."""
        parent = self.nodes.parent(index)
        return parent if parent is not None and self._plain(index) else index

    def _local_between(self, node: int, index: int) -> NDArray:
        return np.eye(4) if node == index else self.nodes.local[index]

    def _plain(self, index: int) -> bool:
        """Is a node nothing but the place of a mesh: no joint, not moved, without children and
        extras?"""
        node = self.nodes.nodes[index]
        if "mesh" not in node or node.get("children") or "extras" in node:
            return False
        return index not in self._driven

    def rig(self) -> Rig | None:
        """The rig; None if there is neither a bone nor a clip."""
        clips = tuple(self._clips())
        if not self.bones.nodes and not clips:
            return None
        kept = [k for k, index in enumerate(self.order) if self._keep(k, index)]
        place = {old: new for new, old in enumerate(kept)}
        nodes, inverse = self.bones.arrays()
        moved = {c.node for clip in clips for c in clip.channels}
        return Rig(
            tuple(self._node(self.order[k], place, k in moved) for k in kept),
            np.array([place[int(n)] for n in nodes], np.int32),
            inverse,
            tuple(
                Clip(
                    clip.name,
                    tuple(
                        Channel(place[c.node], c.path, c.times, c.values, c.interpolation)
                        for c in clip.channels
                    ),
                    clip.extras,
                )
                for clip in clips
            ),
            estimate_rate(clips),
        )

    def _keep(self, k: int, index: int) -> bool:
        return k in self.bones.nodes or not self._plain(index)

    def _name(self, index: int) -> str:
        return str(self.nodes.nodes[index].get("name", f"node{index}"))

    def _node(self, index: int, place: dict[int, int], moved: bool) -> Joint:
        given = self.nodes.nodes[index]
        parent = self.nodes.parent(index)
        up = -1 if parent is None else place[self.number[parent]]
        name, extras = self._name(index), given.get("extras")
        if "matrix" not in given:
            t, r, s = (tuple(float(x) for x in given.get(k, v)) for k, v in REST.items())
            return Joint(name, up, t, r, s, extras=extras)
        (at,), (turn,), (size,), exact = decompose(self.nodes.local[index][None])
        if exact[0] or moved:
            return Joint(name, up, tuple(at), tuple(turn), tuple(size), extras=extras)
        return Joint(name, up, matrix=self.nodes.local[index], extras=extras)

    def _clips(self) -> list[Clip]:
        out = []
        for k, animation in enumerate(self.document.items("animations")):
            name = str(animation.get("name", f"animation{k}"))
            channels = []
            for channel in animation.get("channels", []):
                target = channel.get("target", {})
                if target.get("path") in REST and target.get("node") in self.number:
                    sampler = animation["samplers"][channel["sampler"]]
                    channels.append(self._channel(sampler, target, name))
                elif target.get("path") == "weights":
                    self.note(f"clip '{name}': what moves morph targets is dropped")
                elif "node" in target and target["node"] not in self.number:
                    self.note(f"clip '{name}': what moves nodes outside of the scene is dropped")
                else:
                    self.note(f"clip '{name}': channels that move no node are dropped")
            if channels:
                out.append(Clip(name, tuple(channels), animation.get("extras")))
            elif not animation.get("channels"):
                raise InputError(f"{self.path}: clip '{name}' has no channels; export it again")
        return _distinct(out)

    def _channel(self, sampler: dict[str, Any], target: dict[str, Any], clip: str) -> Channel:
        path, node = target["path"], target["node"]
        how = sampler.get("interpolation", "LINEAR")
        if how not in INTERPOLATIONS:
            raise InputError(
                f"{self.path}: clip '{clip}' has the interpolation '{how}', which is unknown; "
                f"choose one of {', '.join(INTERPOLATIONS)}"
            )
        times = self.document.accessor(sampler["input"])[:, 0].astype(np.float64)
        values = self.document.accessor(sampler["output"]).astype(np.float64)
        width, each = len(REST[path]), 3 if how == "CUBICSPLINE" else 1
        if values.shape != (len(times) * each, width):
            raise InputError(
                f"{self.path}: clip '{clip}', node '{self._name(node)}': {len(values)} values of "
                f"{values.shape[1]} numbers for {len(times)} keys of its {path}; export it again"
            )
        check_keys(times, values, clip, self._name(node), str(self.path))
        if each == 3:
            values = values.reshape(-1, 3, width)
        elif path == "rotation":
            values = normalized(values)
        return Channel(self.number[node], path, times, values, how)


def _distinct(clips: list[Clip]) -> list[Clip]:
    """The clips with different names: the second of a name gets a number."""
    seen: dict[str, int] = {}
    out = []
    for clip in clips:
        seen[clip.name] = seen.get(clip.name, 0) + 1
        n = seen[clip.name]
        out.append(clip if n == 1 else Clip(f"{clip.name}.{n}", clip.channels, clip.extras))
    return out


def _relative(place: Placement, world: NDArray) -> NDArray:
    """(P, 4, 4) places of copies relative to their node, whose ``world`` has no inverse."""
    flat = np.abs(place.matrix - world).max() == 0
    return np.eye(4)[None] if flat else np.linalg.pinv(world) @ place.matrix
