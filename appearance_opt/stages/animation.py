"""What a job needs that fits over an animation: its frames, the subject at each, and its skin."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.influences import on_bone
from appearance_opt.asset.normals import summed_normals
from appearance_opt.asset.origin import ZERO
from appearance_opt.asset.posing import bone_matrices, pose_positions
from appearance_opt.asset.rig import Joint, Rig, Skin
from appearance_opt.errors import InputError
from appearance_opt.initial.influences import transfer_influences
from appearance_opt.latent.skinning import BoneFrames, support_of
from appearance_opt.placement import Placement
from appearance_opt.reference.animated import AnimatedReference, FramePool
from appearance_opt.reference.subject import Subject
from appearance_opt.reference.survey import MeshSurvey
from appearance_opt.views import Sampler, views_around

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.options.animation import AnimationOptions
    from appearance_opt.options.views import ViewOptions

MOST = 48
"""Frames of a fit, unless they are named: neighbours hardly differ."""

LOOKED_AT = 8
"""Frames that tell what is ever seen."""

POINTS = 4000
"""Vertices that tell where a frame lies."""


@dataclass(frozen=True)
class Frame:
    """``number``: counted at the rate of the file; ``time``: seconds."""

    clip: str
    number: float
    time: float

    def __str__(self) -> str:
        return f"{self.clip} {self.number:g}"


@dataclass(frozen=True)
class Animation:
    """``asset``: with its rig; every mesh has a skin. ``frames``: those that are fitted;
    ``placements``: where each lies in the world, all of one scale; ``matrices`` (T, B, 4, 4): from
    the bind pose in local coordinates to each frame in its own. ``subject``: the bind pose, within
    the unit sphere; ``reference``, ``samplers``: what draws the frames, and views of each."""

    asset: Asset
    rig: Rig
    frames: tuple[Frame, ...]
    placements: tuple[Placement, ...]
    matrices: NDArray[np.float64]
    subject: Subject
    reference: AnimatedReference
    samplers: tuple[Sampler, ...]

    @classmethod
    def of(cls, asset: Asset, options: AnimationOptions, views: ViewOptions) -> Animation:
        """An asset that moves, at the frames that are asked for. Raises InputError if there are
        none."""
        asset, rig = anchored(asset)
        frames = choose_frames(rig, options)
        world = _matrices(rig, frames)
        bind = Placement.around(asset.points())
        few = replace(asset, meshes=tuple(_thinned(asset)))
        points = [
            np.concatenate([pose_positions(m, at) for m in few.meshes if len(m.positions)])
            for at in world
        ]
        around = [Placement.around(p) for p in points]
        scale = max(p.scale for p in around)
        placements = tuple(Placement(p.centre, scale) for p in around)
        local = np.stack(
            [
                np.linalg.inv(_affine(p)) @ m @ _affine(bind)
                for p, m in zip(placements, world, strict=True)
            ]
        )
        reference = AnimatedReference(replace(bind.local(asset), rig=None), local)
        sampler = views_around(reference.bind.merged.positions, views.seed, views.light)
        subject = Subject(
            reference.bind, sampler, bind, _survey(reference, local), replace(asset, rig=None)
        )
        samplers = tuple(
            views_around(place.to_local(p), views.seed, views.light)
            for place, p in zip(placements, points, strict=True)
        )
        return cls(asset, rig, frames, placements, local, subject, reference, samplers)

    def pool(self, options: ViewOptions, samples: int, width: float) -> FramePool:
        """Images of the frames for a fit; see ``ReferencePool``."""
        return FramePool(
            self.subject.reference,
            self.subject.sampler,
            options.pool,
            options.per_step,
            options.resolution,
            samples,
            width,
            options.reuse,
            animated=self.reference,
            samplers=self.samplers,
        )

    def at(self, frame: int) -> Subject:
        """The subject of one frame."""
        return Subject(
            self.reference.at(frame), self.samplers[frame], self.placements[frame], None, None
        )

    def device_frames(self) -> BoneFrames:
        """What the bones do in each frame."""
        return BoneFrames.of(self.matrices)

    def transfer_skin(self, mesh: LatentMesh, places: int) -> Skin:
        """Weights of a light mesh from those of the asset, with room for ``places`` bones each."""
        merged = self.reference.bind.merged
        normals = summed_normals(mesh.positions, mesh.faces, welded=True)
        skin = transfer_influences(
            mesh.positions,
            normals,
            merged.positions,
            merged.faces,
            joined_skin(self.reference),
            len(self.rig.bone_nodes),
        )
        return support_of(skin, mesh.faces, places)


def joined_skin(reference: AnimatedReference) -> Skin:
    """The influences of the vertices of all meshes."""
    skins = [m.skin for m in reference.completed if m.skin is not None]
    widest = max(s.bones.shape[1] for s in skins)
    wide = [_widened(s, widest) for s in skins]
    return Skin(np.concatenate([s.bones for s in wide]), np.concatenate([s.weights for s in wide]))


def _survey(reference: AnimatedReference, matrices: NDArray) -> MeshSurvey:
    """The surface of the bind pose, which is seen at some of the frames."""
    some = np.unique(np.linspace(0, len(matrices) - 1, LOOKED_AT).round().astype(int))
    poses = tuple(reference.at(int(k)).scene for k in some)
    return MeshSurvey(reference.bind, poses)


def anchored(asset: Asset) -> tuple[Asset, Rig]:
    """(the asset with a skin for every mesh, its rig): what stands still hangs on a bone that does.
    Raises InputError without a rig that moves."""
    rig = asset.rig
    if rig is None or not rig.clips:
        raise InputError(
            f"{asset.name}: there is no animation in it; `appearance-opt simplify` makes still meshes"
        )
    still = [m.skin is None for m in asset.meshes]
    if any(still):
        bone = len(rig.bone_nodes)
        rig = replace(
            rig,
            nodes=(*rig.nodes, Joint("still")),
            bone_nodes=np.append(rig.bone_nodes, np.int32(len(rig.nodes))),
            inverse_bind=np.concatenate([rig.inverse_bind, np.eye(4)[None]]),
        )
        meshes = (
            replace(m, skin=on_bone(bone, len(m.positions))) if m.skin is None else m
            for m in asset.meshes
        )
        asset = replace(asset, meshes=tuple(meshes))
    assert not any(asset.origin)
    return replace(asset, rig=rig, origin=ZERO), rig


def choose_frames(rig: Rig, options: AnimationOptions) -> tuple[Frame, ...]:
    """The frames that options ask for: whole numbers from the first key of a clip to its last.
    Raises InputError if there are none."""
    first, stop, step = options.range()
    out: list[Frame] = []
    for clip in [rig.clip(name) for name in options.clips] or rig.clips:
        low = int(np.ceil(clip.start * rig.rate - 1e-3))
        high = int(np.floor(clip.end * rig.rate + 1e-3))
        wanted = range(low if first is None else first, high + 1 if stop is None else stop, step)
        numbers = [k for k in wanted if low <= k <= high]
        if not numbers:
            raise InputError(
                f"--frames {options.frames}: none of them is in clip '{clip.name}', which has "
                f"frames {low} to {high}"
            )
        out += [Frame(clip.name, k, k / rig.rate) for k in numbers]
    if options.frames is None and len(out) > MOST:
        chosen = np.unique(np.linspace(0, len(out) - 1, MOST).round().astype(int))
        out = [out[k] for k in chosen]
    return tuple(out)


def _matrices(rig: Rig, frames: tuple[Frame, ...]) -> NDArray[np.float64]:
    out = np.empty((len(frames), len(rig.bone_nodes), 4, 4))
    for clip in dict.fromkeys(f.clip for f in frames):
        members = [k for k, f in enumerate(frames) if f.clip == clip]
        out[members] = bone_matrices(rig, rig.clip(clip), [frames[k].time for k in members])
    return out


def _thinned(asset: Asset) -> list:
    """Meshes with some of their vertices and no faces: enough to know where they are."""
    step = max(sum(len(m.positions) for m in asset.meshes) // POINTS, 1)
    none = np.empty((0, 3), np.int32)
    return [m.take(np.arange(0, len(m.positions), step), none) for m in asset.meshes]


def _affine(p: Placement) -> NDArray[np.float64]:
    """(4, 4) from local coordinates to the world."""
    out = np.diag([p.scale] * 3 + [1.0])
    out[:3, 3] = p.centre
    return out


def _widened(skin: Skin, places: int) -> Skin:
    missing = ((0, 0), (0, places - skin.bones.shape[1]))
    return Skin(np.pad(skin.bones, missing), np.pad(skin.weights, missing))
