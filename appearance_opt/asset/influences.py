"""Skinning weights as files have them, and as they must be."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.rig import Skin
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

UNIT = 0.01
"""Distance of a sum of weights from one that is not worth a note: eight bits round that far."""


def repair_influences(
    joints: NDArray,
    weights: NDArray,
    count: int,
    name: str,
    source: str,
    note: Callable[[str], None],
) -> Skin:
    """The influences of a mesh on ``count`` joints, from (V, K) numbers of joints and weights.

    Weights that are negative or no numbers become 0, sums other than one are divided out, vertices
    without weights follow the first joint they name; notes count them. Raises InputError for joints
    that do not exist, and for arrays that do not fit.
    """
    if joints.shape != weights.shape or joints.ndim != 2 or not joints.shape[1]:
        raise InputError(
            f"{source}, mesh '{name}': {joints.shape} joints for {weights.shape} skinning weights; "
            "export it again"
        )
    w = np.asarray(weights, np.float64)
    wrong = ~(np.isfinite(w) & (w >= 0))
    if wrong.any():
        note(
            f"mesh '{name}': {int(wrong.any(axis=1).sum())} vertices have skinning weights that are "
            "negative or no numbers; these are set to 0"
        )
        w = np.where(wrong, 0.0, w)
    index = np.asarray(joints).astype(np.int64)
    total = w.sum(axis=1)
    empty = total <= 0
    outside = (index < 0) | (index >= count)
    lost = int((outside & (w > 0)).any(axis=1).sum() + (outside[:, 0] & empty).sum())
    if lost:
        raise InputError(
            f"{source}, mesh '{name}': {lost} vertices follow joints that do not exist "
            f"(there are {count}); export it again"
        )
    if empty.any():
        note(
            f"mesh '{name}': {int(empty.sum())} vertices without skinning weights follow the first "
            "joint that they name"
        )
        w = w.copy()
        w[empty, 0] = 1.0
        total = w.sum(axis=1)
    off = int((np.abs(total - 1) > UNIT).sum())
    if off:
        note(
            f"mesh '{name}': {off} vertices have skinning weights whose sum is not 1; divided by it"
        )
    index[outside] = 0
    index, w = _merged(index, w)
    return trim(Skin(index.astype(np.int32), (w / total[:, None]).astype(np.float32)))


def _merged(index: NDArray, weights: NDArray) -> tuple[NDArray, NDArray]:
    """The influences with the weights of each joint in one place, where a vertex names a joint
    several times."""
    order = np.argsort(np.where(weights > 0, index, -1), axis=1, kind="stable")
    joint, w = np.take_along_axis(index, order, 1), np.take_along_axis(weights, order, 1)
    again = (joint[:, 1:] == joint[:, :-1]) & (w[:, 1:] > 0) & (w[:, :-1] > 0)
    if not again.any():
        return index, weights
    for k in range(again.shape[1]):
        w[:, k + 1] += np.where(again[:, k], w[:, k], 0.0)
        w[:, k] = np.where(again[:, k], 0.0, w[:, k])
    return joint, w


def trim(skin: Skin) -> Skin:
    """The same without places that no vertex uses; those in use come first, by weight."""
    most = max(int((skin.weights > 0).sum(axis=1).max(initial=1)), 1)
    if most == skin.weights.shape[1]:
        return skin
    order = np.argsort(-skin.weights, axis=1, kind="stable")[:, :most]
    return Skin(
        np.take_along_axis(skin.bones, order, axis=1),
        np.take_along_axis(skin.weights, order, axis=1),
    )


def sparse(dense: NDArray, most: int) -> Skin:
    """The ``most`` largest weights of each row (V, B), of sum one."""
    most = max(min(most, dense.shape[1], int((dense > 0).sum(axis=1).max(initial=1))), 1)
    chosen = np.argsort(-dense, axis=1, kind="stable")[:, :most]
    weights = np.take_along_axis(dense, chosen, axis=1)
    weights = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-30)
    return Skin(chosen.astype(np.int32), weights.astype(np.float32))


def on_bone(bone: int, vertices: int) -> Skin:
    """That of a mesh which hangs rigidly on a bone."""
    return Skin(np.full((vertices, 1), bone, np.int32), np.ones((vertices, 1), np.float32))
