"""Bounds on the error of single stages; docs/accuracy.md has the whole tables."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.asset.tangents import split_and_tangents
from appearance_opt.initial.sphere import sphere
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.parameter import Rates
from appearance_opt.render import gradient
from appearance_opt.render.boundary import coverage
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.boundary.edges import Edges
from appearance_opt.render.images import render_image
from appearance_opt.render.lattice import sub_pixel_offsets
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.quality import Quality
from appearance_opt.views import ViewSampler
from experiments.accuracy import physics, stages, textures
from experiments.gradient_error.estimators import Ours
from experiments.gradient_error.metrics import error_of
from experiments.gradient_error.problems import make_problem, smooth_fields
from tests.differences import differences_along
from tests.drawing import drawn_of


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 8, 16, 64, 256])
def test_ray_positions_are_centred_and_apart(count: int) -> None:
    points = sub_pixel_offsets(count).astype(np.float64)
    assert points.min() > 0 and points.max() < 1
    # an off-centre pattern shifts the image; float32 rounding of the mean alone is left
    np.testing.assert_allclose(points.mean(0), 0.5, atol=1e-7)
    # the largest squared distance that n points can keep is 2 / sqrt(3) / n (hexagonal); measured
    # 58 % of that at worst (3 points)
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
    model = latent_of(mesh, constants, frozenset(("shape",)), Rates())
    grid, records = Grid(2, 64), ViewSampler((0.0, 0.0, 0.0), 1.0, seed=5).draw(0, 2).records()
    drawn, batch = drawn_of(model), Batch(records, grid)
    quality = Quality(visibility=CameraRays((Edges(4.0),), 4))
    with dr.suspend_grad():
        rendered = gradient.render(drawn, batch, quality, 0)
        exact = render_image(drawn, batch, 1024)
    (points,) = rendered.seen.boundaries
    crossed = np.unique(np.array(points.pixel))
    error = (np.array(rendered.image) - np.array(exact)).reshape(-1, 4)[crossed, 3]
    # measured 0.022; by the same four rays alone 0.095
    assert np.sqrt(np.mean(error**2)) < 0.05
    # measured 8e-4: no shift of the outline
    assert abs(error.mean()) < 3e-3


def test_functions_in_single_precision_keep_their_digits(variant: str) -> None:
    # CUDA approximates quotients and roots: measured 6.0e-6 for the BRDF and 1.5e-4 for positions
    device = 1 if variant.startswith("llvm") else 3
    worst = {(r.function, r.domain): r.largest for r in stages.lines()}
    # measured 1.5e-6 (1.2e-2 at roughness 0.08 while 1 - (n.h)^2 was taken as a difference)
    assert max(v for (f, _), v in worst.items() if f == "brdf.reflect") < 5e-6 * device
    # measured 6e-7 (2.5e-3 with log(x + 1))
    assert worst["losses.tone_map", "0 to 1e6"] < 3e-6
    # measured 1.5e-7 and 1.7e-7 (1.5e-4 and 2.1e-4 with the arc cosine)
    assert worst["mesh_ops.vertex_normals", "rough sphere"] < 1e-6
    assert worst["mesh_ops.vertex_tangents", "rough sphere"] < 1e-6
    # measured 2.1e-5: rays of float32 pixel positions
    assert (
        worst["surface.interpolate, position", "triangles seen at a cosine of 0.2"] < 1e-4 * device
    )


@pytest.mark.parametrize("roughness", [0.0, 0.08, 0.3, 1.0])
def test_the_microfacet_distribution_is_normalised(roughness: float) -> None:
    # measured 6e-5, the error of the sum at the sharpest peak
    assert physics.normalisation(roughness, 600) == pytest.approx(1.0, abs=5e-4)


def test_the_brdf_is_reciprocal_and_metal_never_reflects_more_than_it_gets() -> None:
    # measured 6e-6
    assert physics.reciprocity() < 3e-5
    for roughness in (0.08, 0.3, 1.0):
        for cosine in (0.05, 0.3, 1.0):
            # measured at most 0.9996; the midpoint sum is good to 1e-3 at the sharpest peak
            assert physics.albedo(1.0, roughness, 1.0, cosine, 200) < 1.002
    # alpha = 1 seen head-on: 2 int l / (2 (1 + l)) dl = 1 - ln 2; measured 3e-5 apart
    assert physics.albedo(1.0, 1.0, 1.0, 1.0, 200) == pytest.approx(1 - np.log(2), rel=2e-4)
    # a smooth white metal loses nothing: measured 0.9996
    assert physics.albedo(1.0, 0.08, 1.0, 0.7) == pytest.approx(1.0, abs=2e-3)


def test_tone_map_at_zero_the_knee_and_far_up() -> None:
    for _, ours, exact in physics.tone_map_corners():
        # measured 2e-7
        assert ours == pytest.approx(exact, rel=1e-6, abs=0)


@pytest.mark.parametrize("wrap", list(textures.WRAPS))
def test_lookups_equal_those_of_openimageio(wrap: str) -> None:
    # measured 1.2e-7 for powers of two, 3e-6 else: positions are rounded before their fraction is
    # taken
    assert textures.bilinear((64, 32), wrap) < 1e-6
    assert textures.bilinear((37, 5), wrap) < 1e-5


def test_mip_levels_and_trilinear_lookups_equal_those_of_openimageio() -> None:
    # measured 1.2e-7 and 1.4e-7
    assert max(textures.levels((64, 16))) < 1e-6
    assert textures.trilinear((64, 64)) < 1e-6


@pytest.mark.parametrize("name", ["ball", "mirrored", "slivers"])
def test_tangents_equal_those_of_mikktspace(name: str) -> None:
    with np.load(Path(__file__).parent / "data" / "mikktspace.npz") as data:
        p, n, uv, f, expected = (
            data[f"{name}/{k}"] for k in ("positions", "normals", "uvs", "faces", "corners")
        )
    _, faces, tangents = split_and_tangents(p, n, uv, f)
    corners = tangents[faces]
    np.testing.assert_array_equal(corners[..., 3], expected[..., 3])
    # measured 1.6e-5 (0.0009 degrees) among slivers, 2.5e-6 elsewhere: MikkTSpace works in single
    # precision
    np.testing.assert_allclose(corners[..., :3], expected[..., :3], atol=5e-5)


def test_vertex_gradients_of_a_triangle_are_those_of_its_box_filtered_image() -> None:
    problem = make_problem("triangle", 64)
    fields = smooth_fields(problem.positions, 6, 1)
    target, truth = differences_along(problem, fields, 256)
    ours = Ours(problem, target, "log-srgb-l1")
    g = np.stack(
        [ours(Quality(visibility=CameraRays((Edges(2.0),), 4)), seed) for seed in range(4)]
    )
    error = error_of(np.einsum("rvc,nvc->rn", g, fields), truth)
    # measured 0.035 and +1.8 %; at 128 squared pixels 0.27 and -23 % by four rays off centre alone
    assert error.relative < 0.08 and abs(error.bias) < 0.03
