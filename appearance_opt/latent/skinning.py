"""Linear blend skinning: vertices follow bones, by weights that are fitted with them.

A vertex v of a frame is at sum_b w_b M_b v (Hasselgren et al. 2021, eq. 2), where M_b is what the
frame does to bone b, a constant. Of all bones each vertex has a support of K, chosen once: with 60
bones and 5,000 vertices the dense sum takes 50 times as long as one over 8. Normals and tangents
are made of the posed positions (``mesh_ops``), as those of every latent; the inverse transpose of
the blended matrices would be the normals of another surface.

What is stored are logarithms l of shares; w = exp(l) / sum(exp(l)) is not negative and of sum one by
construction, and small weights stay small under noise. Of three such maps it came nearest to known
weights in the same number of steps (docs/trials.md: skinning).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.asset.rig import Skin
from appearance_opt.latent.parameter import Parameter
from appearance_opt.latent.parts import Part

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.latent.parameter import Rates
    from appearance_opt.latent.parts import Pose

WEIGHTS = "weights"
"""Name of the part."""

FLOOR = 1e-3  # docs/trials.md: skinning
"""Weight that a bone of the support starts from which has none: enough for a gradient, and too
little to be seen."""

REACH = 20.0
"""Largest logarithm of a share: its exponential is a number, and nothing near it means anything."""


@dataclass(frozen=True, eq=False)
class BoneFrames:
    """``bones`` of each of some frames, flat on the device: for frame f and bone b the rows of the
    (3, 4) matrix that brings the coordinates of the bind pose to those of the frame, 12 floats from
    12 (f ``bones`` + b) on."""

    matrices: mi.Float
    bones: int

    @classmethod
    def of(cls, matrices: NDArray) -> BoneFrames:
        """From (F, B, 3, 4) or (F, B, 4, 4) matrices."""
        rows = np.ascontiguousarray(matrices[:, :, :3], np.float32)
        return cls(mi.Float(rows.ravel()), rows.shape[1])

    @property
    def count(self) -> int:
        """Frames."""
        return dr.width(self.matrices) // (12 * self.bones)


def softmax(logarithms: mi.Float, places: int) -> mi.Float:
    """Weights (V K) of sum one of the logarithms of shares (V K); K = ``places``."""
    shares = dr.exp(logarithms)
    return shares / _for_each(dr.block_sum(shares, places), places)


def _for_each(of_vertices: mi.Float, places: int) -> mi.Float:
    """(V K) the value of its vertex (V) for each place."""
    width = dr.width(of_vertices) * places
    return dr.gather(mi.Float, of_vertices, dr.arange(mi.UInt32, width) // places)


def blend(
    vertices: mi.Float,
    weights: mi.Float,
    support: mi.UInt32,
    frames: BoneFrames,
    frame: mi.UInt32,
) -> mi.Float:
    """Flat positions (3 V) of a frame, differentiable in ``vertices`` (3 V) and ``weights`` (V K).
    ``support`` (V K): the bones of the weights; ``frame``: opaque, width 1."""
    count = dr.width(vertices) // 3
    places = dr.width(weights) // count
    index = dr.arange(mi.UInt32, dr.width(weights))
    p = dr.gather(mi.Point3f, vertices, index // places)
    row = 3 * (frame * frames.bones + dr.gather(mi.UInt32, support, index))
    weight = dr.gather(mi.Float, weights, index)
    moved = []
    for axis in range(3):
        shape = (4, dr.width(weights))
        m = dr.gather(mi.ArrayXf, frames.matrices, row + axis, shape=shape)
        place = dr.fma(m[0], p.x, dr.fma(m[1], p.y, dr.fma(m[2], p.z, m[3])))
        moved.append(dr.block_sum(weight * place, places))
    return dr.ravel(mi.Point3f(*moved))


class SkinWeights(Part):
    """Weights of the vertices of a mesh on the bones that move it, and what these do in each frame.
    At a pose without a frame the mesh is in its bind pose.

    ``skin``: of the mesh's vertices; its bones are their supports. Fitted, places with weight 0
    start from ``FLOOR``: ``support_of`` adds some.
    """

    places = True

    def __init__(self, skin: Skin, frames: BoneFrames, fitted: bool) -> None:
        logarithms = np.log(np.fmax(skin.weights, FLOOR if fitted else 1e-8))
        stored = mi.Float(np.ascontiguousarray(logarithms, np.float32).ravel())
        low, high = mi.Float(-REACH), mi.Float(REACH)
        parameter = Parameter(WEIGHTS, stored, 1, mi.Float(0), low, high) if fitted else None
        self._bones, self._frames = skin.bones, frames
        self._support = mi.UInt32(np.ascontiguousarray(skin.bones, np.uint32).ravel())
        self._places = skin.bones.shape[1]
        super().__init__(WEIGHTS, parameter, None if fitted else self.decode(stored))

    def decode(self, stored: mi.Float) -> mi.Float:
        return softmax(stored, self._places)

    def track(self, decoded: mi.Float) -> mi.Float:
        weights = mi.Float(decoded)
        dr.enable_grad(weights)
        return weights

    def pull_back(self, tracked: mi.Float, stored: mi.Float) -> mi.Float:
        weights, gradient = self.decode(stored), dr.grad(tracked)
        mean = dr.block_sum(weights * gradient, self._places)
        return weights * (gradient - _for_each(mean, self._places))

    def place(self, vertices: mi.Float, decoded: mi.Float, pose: Pose) -> mi.Float:
        if pose.frame is None:
            return vertices
        return blend(vertices, decoded, self._support, self._frames, pose.frame)

    def fixed(self) -> tuple:
        return (self.constant, self._support, self._frames.matrices)

    def set_rates(self, rates: Rates) -> None:
        assert self.parameter is not None
        self.parameter.rate = mi.Float(rates.weight)

    def export(self) -> dict[str, NDArray[np.float32]]:
        return {WEIGHTS: np.array(self.now()).reshape(-1, self._places)}

    def skin(self) -> Skin:
        """The weights as they are now."""
        return Skin(self._bones, self.export()[WEIGHTS])


def support_of(skin: Skin, faces: NDArray, places: int) -> Skin:
    """A skin whose vertices have ``places`` bones each: their own by weight, then those that their
    neighbours have, with weight 0, for a fit to choose from. ``faces`` (F, 3)."""
    count = len(skin.bones)
    bones = int(skin.bones.max(initial=0)) + 1
    own = _dense(skin, bones)
    around = own.copy()
    for _ in range(2):
        spread = np.zeros_like(around)
        for a, b in ((0, 1), (1, 2), (2, 0)):
            np.add.at(spread, faces[:, a], around[faces[:, b]])
            np.add.at(spread, faces[:, b], around[faces[:, a]])
        around = spread / np.maximum(spread.sum(axis=1, keepdims=True), 1e-30)
    # own weights first, however small; then the neighbours'
    order = np.argsort(-(np.where(own > 0, 2 + own, 0) + around), axis=1, kind="stable")
    chosen = order[:, : min(places, bones)]
    weights = np.take_along_axis(own, chosen, axis=1)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-30)
    assert len(chosen) == count
    return Skin(chosen.astype(np.int32), weights.astype(np.float32))


def prune(skin: Skin, influences: int) -> Skin:
    """At most ``influences`` weights per vertex, the largest, of sum one."""
    kept = min(influences, skin.bones.shape[1])
    order = np.argsort(-skin.weights, axis=1, kind="stable")[:, :kept]
    bones = np.take_along_axis(skin.bones, order, axis=1)
    weights = np.take_along_axis(skin.weights, order, axis=1)
    total = weights.sum(axis=1, keepdims=True)
    return Skin(bones, (weights / np.maximum(total, 1e-30)).astype(np.float32))


def _dense(skin: Skin, bones: int) -> NDArray[np.float32]:
    out = np.zeros((len(skin.bones), bones), np.float32)
    rows = np.repeat(np.arange(len(out)), skin.bones.shape[1])
    np.add.at(out, (rows, skin.bones.ravel()), skin.weights.ravel())
    return out
