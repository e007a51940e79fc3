"""Charts, their places in the atlas, and how texels are shared among them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from appearance_opt.baking.texel_points import TexelPoints, texel_coverage
from appearance_opt.initial.atlas import charts_of, make_charts, pack_charts, unwrap, uv_areas
from appearance_opt.initial.density import LARGEST, SMALLEST, chart_scales, halve
from appearance_opt.initial.sphere import sphere
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.views import ViewSampler

SIZE = 256
BALL = sphere(2000, (0.0, 0.0, 0.0), 1.0, SIZE)


def areas(mesh: LatentMesh) -> NDArray[np.float64]:
    a, b, c = (mesh.positions.astype(np.float64)[mesh.faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def test_charts_are_as_large_as_what_they_stand_for() -> None:
    charts = make_charts(5 * BALL.positions + 3, BALL.faces)
    np.testing.assert_array_equal(charts.frame_vertex[charts.frame_faces], BALL.faces)
    # in units of the box's longest side, which is 2 of the ball's radii; charts of a sphere are
    # stretched a little
    assert uv_areas(charts).sum() == pytest.approx(areas(BALL).sum() / 4, rel=0.1)
    label = charts_of(charts)
    assert label.min() == 0 and label.max() == len(np.unique(label)) - 1
    # faces of one chart hang together by their render vertices, and share none with another chart
    owner = np.full(len(charts.uvs), -1)
    for face, chart in zip(charts.frame_faces, label, strict=True):
        assert set(owner[face]) <= {-1, chart}
        owner[face] = chart


@pytest.mark.parametrize("tight", [False, True])
def test_scaled_charts_get_more_texels_and_do_not_overlap(tight: bool) -> None:
    charts = make_charts(BALL.positions, BALL.faces)
    label = charts_of(charts)
    large = label % 2 == 0
    even = pack_charts(charts, np.ones(len(label)), SIZE, tight=tight)
    mesh = pack_charts(charts, np.where(large, 2.0, 1.0), SIZE, tight=tight)
    np.testing.assert_array_equal(mesh.frame_vertex[mesh.frame_faces], BALL.faces)
    assert mesh.uvs.min() >= 0 and mesh.uvs.max() <= 1
    gain = uv_areas(mesh) / uv_areas(even)
    # charts are rounded to whole texels: within 2 percent of four times the area here
    assert np.median(gain[large]) == pytest.approx(4 * np.median(gain[~large]), rel=0.1)
    # measured 1 percent: what overlapped would be covered once and counted twice
    assert texel_coverage(mesh, SIZE).mean() == pytest.approx(uv_areas(mesh).sum(), rel=0.05)


@pytest.mark.parametrize("gutter", [4, 8])
@pytest.mark.parametrize("tight", [False, True])
def test_charts_are_as_far_apart_as_they_are_meant_to_be(gutter: int, tight: bool) -> None:
    charts = make_charts(BALL.positions, BALL.faces)
    mesh = pack_charts(charts, np.ones(len(BALL.faces)), SIZE, gutter, tight)
    points = TexelPoints(mesh, SIZE).band(0, 0.5, 0.5)
    assert points is not None
    chart = np.full(SIZE * SIZE, -1)
    chart[np.array(points.texel)] = charts_of(mesh)[np.array(points.triangle)]
    chart = chart.reshape(SIZE, SIZE)
    # texels between the nearest texels of any two charts, along rows or columns and diagonally
    far = SIZE * SIZE
    largest = [ndimage.maximum_filter(chart, 2 * k + 1) for k in range(gutter + 4)]
    smallest = [
        ndimage.minimum_filter(np.where(chart < 0, far, chart), 2 * k + 1)
        for k in range(gutter + 4)
    ]
    meets = [((a >= 0) & (a != b)).any() for a, b in zip(largest, smallest, strict=True)]
    # a square of 2 k + 1 texels that touches two charts spans at most 2 k - 1 between them
    nearest = 2 * meets.index(True) - 1
    assert gutter <= nearest <= gutter + 3


def test_gutters_yield_where_charts_do_not_fit() -> None:
    rng = np.random.default_rng(0)
    corners = np.repeat(rng.normal(size=(500, 3)), 3, axis=0) + 0.01 * rng.normal(size=(1500, 3))
    mesh = unwrap(corners.astype(np.float32), np.arange(1500, dtype=np.int32).reshape(-1, 3), 16)
    assert charts_of(mesh).max() == 499
    assert mesh.uvs.min() >= 0 and mesh.uvs.max() <= 1
    # nothing vanishes: sixteen texels a side hold 500 triangles of a texel's size at most
    assert uv_areas(mesh).sum() > 0.005


def half_noisy(mesh: LatentMesh) -> dict[str, NDArray[np.float32]]:
    """Grey, with noise in every texel where x > 0."""
    points = TexelPoints(mesh, SIZE).band(0, 0.5, 0.5)
    assert points is not None
    noisy = np.array(points.texel)[np.array(points.here.position)[0] > 0]
    value = np.full(SIZE * SIZE, 0.5, np.float32)
    value[noisy] = np.random.default_rng(0).random(len(noisy))
    constant = {
        "roughness": 0.5,
        "metalness": 0.0,
        "normal_x": 0.0,
        "normal_y": 0.0,
        "normal_z": 1.0,
    }
    flat = {name: np.full((SIZE, SIZE), v, np.float32) for name, v in constant.items()}
    return {**dict.fromkeys(("red", "green", "blue"), value.reshape(SIZE, SIZE)), **flat}


def test_texels_go_where_they_are_seen_to_be_missing() -> None:
    sampler = ViewSampler((0.0, 0.0, 0.0), 1.0)
    maps = half_noisy(BALL)
    scale = chart_scales(BALL, maps, sampler)
    assert scale.min() >= SMALLEST and scale.max() <= LARGEST
    label, x = charts_of(BALL), BALL.positions[BALL.faces].mean(axis=1)[:, 0]
    for chart in range(label.max() + 1):
        assert np.ptp(scale[label == chart]) == 0
    # charts that lie on one side alone
    left, right = (
        [c for c in range(label.max() + 1) if (s * x[label == c] > 0).all()] for s in (-1, 1)
    )
    assert left and right
    least = min(scale[label == c][0] for c in right)
    assert least > 2 * max(scale[label == c][0] for c in left)
    # the same everywhere: no chart needs more than another
    plain = {
        **maps,
        **{n: np.full((SIZE, SIZE), 0.5, np.float32) for n in ("red", "green", "blue")},
    }
    np.testing.assert_array_equal(chart_scales(BALL, plain, sampler), 1.0)


def test_half_resolution_keeps_what_is_smooth() -> None:
    ramp = np.add.outer(np.arange(8.0), 2 * np.arange(12.0)).astype(np.float32)
    np.testing.assert_allclose(halve(ramp)[1:-1, 1:-1], ramp[1:-1, 1:-1], atol=1e-5)
    checks = (np.indices((8, 12)).sum(axis=0) % 2).astype(np.float32)
    np.testing.assert_allclose(halve(checks), 0.5, atol=1e-6)
