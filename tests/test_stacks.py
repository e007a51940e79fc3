"""Faces that lie on others go first; edges of many faces collapse like others."""

from __future__ import annotations

import numpy as np
import pytest

from appearance_opt.initial.decimate import decimate, decimate_with_source
from appearance_opt.initial.stacks import without_stacks
from appearance_opt.initial.visibility import importance


def plate(n: int) -> tuple[np.ndarray, np.ndarray]:
    """The square |x|, |y| < 0.5 at z = 0 as (n + 1)^2 vertices, facing up."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, n + 1), np.linspace(-0.5, 0.5, n + 1))
    p = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    f = np.concatenate([np.stack([i, i + 1, i + n + 2], 1), np.stack([i, i + n + 2, i + n + 1], 1)])
    return p, f


def area(p: np.ndarray, f: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.cross(p[f[:, 1]] - p[f[:, 0]], p[f[:, 2]] - p[f[:, 0]]), axis=1) / 2


def quality(p: np.ndarray, f: np.ndarray) -> np.ndarray:
    squared = sum(np.sum((p[f[:, k]] - p[f[:, k - 1]]) ** 2, axis=1) for k in range(3))
    return 4 * 3**0.5 * area(p, f) / squared


def kept(p: np.ndarray, f: np.ndarray, single: list[int] | None = None) -> list[int]:
    sides = np.zeros(len(f), bool)
    sides[single or []] = True
    return without_stacks(p, f, np.ones(len(f)), sides)[0].tolist()


@pytest.mark.parametrize(
    ("faces", "single", "expected"),
    [
        # the same face from any corner, and from behind: the first one shows both sides
        ([(0, 1, 2), (1, 2, 0), (2, 1, 0)], [], [0]),
        ([(0, 1, 2), (1, 2, 0), (2, 1, 0)], [0, 1, 2], [0, 2]),
        ([(0, 1, 2), (2, 1, 0), (1, 0, 2)], [0, 1, 2], [0, 1]),
        # what shows one side does not hide what shows both; what shows both hides all that follows
        ([(0, 1, 2), (1, 2, 0), (2, 1, 0)], [0, 2], [0, 1]),
        ([(0, 1, 2), (1, 2, 0), (2, 1, 0)], [1, 2], [0]),
        # two corners in common are no copy
        ([(0, 1, 2), (0, 1, 3), (1, 2, 3)], [], [0, 1, 2]),
    ],
)
def test_of_coincident_faces_one_stays_per_side(
    faces: list[tuple[int, int, int]], single: list[int], expected: list[int]
) -> None:
    p = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
    assert kept(p, np.array(faces), single) == expected


def test_a_face_that_stays_has_the_largest_weight_of_its_copies() -> None:
    p = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
    f = np.array([(0, 1, 2), (0, 3, 1), (1, 2, 0), (2, 1, 0)])
    index, weight, _ = without_stacks(p, f, np.array([0.1, 0.2, 0.7, 0.4]), np.zeros(4, bool))
    assert index.tolist() == [0, 1]
    assert weight.tolist() == [0.7, 0.2]


def with_fin(tip: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A plate of 8 x 8 squares with a triangle between ``tip`` and an edge from (0, 0) to (0.125,
    0)."""
    p, f = plate(8)
    a, b = 4 * 9 + 4, 4 * 9 + 5
    assert np.allclose(p[[a, b]], [(0, 0, 0), (0.125, 0, 0)])
    return np.concatenate([p, [tip]]), np.concatenate([f, [(a, b, len(p))]])


def test_fins_go_where_they_lie_on_the_surface() -> None:
    p, f = with_fin((0.2, 0.35, 0.0))
    assert kept(p, f) == list(range(len(f) - 1))
    # one that reaches beyond the plate, one that stands on it, and one just above it
    for tip in [(0.2, 0.55, 0.0), (0.2, 0.35, 0.3), (0.2, 0.35, 0.001)]:
        p, f = with_fin(tip)
        assert len(kept(p, f)) == len(f)


def test_fins_show_their_sides() -> None:
    p, f = with_fin((0.2, 0.35, 0.0))
    fin, plain = len(f) - 1, list(range(len(f) - 1))
    everything = [*plain, fin]
    assert kept(p, f, single=everything) == plain
    flipped = np.concatenate([f[:-1], f[-1:, ::-1]])
    # its back is that of the plate, or nobody sees its front
    assert kept(p, flipped) == plain
    assert kept(p, flipped, single=everything) == everything
    # the plate does not show the back that a double-sided fin shows
    assert kept(p, f, single=plain) == everything


def test_a_square_that_is_divided_both_ways_is_there_once() -> None:
    p, f = plate(4)
    square = f[(f == 12).any(axis=1)][:1]
    a, b, c = square[0]
    d = next(v for v in f[np.isin(f, [a, c]).sum(axis=1) == 2].ravel() if v not in (a, b, c))
    again = np.array([(a, b, d), (b, c, d)])
    n = len(f)
    assert len(kept(p, np.concatenate([f, again]))) == n
    assert len(kept(p, np.concatenate([again, f]))) == n


def stacked_plate(fans: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, int]:
    """A plate with flaps (two triangles over the same corners, of opposite sense) in its plane, 1
    to 9 at an edge. The number of its own faces comes last."""
    rng = np.random.default_rng(seed)
    p, f = plate(20)
    points, faces = [*p], [*f]
    inner = [k for k in range(len(p)) if np.abs(p[k] + (0, 0.025, 0)).max() < 0.35]
    for i in rng.choice(inner, fans, replace=False):
        j = i + 1
        for n in range(rng.integers(1, 10)):
            points.append((p[i] + p[j]) / 2 + (0.0, 0.06 + 0.004 * n, 0.0))
            tip = len(points) - 1
            faces += [(i, j, tip), (j, i, tip)]
    return np.array(points), np.array(faces), len(f)


@pytest.mark.parametrize("budget", [8, 40])
def test_stacks_take_nothing_of_the_budget(budget: int) -> None:
    p, f, own = stacked_plate(30)
    q, g, source = decimate_with_source(p, f, budget)
    expected, h = decimate(p, f[:own], budget)
    np.testing.assert_array_equal(g, h)
    np.testing.assert_allclose(q, expected)
    assert source.max() < own


def test_a_wall_on_a_floor_and_crossing_walls_collapse() -> None:
    """Three plates through one another share the edges where they meet: four faces at each."""
    p, f = plate(12)
    points = np.concatenate([p, p[:, [2, 0, 1]], p[:, [1, 2, 0]]])
    faces = np.concatenate([f + k * len(p) for k in range(3)])
    q, g = decimate(points, faces, 24)
    # two triangles in each quarter of each plate
    assert len(g) == 24
    for axis in range(3):
        here = (np.abs(q[g][:, :, axis]) < 0.02).all(axis=1)
        assert area(q, g[here]).sum() == pytest.approx(1.0, abs=0.02)


def test_an_edge_of_many_faces_collapses_with_them() -> None:
    """The pages of a book, of 8 x 8 squares each."""
    p, f = plate(8)
    p = p + (0.5, 0, 0)
    turns = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    pages = [np.stack([p[:, 0] * np.cos(t), p[:, 1], p[:, 0] * np.sin(t)], axis=1) for t in turns]
    q, g = decimate(np.concatenate(pages), np.concatenate([f + k * len(p) for k in range(20)]), 80)
    assert 60 < len(g) <= 80
    assert area(q, g).sum() == pytest.approx(20.0, rel=0.03)


def test_two_sides_of_a_sheet_collapse_together() -> None:
    p, f = plate(20)
    both = np.concatenate([f, f[:, ::-1]])
    q, g, source = decimate_with_source(p, both, 16, single_sided=np.ones(len(both), bool))
    assert 8 <= len(g) <= 16
    normal = np.cross(q[g[:, 1]] - q[g[:, 0]], q[g[:, 2]] - q[g[:, 0]])[:, 2] / 2
    assert normal[normal > 0].sum() == pytest.approx(1.0, abs=0.01)
    assert normal[normal < 0].sum() == pytest.approx(-1.0, abs=0.01)
    # each face comes from one of its own side
    np.testing.assert_array_equal(source < len(f), normal > 0)


def test_copies_share_their_pixels_and_count_as_one() -> None:
    """Which of two coincident faces a ray finds is chance; what both are worth is not."""
    p, f = plate(6)
    rng = np.random.default_rng(0)
    counts = rng.integers(100, 200, len(f))
    alone, _ = importance(p, f, counts)
    first = rng.integers(0, 100, len(f))
    twice, visible = importance(
        p, np.concatenate([f, f[:, [1, 2, 0]]]), np.concatenate([first, counts - first])
    )
    np.testing.assert_allclose(twice, np.concatenate([alone, alone]), rtol=5e-3)
    assert visible.all()
