"""A Rig to UsdSkel: one skeleton, and a SkelAnimation for each clip."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.posing import node_matrices, sample
from appearance_opt.asset.rig import REST, Channel, usable
from appearance_opt.asset.transforms import compose, decompose

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.rig import Clip, Rig, Skin
    from appearance_opt.asset.types import Asset

HOLD = 1e-4
"""Where the last sample of a STEP before the next key lies, as a share of the way: a SkelAnimation
interpolates linearly."""

FINEST, CLOSE = 256, 1e-6
"""Samples of a CUBICSPLINE between two keys at the most, and the error of straight lines between
them that is small enough."""

HALF = 1e-6
"""Relative rounding of a scale above which its joint is split in two: animated scales have half
precision in USD, transforms at rest double."""


class RigWriter:
    """Writes the skeleton and the clips of an asset below its SkelRoot ``top``, and binds meshes.

    Joints are the nodes that move something, and those between them; what lies above all of them is
    the place of the skeleton. A node with a constant scale that half precision does not hold
    becomes two joints: one that is animated, and one below it that scales.
    """

    def __init__(self, stage: Any, top: str, asset: Asset, rig: Rig) -> None:
        self.stage, self.top, self.asset, self.rig = stage, top, asset, rig
        moved = {c.node for clip in rig.clips for c in clip.channels}
        named = moved | set(rig.bone_nodes.tolist())
        above = self._common(named)
        self._worlds = node_matrices(rig, None, [0.0])[0]
        self._place = np.eye(4) if above < 0 else self._worlds[above]
        if not usable(self._place[None])[0]:
            above, self._place = -1, np.eye(4)
        self._paths: list[str] = []
        self._names: list[str] = []
        self._rest: list[NDArray] = []
        self._bind: list[NDArray] = []
        self._outer: dict[int, int] = {}
        self._inner: dict[int, int] = {}
        for k in range(len(rig.nodes)):
            needed = k in named or any(k in self._chain(n) for n in named)
            if needed and k != above and above in (-1, *self._chain(k)):
                self._add_node(k)
        self._joint = [self._add_bone(b) for b in range(len(rig.bone_nodes))]
        self._skeleton = self._write_skeleton(
            "Skeleton" if above < 0 else rig.nodes[above].name or "Skeleton"
        )
        self._write_clips()

    def _chain(self, node: int) -> list[int]:
        """The nodes above a node, nearest first."""
        out = []
        while (node := self.rig.nodes[node].parent) >= 0:
            out.append(node)
        return out

    def _common(self, nodes: set[int]) -> int:
        """The lowest node that is above all of these; -1 if none is."""
        chains = [self._chain(n) for n in nodes]
        shared = set.intersection(*map(set, chains)) if chains else set()
        return max(shared, default=-1)

    def _add_node(self, k: int) -> None:
        node = self.rig.nodes[k]
        parent = self._inner.get(node.parent, -1)
        scales = [
            c.values.reshape(-1, 3)
            for clip in self.rig.clips
            for c in clip.channels
            if c.node == k and c.path == "scale"
        ]
        varied = [v for v in scales if np.abs(v - v[0]).max() > 0]
        moved = any(c.node == k for clip in self.rig.clips for c in clip.channels)
        constant = np.array(node.scale, np.float64)
        if len({tuple(v[0]) for v in scales}) == 1 and not varied:
            constant = scales[0][0]
        rounded = np.abs(constant.astype(np.float16).astype(np.float64) - constant)
        local = self._local(k)
        if (
            moved
            and not varied
            and node.matrix is None
            and (rounded > HALF * np.abs(constant)).any()
        ):
            turn = local.copy()
            turn[:3, :3] = local[:3, :3] / np.array(node.scale)
            self._outer[k] = self._append(node.name, parent, turn)
            scaled = np.diag([*constant, 1.0])
            self._inner[k] = self._append(f"{node.name}_scale", self._outer[k], scaled)
            return
        self._outer[k] = self._inner[k] = self._append(node.name, parent, local)

    def _local(self, k: int) -> NDArray[np.float64]:
        node = self.rig.nodes[k]
        if node.matrix is not None:
            return node.matrix
        return compose(np.array(node.translation), np.array(node.rotation), np.array(node.scale))

    def _append(self, name: str, parent: int, local: NDArray) -> int:
        from pxr import Tf

        word = Tf.MakeValidIdentifier(name)
        start = f"{self._paths[parent]}/" if parent >= 0 else ""
        path, n = start + word, 1
        while path in self._paths:
            path, n = f"{start}{word}_{n}", n + 1
        self._paths.append(path)
        self._names.append(name)
        self._rest.append(local)
        self._bind.append(local if parent < 0 else self._bind[parent] @ local)
        return len(self._paths) - 1

    def _add_bone(self, bone: int) -> int:
        """The joint of a bone, whose bind transform is set; a further one below its node's if that
        has another already."""
        node, inverse = int(self.rig.bone_nodes[bone]), self.rig.inverse_bind[bone]
        joint = self._inner[node]
        if not usable(inverse[None])[0]:
            return joint
        if node in self.rig.bone_nodes[:bone]:
            joint = self._append(f"{self.rig.nodes[node].name}_bind", joint, np.eye(4))
        self._bind[joint] = np.linalg.inv(self._place) @ np.linalg.inv(inverse)
        return joint

    def _write_skeleton(self, name: str) -> Any:
        from pxr import Gf, Tf, UsdGeom, UsdSkel, Vt

        skeleton = UsdSkel.Skeleton.Define(self.stage, f"{self.top}/{Tf.MakeValidIdentifier(name)}")
        skeleton.CreateJointsAttr(self._paths)
        skeleton.CreateJointNamesAttr(self._names)
        for create, matrices in (
            (skeleton.CreateRestTransformsAttr, self._rest),
            (skeleton.CreateBindTransformsAttr, self._bind),
        ):
            create(Vt.Matrix4dArray([Gf.Matrix4d(m.T.tolist()) for m in matrices]))
        if not np.array_equal(self._place, np.eye(4)):
            operation = UsdGeom.Xformable(skeleton).AddTransformOp(UsdGeom.XformOp.PrecisionDouble)
            operation.Set(Gf.Matrix4d(self._place.T.tolist()))
        return skeleton

    def _write_clips(self) -> None:
        from pxr import Tf, UsdSkel

        rig, stage = self.rig, self.stage
        stage.SetTimeCodesPerSecond(rig.rate)
        stage.SetFramesPerSecond(rig.rate)
        if not rig.clips:
            return
        stage.SetStartTimeCode(rig.clips[0].start * rig.rate)
        stage.SetEndTimeCode(rig.clips[0].end * rig.rate)
        taken = {str(child.GetName()) for child in stage.GetPrimAtPath(self.top).GetChildren()}
        paths: list[tuple[str, Any]] = []
        for clip in rig.clips:
            word, n = Tf.MakeValidIdentifier(clip.name), 1
            while word in taken:
                word, n = f"{Tf.MakeValidIdentifier(clip.name)}_{n}", n + 1
            taken.add(word)
            animation = UsdSkel.Animation.Define(stage, f"{self.top}/{word}")
            animation.GetPrim().SetDisplayName(clip.name)
            self._write_clip(animation, clip)
            paths.append((word, animation.GetPath()))
        binding = UsdSkel.BindingAPI.Apply(self._skeleton.GetPrim())
        if len(paths) == 1:
            binding.CreateAnimationSourceRel().SetTargets([paths[0][1]])
            return
        choices = stage.GetPrimAtPath(self.top).GetVariantSets().AddVariantSet("clip")
        for word, path in paths:
            choices.AddVariant(word)
            choices.SetVariantSelection(word)
            with choices.GetVariantEditContext():
                binding.CreateAnimationSourceRel().SetTargets([path])
        choices.SetVariantSelection(paths[0][0])

    def _write_clip(self, animation: Any, clip: Clip) -> None:
        from pxr import Vt

        nodes = sorted({c.node for c in clip.channels})
        animation.CreateJointsAttr([self._paths[self._outer[n]] for n in nodes])
        found = {(c.node, c.path): c for c in clip.channels}
        for path, attribute, kind, array in (
            ("translation", animation.CreateTranslationsAttr(), np.float32, Vt.Vec3fArray),
            ("rotation", animation.CreateRotationsAttr(), np.float32, Vt.QuatfArray),
            ("scale", animation.CreateScalesAttr(), np.float16, Vt.Vec3hArray),
        ):
            channels = [found.get((n, path)) for n in nodes]  # type: ignore[arg-type]
            times = [sample_times(c) for c in channels if c is not None]
            every = np.unique(np.concatenate(times)) if times else np.zeros(1)
            values = np.empty((len(every), len(nodes), len(REST[path])))  # type: ignore[index]
            for k, (node, channel) in enumerate(zip(nodes, channels, strict=True)):
                values[:, k] = (
                    self._at_rest(node, str(path)) if channel is None else sample(channel, every)
                )
                if path == "scale" and self._outer[node] != self._inner[node]:
                    values[:, k] = 1.0
            if np.abs(values - values[0]).max() == 0:
                attribute.Set(array.FromNumpy(np.ascontiguousarray(values[0], kind)))
                continue
            for time, now in zip(every.tolist(), values, strict=True):
                attribute.Set(
                    array.FromNumpy(np.ascontiguousarray(now, kind)), time * self.rig.rate
                )

    def _at_rest(self, node: int, path: str) -> NDArray:
        given = self.rig.nodes[node]
        if given.matrix is None:
            return np.array(getattr(given, path))
        parts = dict(zip(REST, decompose(given.matrix[None])[:3], strict=True))
        return parts[path][0]  # type: ignore[index]

    def bind(self, mesh: Any, skin: Skin, first: NDArray) -> None:
        """Bind a mesh of USD to the skeleton. ``first``: vertex that each of its points is."""
        from pxr import Gf, UsdGeom, UsdSkel, Vt

        binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
        binding.CreateSkeletonRel().SetTargets([self._skeleton.GetPath()])
        back = np.linalg.inv(self._place)
        binding.CreateGeomBindTransformAttr(Gf.Matrix4d(back.T.tolist()))
        rigid = skin.rigid
        chosen = skin.take(np.zeros(1, np.int64) if rigid else first)
        joints = np.array(self._joint, np.int32)[chosen.bones]
        weights = chosen.weights / chosen.weights.sum(axis=1, keepdims=True)
        width = joints.shape[1]
        how = UsdGeom.Tokens.constant if rigid else UsdGeom.Tokens.vertex
        for primvar, values in (
            (
                binding.CreateJointIndicesPrimvar(rigid, width),
                Vt.IntArray.FromNumpy(np.ascontiguousarray(joints.ravel(), np.int32)),
            ),
            (
                binding.CreateJointWeightsPrimvar(rigid, width),
                Vt.FloatArray.FromNumpy(np.ascontiguousarray(weights.ravel(), np.float32)),
            ),
        ):
            primvar.SetInterpolation(how)
            primvar.SetElementSize(width)
            primvar.Set(values)


def sample_times(channel: Channel) -> NDArray[np.float64]:
    """Times between which a channel follows straight lines, or great arcs, closely."""
    keys = channel.times
    if channel.interpolation == "LINEAR" or len(keys) < 2:
        return keys
    if channel.interpolation == "STEP":
        return np.unique(np.concatenate([keys, keys[1:] - HOLD * np.diff(keys)]))
    pieces = 1
    while pieces < FINEST:
        pieces *= 2
        times = _divided(keys, pieces)
        straight = Channel(0, channel.path, times, sample(channel, times))
        middle = (times[1:] + times[:-1]) / 2
        if np.abs(sample(straight, middle) - sample(channel, middle)).max() <= CLOSE:
            break
    return times


def _divided(keys: NDArray, pieces: int) -> NDArray[np.float64]:
    inner = np.linspace(keys[:-1], keys[1:], pieces, endpoint=False, axis=1).ravel()
    return np.append(inner, keys[-1])
