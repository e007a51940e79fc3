"""Skeletons and animations of a USD stage to a Rig, evaluated by UsdSkel: joint orders, mappings,
influences, and the transforms of joints at their time samples come from its queries."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.influences import on_bone, repair_influences, sparse
from appearance_opt.asset.instances import Instances
from appearance_opt.asset.rig import Bones, Channel, Clip, Joint, Rig, Skin, check_keys, usable
from appearance_opt.asset.transforms import compose, decompose, normalized, slerp
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

REFINED_INFLUENCES = 8
"""Influences that vertices of a refined surface keep: its rules blend those of many points."""

STEADY = 1e-9
"""Difference, relative to the largest entry, below which a transform does not move."""

FINEST, CLOSE = 64, 1e-6
"""Samples between two keys of moving prims at the most, and the error (relative to the largest
entry in a column of their matrices) that is small enough: their operations (Euler angles, say) do not follow
the straight lines and great arcs of our channels."""


@dataclass(frozen=True)
class _Skeleton:
    """``query``: of UsdSkel; ``order``: its joints; ``to_world`` (4, 4): from skeleton space to
    metres, Y up, at rest; ``inverse`` (J, 4, 4): its inverse bind matrices; ``first``: number of
    the node of its first joint, the node before which is the skeleton itself."""

    query: Any
    order: tuple[str, ...]
    to_world: NDArray[np.float64]
    inverse: NDArray[np.float64]
    first: int


class RigReader:
    """Brings the meshes of a stage to one bind space, and collects what moves them.

    ``to_metres`` (3, 3): from the units and axes of the stage; ``time``: that of the pose at rest.
    """

    def __init__(
        self, stage: Any, path: Path, to_metres: NDArray, time: Any, note: Callable[[str], None]
    ) -> None:
        from pxr import Usd, UsdGeom, UsdSkel

        self.stage, self.path, self.time, self.note = stage, path, time, note
        self.metres = np.eye(4)
        self.metres[:3, :3] = to_metres
        self.rate = float(stage.GetTimeCodesPerSecond()) or 24.0
        self.cache = UsdSkel.Cache()
        inside = Usd.TraverseInstanceProxies()
        for prim in Usd.PrimRange.Stage(stage, inside):
            if prim.IsA(UsdSkel.Root):
                self.cache.Populate(UsdSkel.Root(prim), inside)
        self.xforms = UsdGeom.XformCache(time)
        self.nodes: list[Joint] = []
        self.bones = Bones()
        self._skeletons: dict[str, _Skeleton] = {}
        self._moved: dict[str, int] = {}
        self._channels: list[Channel] = []

    def influences(self, prim: Any, points: int) -> Skin | None:
        """Those of a mesh's points on the joints of its skeleton, by their numbers in its order;
        None without a skeleton that UsdSkel lets it follow."""
        from pxr import UsdSkel

        binding = UsdSkel.BindingAPI(prim)
        if not binding.GetJointIndicesPrimvar().HasValue():
            return None
        query = self.cache.GetSkinningQuery(prim)
        if not query or not query.HasJointInfluences():
            self.note(
                f"'{prim.GetPath()}': not skinned, it has no skeleton below a common SkelRoot, "
                "joints and weights that UsdSkel takes"
            )
            return None
        skeleton = self._skeleton(prim)
        method = str(query.GetSkinningMethod()) if hasattr(query, "GetSkinningMethod") else ""
        if method == "dualQuaternion":
            self.note(
                f"'{prim.GetPath()}': the skinningMethod dualQuaternion is not followed; it is posed "
                "by linear blending, which differs where joints twist"
            )
        names = query.GetJointOrder()
        order = skeleton.order if names is None else tuple(map(str, names))
        number = {joint: k for k, joint in enumerate(skeleton.order)}
        unknown = [j for j in order if j not in number]
        if unknown:
            raise InputError(
                f"{self.path}, mesh '{prim.GetPath()}': its joint '{unknown[0]}' is not in the "
                "skeleton; export it again"
            )
        indices, weights, count = self._stored(query, prim)
        if not query.IsRigidlyDeformed() and len(indices) != points * count:
            raise InputError(
                f"{self.path}, mesh '{prim.GetPath()}': {len(indices)} joint indices for {points} "
                f"points with {count} each; export it again"
            )
        skin = repair_influences(
            indices.reshape(-1, count),
            weights.reshape(-1, count),
            len(order),
            str(prim.GetName()),
            str(self.path),
            self.note,
        )
        to_skeleton = np.array([number[j] for j in order], np.int32)
        skin = Skin(to_skeleton[skin.bones], skin.weights)
        return skin.take(np.zeros(points, np.int64)) if query.IsRigidlyDeformed() else skin

    def _stored(self, query: Any, prim: Any) -> tuple[NDArray, NDArray, int]:
        indices = np.array(query.GetJointIndicesPrimvar().ComputeFlattened(self.time) or [])
        weights = np.array(query.GetJointWeightsPrimvar().ComputeFlattened(self.time) or [])
        count = int(query.GetNumInfluencesPerComponent())
        if not len(indices) or len(indices) != len(weights) or count < 1 or len(indices) % count:
            raise InputError(
                f"{self.path}, mesh '{prim.GetPath()}': {len(indices)} joint indices for "
                f"{len(weights)} joint weights; export it again"
            )
        return indices, weights, count

    def place(self, prim: Any, skin: Skin) -> tuple[Instances, Skin]:
        """(from the coordinates of a skinned mesh to bind space, its influences on bones of the
        rig). ``skin``: on the joints of its skeleton."""
        skeleton = self._skeleton(prim)
        worn = np.unique(skin.bones[skin.weights > 0])
        bad = worn[~usable(skeleton.inverse[worn])]
        if len(bad):
            raise InputError(
                f"{self.path}, mesh '{prim.GetPath()}': the bind transform of joint "
                f"'{skeleton.order[bad[0]]}' is singular or no number; export it again"
            )
        query = self.cache.GetSkinningQuery(prim)
        to_skeleton = _columns(query.GetGeomBindTransform(self.time))
        back = np.linalg.inv(skeleton.to_world)
        bones = np.array(
            [
                self.bones.add(skeleton.first + k, m @ back) if np.isfinite(m).all() else -1
                for k, m in enumerate(skeleton.inverse)
            ]
        )
        place = Instances((skeleton.to_world @ to_skeleton)[None])
        return place, Skin(bones[skin.bones].astype(np.int32), skin.weights)

    def rigid(self, prim: Any, vertices: int) -> Skin | None:
        """That of a mesh without a skin, which moves with its prim; None if that stands still."""
        key = str(prim.GetPath())
        if key not in self._moved:
            times = _times_of(prim)
            if not len(times):
                return None
            number = len(self.nodes)
            world = self.metres @ self._world(prim, self.time)
            self.nodes.append(_node(str(prim.GetName()), -1, world))
            self._channels += self._sampled(prim, times, number)
            inverse = np.linalg.inv(world) if usable(world[None])[0] else np.eye(4)
            self._moved[key] = self.bones.add(number, inverse)
        return on_bone(self._moved[key], vertices)

    def _skeleton(self, prim: Any) -> _Skeleton:
        from pxr import UsdSkel

        found = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
        key = str(found.GetPrim().GetPath())
        if key not in self._skeletons:
            self._skeletons[key] = self._read_skeleton(found)
        return self._skeletons[key]

    def _read_skeleton(self, skeleton: Any) -> _Skeleton:
        query, prim = self.cache.GetSkelQuery(skeleton), skeleton.GetPrim()
        where = f"{self.path}, skeleton '{prim.GetPath()}'"
        if not query:
            raise InputError(f"{where}: UsdSkel cannot use it; export it again")
        order = tuple(map(str, query.GetJointOrder()))
        bind = np.array(skeleton.GetBindTransformsAttr().Get() or []).reshape(-1, 4, 4)
        if len(bind) != len(order):
            raise InputError(
                f"{where}: {len(bind)} bind transforms for {len(order)} joints; export it again"
            )
        self._check_source(prim, where)
        bind = np.swapaxes(bind, 1, 2)
        parents = list(query.GetTopology().GetParentIndices())
        rest = np.array(skeleton.GetRestTransformsAttr().Get() or []).reshape(-1, 4, 4)
        if len(rest) == len(order):
            rest = np.swapaxes(rest, 1, 2)
        else:
            self.note(
                f"'{prim.GetPath()}': without a transform at rest for each joint; bound there"
            )
            rest = bind.copy()
            for k, up in enumerate(parents):
                if up >= 0 and usable(bind[up][None])[0]:
                    rest[k] = np.linalg.inv(bind[up]) @ bind[k]
        to_world = self.metres @ self._world(prim, self.time)
        if not usable(to_world[None])[0]:
            raise InputError(f"{where}: its transform is singular; export it again")
        top = len(self.nodes)
        self.nodes.append(_node(str(prim.GetName()), -1, to_world))
        self._channels += self._sampled(prim, _times_of(prim), top)
        given = skeleton.GetJointNamesAttr().Get() or []
        names = (
            list(map(str, given)) if len(given) == len(order) else [j.split("/")[-1] for j in order]
        )
        for k, (name, up) in enumerate(zip(names, parents, strict=True)):
            self.nodes.append(_node(name, top if up < 0 else top + 1 + up, rest[k]))
        inverse = np.full((len(order), 4, 4), np.nan)
        good = usable(bind)
        inverse[good] = np.linalg.inv(bind[good])
        return _Skeleton(query, order, to_world, inverse, top + 1)

    def _check_source(self, prim: Any, where: str) -> None:
        """Refuse a skeleton whose animation is named but not there."""
        from pxr import UsdSkel

        at = prim
        while at and at.GetPath() != at.GetPath().absoluteRootPath:
            relation = UsdSkel.BindingAPI(at).GetAnimationSourceRel()
            targets = relation.GetForwardedTargets() if relation else []
            for target in targets:
                source = self.stage.GetPrimAtPath(target)
                if not source or not source.IsA(UsdSkel.Animation):
                    missing = self._missing_layers()
                    raise InputError(
                        f"{where}: its animation '{target}' is not there"
                        + (f", as the file '{missing[0]}' is missing; add it" if missing else "")
                        + "; export it again"
                    )
            if targets:
                return
            at = at.GetParent()

    def _missing_layers(self) -> list[str]:
        from pxr import UsdUtils

        return list(UsdUtils.ComputeAllDependencies(self.stage.GetRootLayer().identifier)[2])

    def _world(self, prim: Any, time: Any) -> NDArray[np.float64]:
        self.xforms.SetTime(time)
        return _columns(self.xforms.GetLocalToWorldTransform(prim))

    def _worlds(self, prim: Any, times: NDArray) -> NDArray[np.float64]:
        return np.stack([self.metres @ self._world(prim, t) for t in times.tolist()])

    def _sampled(self, prim: Any, times: NDArray, node: int) -> list[Channel]:
        """Channels of a moving prim's transform to the world, which has keys at the time codes
        ``times`` (T,)."""
        if len(times) < 2:
            return []
        worlds = self._worlds(prim, times)
        pieces = 1
        while pieces < FINEST:
            middle = self._worlds(prim, (times[1:] + times[:-1]) / 2)
            t, r, s, _ = decompose(worlds)
            half = np.full(len(times) - 1, 0.5)
            straight = compose(
                (t[1:] + t[:-1]) / 2, slerp(r[:-1], r[1:], half), (s[1:] + s[:-1]) / 2
            )
            error, size = (np.abs(m)[:, :3].max(axis=(0, 1)) for m in (straight - middle, worlds))
            if (error <= CLOSE * np.maximum(size, size[:3].max())).all():
                break
            pieces *= 2
            times = np.insert(times, np.arange(1, len(times)), (times[1:] + times[:-1]) / 2)
            worlds = np.insert(worlds, np.arange(1, len(worlds)), middle, axis=0)
        if np.abs(worlds - worlds[0]).max() <= STEADY * np.abs(worlds).max():
            return []
        *parts, exact = decompose(worlds)
        if not exact.all():
            self.note(f"'{prim.GetPath()}': the shear of its animated transform is left out")
        return _channels(node, times / self.rate, *parts)

    def rig(self) -> Rig | None:
        """The rig; None if nothing moves a mesh."""
        if not self.bones.nodes:
            return None
        clips = tuple(self._clips())
        nodes, inverse = self.bones.arrays()
        return Rig(tuple(self.nodes), nodes, inverse, clips, self.rate)

    def _clips(self) -> list[Clip]:
        """What the stage plays, animations bound to skeletons and moving prims together, and every
        other animation of joints that a skeleton has."""
        from pxr import Usd, UsdSkel

        played: list[Channel] = list(self._channels)
        name, bound = "", set()
        for skeleton in self._skeletons.values():
            query = skeleton.query.GetAnimQuery()
            if query:
                source = query.GetPrim()
                bound.add(str(source.GetPath()))
                name = name or _name_of(source)
                played += self._joint_channels(skeleton, query)
        out = (
            [Clip(name or str(self.stage.GetDefaultPrim().GetName()), tuple(played))]
            if played
            else []
        )
        for prim in Usd.PrimRange.Stage(self.stage, Usd.TraverseInstanceProxies()):
            if not prim.IsA(UsdSkel.Animation) or str(prim.GetPath()) in bound:
                continue
            query = self.cache.GetAnimQuery(UsdSkel.Animation(prim))
            channels: list[Channel] = []
            for skeleton in self._skeletons.values():
                channels += self._joint_channels(skeleton, query) if query else []
            if channels:
                out.append(Clip(_name_of(prim), tuple(channels)))
        seen: dict[str, int] = {}
        for k, clip in enumerate(out):
            seen[clip.name] = seen.get(clip.name, 0) + 1
            if seen[clip.name] > 1:
                out[k] = replace(clip, name=f"{clip.name}.{seen[clip.name]}")
        return out

    def _joint_channels(self, skeleton: _Skeleton, query: Any) -> list[Channel]:
        """Channels of the joints of a skeleton that an animation moves; it sets all of a joint's
        transform at once."""
        from pxr import UsdSkel

        prim = query.GetPrim()
        animation, own = UsdSkel.Animation(prim), tuple(map(str, query.GetJointOrder()))
        number = {joint: k for k, joint in enumerate(skeleton.order)}
        shared = [(k, number[j]) for k, j in enumerate(own) if j in number]
        if not shared:
            return []
        out: list[Channel] = []
        columns = [k for k, _ in shared]
        for path, attribute, width in (
            ("translation", animation.GetTranslationsAttr(), 3),
            ("rotation", animation.GetRotationsAttr(), 4),
            ("scale", animation.GetScalesAttr(), 3),
        ):
            times = np.array(attribute.GetTimeSamples() or [0.0])
            values = np.stack([_numbers(attribute.Get(t), width) for t in times.tolist()])
            if values.shape[1] != len(own):
                raise InputError(
                    f"{self.path}: clip '{prim.GetName()}' has {values.shape[1]} {path}s for "
                    f"{len(own)} joints, so no keys; export it again"
                )
            check_keys(times, values, str(prim.GetName()), path + "s", str(self.path))
            if path == "rotation":
                values = normalized(values)
            for column, joint in zip(columns, (j for _, j in shared), strict=True):
                node = skeleton.first + joint
                out += self._channel(node, path, times / self.rate, values[:, column])
        return out

    def _channel(self, node: int, path: Any, times: NDArray, values: NDArray) -> list[Channel]:
        """One channel; none for a constant that is the joint's place at rest."""
        constant = np.abs(values - values[0]).max() == 0
        given = self.nodes[node]
        if constant and given.matrix is None:
            rest = np.array(getattr(given, path))
            close = np.abs(values[0] - rest).max() <= 1e-7 * max(1.0, np.abs(rest).max())
            if close or (path == "rotation" and abs(values[0] @ rest) > 1 - 1e-14):
                return []
        if constant:
            times, values = times[:1], values[:1]
        return [Channel(node, path, times, values)]


def refined_influences(dense: NDArray) -> Skin:
    """The influences of a refined surface, from the weights (V, J) that its rules blend."""
    return sparse(np.maximum(dense, 0.0), REFINED_INFLUENCES)


def dense(skin: Skin) -> NDArray[np.float64]:
    """(V, J) weights on all joints up to the last one used."""
    out = np.zeros((len(skin.bones), int(skin.bones.max(initial=0)) + 1))
    rows = np.repeat(np.arange(len(out)), skin.bones.shape[1])
    np.add.at(out, (rows, skin.bones.ravel()), skin.weights.ravel())
    return out


def _columns(matrix: Any) -> NDArray[np.float64]:
    """A matrix of USD, which is for rows, for columns."""
    return np.array(matrix, np.float64).T


def _numbers(value: Any, width: int) -> NDArray[np.float64]:
    """(J, width) of an array of vectors, or of quaternions, which come as (x, y, z, w)."""
    if value is None:
        return np.empty((0, width))
    return np.array(value, np.float64).reshape(-1, width)


def _node(name: str, parent: int, local: NDArray) -> Joint:
    t, r, s, exact = decompose(local[None])
    if exact[0]:
        return Joint(name, parent, tuple(t[0]), tuple(r[0]), tuple(s[0]))
    return Joint(name, parent, matrix=local)


def _channels(node: int, times: NDArray, t: NDArray, r: NDArray, s: NDArray) -> list[Channel]:
    parts = (("translation", t), ("rotation", r), ("scale", s))
    return [
        Channel(node, path, times, values)  # type: ignore[arg-type]
        for path, values in parts
        if np.abs(values - values[0]).max() > 0
    ]


def _name_of(prim: Any) -> str:
    """The name that a prim shows: names of prims have no spaces and dots."""
    shown = prim.GetDisplayName() if prim.HasAuthoredDisplayName() else ""
    return str(shown or prim.GetName())


def _times_of(prim: Any) -> NDArray[np.float64]:
    """Time codes at which the transform to the world of a prim has samples."""
    from pxr import UsdGeom

    found: set[float] = set()
    at = prim
    while at:
        form = UsdGeom.Xformable(at)
        if form and form.TransformMightBeTimeVarying():
            found.update(form.GetTimeSamples())
        at = at.GetParent()
    return np.array(sorted(found))
