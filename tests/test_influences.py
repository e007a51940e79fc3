"""Skinning weights from the closest point that faces the same way."""

from __future__ import annotations

import numpy as np
import trimesh

from appearance_opt.asset.rig import Skin
from appearance_opt.initial.influences import closest_points, transfer_influences


def test_closest_points_are_those_of_every_triangle() -> None:
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(2)
    points = rng.normal(size=(60, 3)) * rng.uniform(0.5, 2, (60, 1))
    toward = points / np.linalg.norm(points, axis=1, keepdims=True)
    triangle, where = closest_points(points, toward, ball.vertices, ball.faces)
    found = np.einsum("nk,nkc->nc", where, ball.vertices[ball.faces[triangle]])
    samples = np.concatenate(
        [
            np.einsum("k,fkc->fc", b, ball.vertices[ball.faces])
            for b in rng.dirichlet((1, 1, 1), 400)
        ]
    )
    for p, q in zip(points, found, strict=True):
        nearest = np.linalg.norm(samples - p, axis=1).min()
        assert np.linalg.norm(q - p) < nearest + 1e-6
    assert (where >= 0).all()
    np.testing.assert_allclose(where.sum(axis=1), 1, atol=1e-12)


def test_an_arm_beside_the_torso_keeps_its_weights() -> None:
    """Two slabs a millimetre apart; points of the arm's inner side lie nearer to the torso."""
    torso = trimesh.creation.box((0.4, 1, 0.2)).subdivide_to_size(0.1)
    arm = trimesh.creation.box((0.1, 1, 0.1)).subdivide_to_size(0.1)
    arm.apply_translation((0.251, 0, 0))
    positions = np.concatenate([torso.vertices, arm.vertices])
    faces = np.concatenate([torso.faces, arm.faces + len(torso.vertices)])
    of_arm = np.arange(len(positions)) >= len(torso.vertices)
    skin = Skin(of_arm[:, None].astype(np.int32), np.ones((len(positions), 1), np.float32))
    rng = np.random.default_rng(1)
    inner = np.stack(
        [np.full(40, 0.2004), rng.uniform(-0.45, 0.45, 40), rng.uniform(-0.04, 0.04, 40)], axis=1
    )  # nearer to the torso's side at 0.2 than to the arm's at 0.201
    facing = np.tile([-1.0, 0, 0], (40, 1))
    found = transfer_influences(inner, facing, positions, faces, skin, 2)
    assert (found.bones[:, 0] == 1).all() and (found.weights[:, 0] == 1).all()
    away = transfer_influences(inner, -facing, positions, faces, skin, 2)
    assert (away.bones[:, 0] == 0).all()


def test_weights_are_those_of_the_corners() -> None:
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    skin = Skin(
        np.array([[0, 2], [1, 2], [2, 0]], np.int32), np.float32([[0.5, 0.5], [1, 0], [1, 0]])
    )
    point, up = np.array([[0.25, 0.5, 0.1]]), np.array([[0.0, 0, 1]])
    found = transfer_influences(point, up, positions, np.array([[0, 1, 2]]), skin, 3)
    dense = np.zeros(3)
    dense[found.bones[0]] = found.weights[0]
    np.testing.assert_allclose(dense, [0.125, 0.25, 0.625], atol=1e-6)
