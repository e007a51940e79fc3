"""A rigged asset at the frames of an animation, and the pool of their images."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.posing import pose_mesh
from appearance_opt.reference.mesh import MeshReference, completed
from appearance_opt.reference.pool import ReferencePool

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset, Mesh
    from appearance_opt.reference.base import Reference
    from appearance_opt.views import Sampler

KEPT_TRIANGLES = 2_000_000
"""Triangles of posed meshes that are kept on the device, with their BVHs; at least one mesh is."""


class AnimatedReference:
    """``bind``: the asset in its bind pose; ``at``: what draws it at a frame. ``matrices`` (T, B, 4,
    4): from the coordinates of the asset, whose meshes all have skins, to those of each frame."""

    def __init__(self, asset: Asset, matrices: NDArray) -> None:
        mapped = any(m.material.normal_texture is not None for m in asset.meshes)
        self._asset = replace(asset, meshes=tuple(completed(asset.meshes, mapped)))
        self._matrices = matrices
        self.bind = MeshReference(self._asset)
        self._kept: OrderedDict[int, MeshReference] = OrderedDict()
        self._most = max(KEPT_TRIANGLES // max(asset.triangle_count, 1), 1)

    @property
    def completed(self) -> tuple[Mesh, ...]:
        """The meshes of the bind pose, whose vertices are those of ``bind``."""
        return self._asset.meshes

    @property
    def frames(self) -> int:
        """T."""
        return len(self._matrices)

    def at(self, frame: int) -> MeshReference:
        """The asset as it stands at a frame; the last ones that were asked for are kept."""
        if frame not in self._kept:
            while len(self._kept) >= self._most:
                self._kept.popitem(last=False)
            self._kept[frame] = self.bind.moved(self.posed(frame))
        self._kept.move_to_end(frame)
        return self._kept[frame]

    def posed(self, frame: int) -> Asset:
        """The same as meshes, in the coordinates of the frame."""
        posed = (pose_mesh(m, self._matrices[frame]) for m in self._asset.meshes)
        return replace(self._asset, meshes=tuple(posed), rig=None)


@dataclass
class FramePool(ReferencePool):
    """A pool of images of an animation: a batch shows one frame, and draws take whole batches.
    Frames follow in an order that is drawn anew for each round through all of them. ``animated``
    draws them, ``samplers``: views of each."""

    animated: AnimatedReference = field(kw_only=True)
    samplers: tuple[Sampler, ...] = field(kw_only=True)

    def _chosen(self, rng: np.random.Generator, oldest: int, newest: int) -> NDArray[np.int64]:
        group = int(rng.integers(oldest, newest + 1))
        return group * self.batch + np.arange(self.batch)

    def _frame_of(self, group: int) -> int:
        round_, place = divmod(group, len(self.samplers))
        rng = np.random.default_rng([self.sampler.seed, self.sampler.stream, round_, 2])
        return int(rng.permutation(len(self.samplers))[place])

    def _source(self, group: int) -> tuple[Reference, Sampler]:
        frame = self._frame_of(group)
        return self.animated.at(frame), self.samplers[frame]
