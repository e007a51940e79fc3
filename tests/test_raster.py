"""Triangles drawn onto pixels against rays through the same scene, and where rays cannot tell."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from appearance_opt.initial.sphere import sphere
from appearance_opt.render import raster, rays, upload
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.surface import Surface
from appearance_opt.views import Views, ViewSampler, look_at
from scenes.analytic import bumpy_sphere

SAMPLER = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=7)


def drawn(
    p: NDArray, f: NDArray, views: Views, n: int, dx: float = 0.5, dy: float = 0.5
) -> tuple[NDArray, NDArray]:
    """(triangle, depth) of all pixels, in the order of ``Grid``."""
    g = Grid(len(views), n)
    surface = Surface(upload.index_packets(f), upload.packets(8, p))
    batch = Batch(views.records(), g)
    samples, depth = raster.draw_grid(surface, batch, mi.Float(dx), mi.Float(dy))
    np.testing.assert_array_equal(np.array(samples.x), np.array(g.column) + np.float32(dx))
    np.testing.assert_array_equal(np.array(samples.y), np.array(g.row) + np.float32(dy))
    return np.array(samples.triangle), np.array(depth)


def traced(
    p: NDArray, f: NDArray, views: Views, n: int, dx: float = 0.5, dy: float = 0.5
) -> tuple[NDArray, NDArray]:
    batch = Batch(views.records(), Grid(len(views), n))
    samples, depth = rays.trace_grid(upload.scene_of(p, f), batch, dx, dy)
    return np.array(samples.triangle), np.array(depth)


def front(distance: float, fov: float = 40.0) -> Views:
    eye = np.array([[0.0, 0.0, distance]])
    return look_at(eye, np.zeros(3), fov, eye.astype(np.float32), 1.0)


@pytest.mark.parametrize("triangles", [60, 1000, 40_000])
@pytest.mark.parametrize("offset", [(0.5, 0.5), (0.125, 0.875)])
@pytest.mark.parametrize("resolution", [1, 33, 128])
def test_pixels_show_what_rays_hit(
    triangles: int, offset: tuple[float, float], resolution: int
) -> None:
    mesh = bumpy_sphere(triangles).meshes[0]
    case = mesh.positions, mesh.faces, SAMPLER.draw(0, 3), resolution, *offset
    (triangle, depth), (expected, distance) = drawn(*case), traced(*case)
    hit = expected != MISS
    # pixels on an edge to within rounding may differ: measured none, and 2 of 100,000 of a finer
    # mesh
    assert (triangle == expected).mean() > 0.9998
    assert ((triangle != MISS) == hit).mean() > 0.9998
    same = hit & (triangle == expected)
    np.testing.assert_allclose(
        depth[same], distance[same], rtol=1e-4
    )  # measured 5e-5, at one grazing triangle
    assert np.isinf(depth[triangle == MISS]).all()


def test_both_sides_of_a_triangle_are_seen() -> None:
    p = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
    one, other = (drawn(p, np.array([f]), front(3.0), 32)[0] for f in ([0, 1, 2], [0, 2, 1]))
    assert (one == 0).sum() > 100
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("eye", [(0.1, 0.2, 0.3), (0.0, 0.5, 0.05), (0.6, -0.3, -0.2)])
def test_surfaces_that_pass_the_camera_need_no_clipping(eye: tuple) -> None:
    """From within a cube of twelve triangles, most of which lie on both sides of the camera's
    plane."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    at = np.array([eye])
    views = look_at(at, np.array([0.9, 0.3, 0.1]), 100.0, at.astype(np.float32), 1.0)
    (triangle, depth), (expected, distance) = (
        f(corners, faces, views, 64) for f in (drawn, traced)
    )
    assert (triangle != MISS).all()
    assert (triangle == expected).mean() > 0.999
    np.testing.assert_allclose(depth, distance, rtol=1e-4)


def test_what_lies_behind_the_camera_is_not_seen() -> None:
    mesh = sphere(200, (0.0, 0.0, 5.0), 1.0, 16)
    assert (drawn(mesh.positions, mesh.faces, front(3.0), 32)[0] == MISS).all()


def test_no_pixel_falls_between_two_triangles() -> None:
    """A square whose rows, columns and diagonals run exactly through the middles of pixels."""
    n, cells = 64, 32
    line = np.linspace(-1, 1, cells + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    p = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1).astype(np.float32)
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    f = np.concatenate(
        [np.stack([i, i + 1, i + cells + 2], 1), np.stack([i, i + cells + 2, i + cells + 1], 1)]
    )
    views = front(1.0, 90.0)  # two pixels per cell
    for offset in (0.0, 0.5):
        assert (drawn(p, f, views, n, offset, offset)[0] != MISS).all()


def test_of_coincident_triangles_the_first_is_seen() -> None:
    p = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
    f = np.array([[0, 1, 2]] * 3)
    triangle = drawn(p, f, front(3.0), 32)[0]
    assert set(np.unique(triangle)) == {0, MISS}


def test_triangles_without_area_cover_nothing() -> None:
    p = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0], [0, 0, 0.5]], np.float32)
    f = np.array([[3, 3, 3], [0, 0, 1], [0, 1, 2]])
    assert set(np.unique(drawn(p, f, front(3.0), 32)[0])) == {2, MISS}


def test_scale_does_not_matter() -> None:
    mesh = sphere(300, (0.0, 0.0, 0.0), 0.8, 16)
    expected = drawn(mesh.positions, mesh.faces, SAMPLER.draw(1, 2), 48)[0]
    for scale in (2.0**-20, 2.0**20):
        v = SAMPLER.draw(1, 2)
        views = Views(v.eye * np.float32(scale), v.forward, v.right, v.down, v.light, v.intensity)
        triangle = drawn(mesh.positions * np.float32(scale), mesh.faces, views, 48)[0]
        np.testing.assert_array_equal(triangle, expected)
