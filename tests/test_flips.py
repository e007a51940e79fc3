"""Flat regions end without slivers, and nothing else changes."""

from __future__ import annotations

import numpy as np
import pytest

from appearance_opt.asset.normals import unit
from appearance_opt.initial import quadrics
from appearance_opt.initial.decimate import decimate
from appearance_opt.initial.flips import POOR, flip_edges, quality


def qualities(p: np.ndarray, f: np.ndarray) -> np.ndarray:
    return quality(*(p[f[:, k]] for k in range(3)))


def flipped(
    p: np.ndarray, f: list, kind: list | None = None, original: list | None = None
) -> tuple[list, int]:
    """``original``: faces over the same vertices whose planes the quadrics stand for; none by
    default."""
    p, f = np.asarray(p, float), np.asarray(f)
    kind = np.zeros(len(f)) if kind is None else np.array(kind)
    q = np.zeros((len(p), quadrics.SIZE))
    for face in original or []:
        a, b, c = p[list(face)]
        q[list(face)] += quadrics.of_planes(unit(np.cross(b - a, c - a))[None], a[None], np.ones(1))
    faces, count = flip_edges(p, f, kind, q)
    return [tuple(np.roll(x, -int(np.argmin(x))).tolist()) for x in faces], count


def test_quality_of_known_triangles() -> None:
    a, b = np.array([(0.0, 0, 0)] * 4), np.array([(1.0, 0, 0)] * 4)
    c = np.array([(0.5, 0.75**0.5, 0), (0, 1, 0), (0.5, 0, 0), (0, 0, 0)])
    # a right angle between equal sides: 4 sqrt(3) / 2 / (1 + 1 + 2)
    np.testing.assert_allclose(quality(a, b, c), [1, 3**0.5 / 2, 0, 0], atol=1e-12)


KITE = [(-1.0, 0, 0), (1, 0, 0), (0, 0.1, 0), (0, -0.1, 0)]
"""Along its long diagonal it is two triangles of quality 0.09, along the short one two of 0.17."""


def test_the_better_diagonal_of_a_kite() -> None:
    assert flipped(KITE, [(0, 1, 2), (1, 0, 3)]) == ([(0, 3, 2), (1, 2, 3)], 1)
    assert flipped(KITE, [(0, 3, 2), (1, 2, 3)])[1] == 0


@pytest.mark.parametrize(
    "reason", ["folded", "kinds", "winding", "branched", "there already", "not convex"]
)
def test_what_is_no_flat_pair_stays(reason: str) -> None:
    p, f, kind = list(KITE), [(0, 1, 2), (1, 0, 3)], [0, 0]
    if reason == "folded":
        p[3] = (0, 0, -0.1)
    elif reason == "kinds":
        kind = [0, 1]
    elif reason == "winding":
        f[1] = (0, 1, 3)
    elif reason == "branched":
        p, f, kind = [*p, (0, 0, 1)], [*f, (0, 1, 4)], [0, 0, 0]
    elif reason == "there already":
        p, f, kind = [*p, (0, 0, 1)], [*f, (2, 3, 4)], [0, 0, 0]
    else:
        p[2:] = [(-0.9, 0.1, 0), (-1.2, -0.1, 0)]
    expected = [tuple(np.roll(x, -int(np.argmin(x))).tolist()) for x in f]
    assert flipped(p, f, kind) == (expected, 0)


def test_a_bend_stays() -> None:
    """The diagonals lie ``height`` apart, over an area of 0.2: a share of 0.001 for 0.0005, and
    0.01 for 0.005."""
    old = [(0, 1, 2), (1, 0, 3)]
    for height, count in [(0.0005, 1), (0.005, 0)]:
        p = [*KITE[:2], (0, 0.1, height), (0, -0.1, height)]
        assert flipped(p, old, original=old)[1] == count


@pytest.mark.parametrize(("height", "count"), [(0.005, 1), (0.03, 1), (0.1, 0)])
def test_an_edge_across_the_original_surface_is_flipped(height: float, count: int) -> None:
    """The original is bent along the other diagonal; the heights of the thinner triangles are 0.1
    and more."""
    p, other = [*KITE[:2], (0, 0.1, height), (0, -0.1, height)], [(0, 3, 2), (1, 2, 3)]
    assert flipped(p, [(0, 1, 2), (1, 0, 3)], original=other)[1] == count


def test_a_fan_over_a_strip_becomes_a_zigzag() -> None:
    """A strip of 12 x 1 squares whose triangles all reach to one of two opposite corners."""
    n = 12
    x = np.arange(n + 1)
    p = np.concatenate([np.stack([x, y + 0 * x, 0 * x], axis=1) for y in (0, 1)]).astype(float)
    low = [(k, k + 1, 2 * n + 1) for k in range(n)]
    high = [(0, n + 2 + k, n + 1 + k) for k in range(n)]
    f = np.array([*low, *high])
    g, count = flip_edges(p, f, np.zeros(len(f)), np.zeros((len(p), quadrics.SIZE)))
    assert (qualities(p, f) < 0.1).sum() >= 4
    assert count > 10
    assert qualities(p, g).min() > POOR
    # nothing is turned over, nothing lies twice
    cross = np.cross(p[g[:, 1]] - p[g[:, 0]], p[g[:, 2]] - p[g[:, 0]])[:, 2]
    assert cross.min() > 0
    assert cross.sum() / 2 == pytest.approx(n)
    edges = np.sort(g[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2


def test_a_flat_end_of_a_cylinder_has_no_slivers() -> None:
    """The cap of a turned piece as modellers make it: a fan over a rim of 200."""
    n, rings = 200, 40
    t = 2 * np.pi * np.arange(n) / n
    z = np.linspace(0, 4, rings)
    wall = np.stack([np.tile(np.cos(t), rings), np.tile(np.sin(t), rings), np.repeat(z, n)], axis=1)
    p = np.concatenate([wall, [(0, 0, 0), (0, 0, 4)]])
    i = np.arange(n)
    j = (i + 1) % n
    bands = [
        np.concatenate([np.stack([i, j, j + n], 1), np.stack([i, j + n, i + n], 1)]) + k * n
        for k in range(rings - 1)
    ]
    top = (rings - 1) * n
    caps = [
        np.stack([j, i, np.full(n, len(p) - 2)], 1),
        np.stack([i + top, j + top, np.full(n, len(p) - 1)], 1),
    ]
    q, g = decimate(p, np.concatenate([*bands, *caps]), 300)
    flat = np.ptp(q[g][:, :, 2], axis=1) < 1e-3
    assert flat.sum() > 20
    assert (qualities(q, g[flat]) < 0.1).sum() == 0
