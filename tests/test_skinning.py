"""Linear blend skinning on the device, and its part of a latent."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.asset.rig import Skin
from appearance_opt.latent.parts import Pose
from appearance_opt.latent.skinning import (
    FLOOR,
    BoneFrames,
    SkinWeights,
    blend,
    prune,
    support_of,
)

V, B, F, K = 7, 5, 3, 4


@pytest.fixture(scope="module")
def problem() -> dict:
    rng = np.random.default_rng(0)
    weights = rng.random((V, K)).astype(np.float32)
    bones = np.stack([rng.permutation(B)[:K] for _ in range(V)])
    return {
        "positions": rng.normal(size=(V, 3)).astype(np.float32),
        "skin": Skin(bones.astype(np.int32), weights / weights.sum(axis=1, keepdims=True)),
        "matrices": rng.normal(size=(F, B, 4, 4)),
        "direction": rng.normal(size=(V, 3)),
    }


def plain(positions: np.ndarray, skin: Skin, matrices: np.ndarray) -> np.ndarray:
    """Vertex by vertex, in double precision."""
    out = np.zeros((len(positions), 3))
    for v, p in enumerate(positions):
        for bone, weight in zip(skin.bones[v], skin.weights[v], strict=True):
            out[v] += float(weight) * (matrices[bone, :3] @ [*p.astype(np.float64), 1.0])
    return out


def flat(values: np.ndarray) -> mi.Float:
    return mi.Float(np.ascontiguousarray(values, np.float32).ravel())


def test_vertices_are_where_the_bones_take_them(problem: dict) -> None:
    frames, skin = BoneFrames.of(problem["matrices"]), problem["skin"]
    support = mi.UInt32(skin.bones.astype(np.uint32).ravel())
    for f in range(F):
        found = blend(
            flat(problem["positions"]),
            flat(skin.weights),
            support,
            frames,
            dr.opaque(mi.UInt32, f),
        )
        expected = plain(problem["positions"], skin, problem["matrices"][f])
        np.testing.assert_allclose(np.array(found).reshape(-1, 3), expected, atol=2e-6)


def test_gradients_are_those_of_differences(problem: dict) -> None:
    """Of positions and stored logarithms, in double precision differences; float32 leaves 1e-4."""
    part = SkinWeights(problem["skin"], BoneFrames.of(problem["matrices"]), fitted=True)
    pose = Pose(0, dr.opaque(mi.UInt32, 1))
    matrices, direction = problem["matrices"][1], problem["direction"]
    positions = flat(problem["positions"])
    dr.enable_grad(positions)
    stored = part.parameter.value
    tracked = part.track(part.decode(stored))
    dr.backward(dr.sum(part.place(positions, tracked, pose) * flat(direction)))
    by_weight = np.array(part.pull_back(tracked, stored)).reshape(V, K)
    by_position = np.array(dr.grad(positions)).reshape(V, 3)

    def value(p: np.ndarray, logarithms: np.ndarray) -> float:
        shares = np.exp(logarithms)
        weights = shares / shares.sum(axis=1, keepdims=True)
        return float((plain(p, Skin(problem["skin"].bones, weights), matrices) * direction).sum())

    p0 = problem["positions"].astype(np.float64)
    l0 = np.array(stored, np.float64).reshape(V, K)
    for found, at in ((by_position, 0), (by_weight, 1)):
        truth = np.zeros(found.shape)
        for index in np.ndindex(*found.shape):
            for sign in (1, -1):
                moved = [p0.copy(), l0.copy()]
                moved[at][index] += sign * 1e-5
                truth[index] += sign * value(*moved) / 2e-5
        np.testing.assert_allclose(found, truth, atol=1e-4 * np.abs(truth).max())


def test_weights_are_of_sum_one_whatever_is_stored(problem: dict) -> None:
    part = SkinWeights(problem["skin"], BoneFrames.of(problem["matrices"]), fitted=True)
    part.parameter.value = mi.Float(np.random.default_rng(1).normal(0, 8, V * K).astype(np.float32))
    weights = part.skin().weights
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)


def test_a_pose_without_a_frame_is_the_bind_pose(problem: dict) -> None:
    part = SkinWeights(problem["skin"], BoneFrames.of(problem["matrices"]), fitted=False)
    positions = flat(problem["positions"])
    np.testing.assert_array_equal(
        np.array(part.place(positions, part.now(), Pose(0))), np.array(positions)
    )
    np.testing.assert_allclose(part.skin().weights, problem["skin"].weights, atol=1e-6)


def test_supports_hold_own_bones_first_and_then_those_of_neighbours() -> None:
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    skin = Skin(
        np.array([[0, 4], [1, 0], [2, 0], [3, 0]], np.int32),
        np.float32([[0.7, 0.3], [1, 0], [1, 0], [1, 0]]),
    )
    wide = support_of(skin, faces, 4)
    assert wide.bones[0, :2].tolist() == [0, 4] and {1, 2} == set(wide.bones[0, 2:].tolist())
    np.testing.assert_allclose(wide.weights[0], [0.7, 0.3, 0, 0], atol=1e-6)
    assert wide.bones[3, 0] == 3
    fitted = SkinWeights(wide, BoneFrames.of(np.tile(np.eye(4), (1, 5, 1, 1))), fitted=True)
    assert np.abs(fitted.skin().weights - wide.weights).max() < 3 * FLOOR


def test_pruning_keeps_the_largest() -> None:
    skin = Skin(np.array([[5, 6, 7, 8]], np.int32), np.float32([[0.1, 0.4, 0.2, 0.3]]))
    few = prune(skin, 2)
    assert few.bones.tolist() == [[6, 8]]
    np.testing.assert_allclose(few.weights, [[4 / 7, 3 / 7]], atol=1e-6)
    assert prune(skin, 9).bones.shape == (1, 4)


def test_many_frames_take_little_memory() -> None:
    """60 bones in 500 frames are 1.4 MB; nothing is as large as vertices times frames."""
    frames = BoneFrames.of(np.zeros((500, 60, 3, 4), np.float32))
    assert dr.width(frames.matrices) == 500 * 60 * 12


def test_no_kernel_propagates_nans(problem: dict) -> None:
    """LLVM before 17 aborts on what does (``render/math.py``)."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        test_gradients_are_those_of_differences(problem)
        kernels = [
            k["ir"].getvalue() for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT
        ]
    assert kernels
    assert not any("llvm.minimum" in k or "llvm.maximum" in k for k in kernels)
