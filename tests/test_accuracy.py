"""Bounds on the error of single stages; docs/accuracy.md has the whole tables."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.fit.model import Model, Rates
from appearance_opt.initial.sphere import sphere
from appearance_opt.render import coverage, deferred, gradient, rays
from appearance_opt.render.deferred import Grid
from appearance_opt.render.gradient import Quality
from appearance_opt.views import ViewSampler


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 8, 16, 64, 256])
def test_ray_positions_are_centred_and_apart(count: int) -> None:
    points = rays.sub_pixel_offsets(count).astype(np.float64)
    assert points.min() > 0 and points.max() < 1
    # an off-centre pattern shifts the image; float32 rounding of the mean alone is left
    np.testing.assert_allclose(points.mean(0), 0.5, atol=1e-7)
    # the largest squared distance that n points can keep is 2 / sqrt(3) / n (hexagonal); measured 58 % of
    # that at worst (3 points)
    gaps = points[:, None] - points[None]
    gaps -= np.round(gaps)
    squared = np.sum(gaps**2, -1) + np.eye(count) * 10
    assert count == 1 or squared.min() * count > 0.55 * 2 / np.sqrt(3)


def test_half_plane_area_is_exact() -> None:
    rng = np.random.default_rng(0)
    angle = np.concatenate([rng.uniform(0, 2 * np.pi, 40), np.arange(8) * np.pi / 4])
    distance = np.concatenate([rng.uniform(-0.8, 0.8, 40), rng.uniform(-0.5, 0.5, 8)])
    nx, ny = np.cos(angle), np.sin(angle)
    found = coverage.half_plane_area(*(mi.Float(a.astype(np.float32)) for a in (nx, ny, distance)))
    middle = (np.arange(1500) + 0.5) / 1500 - 0.5
    x, y = np.meshgrid(middle, middle)
    counted = [np.mean(a * x + b * y < d) for a, b, d in zip(nx, ny, distance, strict=True)]
    # the count's own error is below 1 / 1500; measured 3.4e-4
    np.testing.assert_allclose(np.array(found), counted, atol=7e-4)


def test_silhouettes_know_the_coverage_of_their_pixels() -> None:
    mesh = sphere(1200, (0.0, 0.0, 0.0), 0.7, 16)
    constants = {"red": 0.6, "green": 0.3, "blue": 0.2, "roughness": 0.5, "metalness": 0.2}
    model = Model(mesh, constants, frozenset(("shape",)), Rates())
    grid, records = Grid(2, 64), ViewSampler((0.0, 0.0, 0.0), 1.0, seed=5).draw(0, 2).records()
    surface, maps = model.surface(model.positions()), model.maps(None)
    quality = Quality(4.0, 4, 1)
    with dr.suspend_grad():
        frame = gradient.render(model.scene, surface, maps, model.topology.edges, records, grid, quality, 0)
        exact = deferred.render_image(model.scene, surface, maps, records, grid, 1024)
    crossed = np.unique(np.array(frame.edges.pixel))
    error = (np.array(frame.image) - np.array(exact)).reshape(-1, 4)[crossed, 3]
    # measured 0.022; by the same four rays alone 0.095
    assert np.sqrt(np.mean(error**2)) < 0.03
    # measured 8e-4: no shift of the outline
    assert abs(error.mean()) < 3e-3
