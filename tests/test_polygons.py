"""Polygons become triangles that cover them, whatever their shape and winding."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appearance_opt.asset import load
from appearance_opt.asset.polygons import Polygons, triangulate

ARROW = [(0, 0), (2, 0), (2, 2), (1, 0.5), (0, 2)]
"""Its fan from the first corner leaves it between the third and the last."""


def vector_areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    p = points[triangles]
    return np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]) / 2


def in_space(flat: np.ndarray, seed: int) -> np.ndarray:
    """(N, 2) points on a plane in space, turned at random."""
    turned, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return np.concatenate([flat, np.zeros((len(flat), 1))], axis=1) @ turned + 5


def test_convex_polygons_become_fans() -> None:
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0)], np.float64)
    polygons = Polygons(np.array([4, 3, 2]), np.array([0, 1, 2, 3, 1, 4, 2, 0, 1]))
    triangles, face = triangulate(polygons, points)
    np.testing.assert_array_equal(triangles, [[0, 1, 2], [0, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(face, [0, 0, 1])


@settings(max_examples=60)
@given(
    corners=st.integers(4, 12),
    seed=st.integers(0, 2**16),
    first=st.integers(0, 11),
    backward=st.booleans(),
)
def test_star_shaped_polygons_are_covered_once(
    corners: int, seed: int, first: int, backward: bool
) -> None:
    """Around a point that sees all of them, radii that differ by a factor of ten: mostly not
    convex."""
    random = np.random.default_rng(seed)
    angle = (np.arange(corners) + random.uniform(0, 0.8, corners)) * (2 * np.pi / corners)
    radius = random.uniform(0.1, 1, corners)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    ring = np.roll(ring[::-1] if backward else ring, first, axis=0)
    points = in_space(ring, seed)
    triangles, face = triangulate(Polygons(np.array([corners]), np.arange(corners)), points)
    areas = vector_areas(points, triangles)
    after = np.roll(points, -1, axis=0)
    whole = np.cross(points - points[0], after - points[0]).sum(axis=0) / 2
    assert len(triangles) == corners - 2
    assert not face.any()
    # all turn the way of the polygon, so that areas which add up to its own cannot overlap
    assert (areas @ whole > -1e-12).all()
    np.testing.assert_allclose(areas.sum(axis=0), whole, atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.norm(areas, axis=1).sum(), np.linalg.norm(whole), rtol=1e-9
    )


def test_faces_keep_their_order_where_only_some_are_cut() -> None:
    points = in_space(np.array([*ARROW, (3, 0), (3, 3)], np.float64), 1)
    polygons = Polygons(np.array([3, 5, 3]), np.array([1, 5, 2, 0, 1, 2, 3, 4, 5, 6, 2]))
    triangles, face = triangulate(polygons, points)
    np.testing.assert_array_equal(face, [0, 1, 1, 1, 2])
    assert set(triangles[1:4].ravel()) == {3, 4, 5, 6, 7}


@pytest.mark.parametrize("suffix", ["obj", "usda"])
def test_files_with_polygons_that_are_not_convex(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"arrow.{suffix}"
    points = [(x, y, 0) for x, y in ARROW]
    if suffix == "obj":
        path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in points) + "f 1 2 3 4 5\n")
    else:
        path.write_text(
            '#usda 1.0\n(metersPerUnit = 1\nupAxis = "Y")\ndef Mesh "arrow"\n{\nint[] faceVertexCounts = [5]\n'
            f"int[] faceVertexIndices = [0, 1, 2, 3, 4]\npoint3f[] points = {points}\n"
            'uniform token subdivisionScheme = "none"\n}\n'
        )
    mesh = load(path).meshes[0]
    areas = vector_areas(mesh.positions, mesh.faces)
    assert (areas[:, 2] > 0).all()
    assert areas[:, 2].sum() == pytest.approx(2.5)
