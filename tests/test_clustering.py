"""The coarse round of meshes far finer than what is asked for, and when it is taken."""

from __future__ import annotations

import numpy as np

from appearance_opt.initial.clustering import cluster
from appearance_opt.initial.decimation import LEAST_CLUSTERS, is_coarse
from tests.conftest import grid_sphere


def grid(n: int) -> tuple[np.ndarray, np.ndarray]:
    """The unit square of the plane z = 0, ``n`` cells a side."""
    y, x = np.mgrid[0 : n + 1, 0 : n + 1] / n
    p = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    quads = np.stack([a, a + 1, a + n + 2, a + n + 1], axis=1)
    return p, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def box(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A unit cube of six grids."""
    p, f = grid(n)
    sides = [p, p[:, [1, 0, 2]] + [0, 0, 1]]
    points, faces = [], []
    for turn in range(3):
        for side in sides:
            points.append(np.roll(side, turn, axis=1))
            faces.append(f[:, ::-1] + len(p) * len(faces))  # outward: the second side is mirrored
    return np.concatenate(points), np.concatenate(faces)


def normals(p: np.ndarray, f: np.ndarray) -> np.ndarray:
    return np.cross(p[f[:, 1]] - p[f[:, 0]], p[f[:, 2]] - p[f[:, 0]])


def test_flat_and_round_surfaces_stay_where_they_are() -> None:
    p, f, source = cluster(*grid(120), 400)
    assert 100 < len(p) < 800
    assert np.abs(p[:, 2]).max() < 1e-12
    assert (normals(p, f)[:, 2] > 0).mean() > 0.99  # a cell's vertex may lie beyond its neighbour's
    assert len(source) == len(f) and (np.diff(source) > 0).all()
    sphere, faces, _ = grid_sphere(100, 200)
    p, f, _ = cluster(sphere, faces, 2000)
    assert 500 < len(p) < 4000
    assert np.abs(np.linalg.norm(p, axis=1) - 1).max() < 0.01
    assert (np.sum(normals(p, f) * p[f].mean(axis=1), axis=1) > 0).mean() > 0.99


def test_sharp_edges_are_kept_to_a_part_of_a_cell() -> None:
    p = cluster(*box(80), 1500)[0]
    cell = (1.5 * 6 / 1500) ** 0.5
    outside = np.abs(p - 0.5).max(axis=1) - 0.5
    assert np.abs(outside).max() < 0.1 * cell  # every vertex lies on the cube
    corner = np.abs(np.abs(p - 0.5) - 0.5).max(axis=1)
    assert np.sort(corner)[:8].max() < 0.1 * cell  # and its corners are there


def test_both_sides_of_a_sheet_are_kept_and_copies_are_one() -> None:
    p, f = grid(60)
    both = np.concatenate([f, f[:, ::-1]])
    _, faces, source = cluster(p, both, 200)
    front, back = source < len(f), source >= len(f)
    assert front.sum() == back.sum() == len(faces) / 2
    _, twice, _ = cluster(p, np.concatenate([f, f]), 200)
    assert len(twice) == front.sum()


def test_coarse_meshes_do_not_change_and_tiny_ones_do_not_fail() -> None:
    p, f = grid(3)
    q, g, source = cluster(p, f, 10_000)
    np.testing.assert_allclose(np.sort(q, axis=0), np.sort(p, axis=0), atol=1e-12)
    assert len(g) == len(f) == len(source)
    one, _, _ = cluster(np.zeros((3, 3)), np.array([[0, 1, 2]]), 10)
    assert len(one) == 0  # all at one place


def test_only_large_meshes_under_a_short_budget_begin_coarsely() -> None:
    assert is_coarse(4_000_000, 2_000_000, LEAST_CLUSTERS, 19)
    assert not is_coarse(4_000_000, 2_000_000, LEAST_CLUSTERS, None)
    assert not is_coarse(400_000, 200_000, LEAST_CLUSTERS, 65)
    assert not is_coarse(4_000_000, 2_000_000, 1_500_000, 19)
