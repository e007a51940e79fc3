"""Mitsuba's own path tracer and the analytic environment, against our renderer and integrals."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import appearance_opt
from appearance_opt import backend
from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.errors import BackendError
from appearance_opt.evaluate import path_traced
from appearance_opt.evaluate.comparison import render_asset
from appearance_opt.evaluate.environment import (
    distant_lights,
    panorama,
    radiance,
    render_environment,
)
from appearance_opt.reference.plugins import MINIMUM_LLVM
from appearance_opt.views import Views, look_at, views_around
from tests.conftest import make_asset

RESOLUTION = 48


@pytest.fixture(autouse=True)
def compiler(variant: str) -> None:
    if variant == backend.CPU and dr.detail.llvm_version()[0] < MINIMUM_LLVM:
        pytest.skip("Mitsuba's plugins need a newer LLVM")


def from_above(light: tuple[float, float, float]) -> Views:
    return look_at([[0.0, 0.0, 4.0]], np.zeros(3), 25.0, np.array([light]), 30.0)


def plate(mirrored: bool, tilt: float) -> Asset:
    """A rough white square that faces +Z, whose normal map leans by ``tilt`` to the picture's left
    or right and upward; the picture may be mirrored on it."""
    x = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    uvs = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    if mirrored:
        uvs[:, 0] = 1 - uvs[:, 0]
    n = np.array([tilt, 0.2, 0.0])
    n[2] = np.sqrt(1 - n @ n)
    texture = Texture(np.broadcast_to((n + 1) / 2, (4, 4, 3)).astype(np.float32).copy())
    material = Material(base_color=(0.6, 0.6, 0.6), normal_texture=texture)
    up = np.broadcast_to([0, 0, 1], x.shape).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Asset((Mesh(x, faces, up, uvs, material=material),), "plate")


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("tilt", [-0.5, 0.5])
def test_normal_maps_lean_to_the_side_to_which_ours_lean(mirrored: bool, tilt: float) -> None:
    asset, views = plate(mirrored, tilt), from_above((3.0, 1.0, 3.0))
    ours = render_asset(asset, views, 16, 4)
    theirs = path_traced.PathTraced(asset).render(views, 16, 4)
    # a lean to the light is 2.9 times as bright as one away from it; diffuse models differ a little
    assert theirs[0, 8, 8, 0] == pytest.approx(ours[0, 8, 8, 0], rel=0.3)


def test_a_textured_ball_looks_as_we_draw_it() -> None:
    ball = make_asset()
    views = views_around(ball.points(), 0).draw(0, 2)
    ours = render_asset(ball, views, RESOLUTION, 16)
    theirs = path_traced.PathTraced(ball).render(views, RESOLUTION, 16)
    np.testing.assert_allclose(theirs[..., 3], ours[..., 3], atol=0.2)
    assert np.abs(theirs - ours).mean() < 0.04
    wrong = np.abs(theirs[:, ::-1] - ours).mean()
    assert np.abs(theirs - ours).mean() < 0.2 * wrong


def test_masks_leave_holes() -> None:
    asset = plate(False, 0.0)
    pixels = np.full((4, 4, 4), 255, np.uint8)
    pixels[:, :2, 3] = 0
    material = Material(alpha_mode="mask", base_color_texture=Texture(pixels, "srgb"))
    asset = replace(asset, meshes=(replace(asset.meshes[0], material=material),))
    image = path_traced.PathTraced(asset).render(from_above((0.0, 0.0, 3.0)), 16, 4)[0]
    assert image[8, 3, 3] == 0 and image[8, 12, 3] == 1


def test_lights_are_as_bright_as_the_environment_they_stand_for() -> None:
    sky = panorama()
    polar = (np.arange(128) + 0.5) / 128 * np.pi
    power = (sky * np.sin(polar)[:, None, None]).sum(axis=(0, 1)) * (np.pi / 128) ** 2
    lights = distant_lights(16)
    np.testing.assert_allclose(lights.irradiance.sum(axis=0), power, rtol=0.01)
    # cells are about equally bright
    share = lights.irradiance.sum(axis=1) / power.sum()
    assert share.max() < 2.5 / 16
    assert radiance(np.array([0.0, 1.0, 0.0])).sum() > radiance(np.array([0.0, -1.0, 0.0])).sum()


def test_the_environment_looks_alike_in_both_renderers() -> None:
    """A rough ball, on which nothing casts a shadow; also says which way the panorama lies."""
    ball = make_asset()
    plain = Material(base_color=(0.5, 0.5, 0.5), roughness=1.0)
    ball = replace(ball, meshes=(replace(ball.meshes[0], material=plain),))
    views = views_around(ball.points(), 0).draw(0, 3)
    ours = render_environment(ball, views, RESOLUTION, distant_lights(64))
    theirs = path_traced.PathTraced(ball, environment=True).render(views, RESOLUTION, 64)
    inside = (ours[..., 3] > 0.99) & (theirs[..., 3] > 0.99)
    off = np.abs(ours - theirs)[inside].mean() / theirs[inside][:, :3].mean()
    assert off < 0.2  # measured 0.13: diffuse light is not the same model


@pytest.mark.parametrize(
    ("renderer", "light"), [("own", "environment"), ("path", "point"), ("path", "environment")]
)
def test_comparisons_under_other_lights_and_by_another_renderer(
    renderer: str, light: str, capfd: pytest.CaptureFixture
) -> None:
    """What is alike is alike in each of them, and what is darker is not; samples that are no
    square bring no warning."""
    ball = make_asset()
    dark = replace(ball.meshes[0].material, base_color=(0.5, 0.5, 0.5))
    other = replace(ball, meshes=(replace(ball.meshes[0], material=dark),))
    given = {"views": 2, "resolution": 48, "samples": 7, "renderer": renderer, "light": light}
    same = appearance_opt.compare(ball, ball, **given)
    assert same.metrics.psnr == 99.0 and same.metrics.noticed == 0.0
    unlike = appearance_opt.compare(ball, other, **given)
    assert unlike.metrics.psnr_covered < 25 and unlike.metrics.noticed > 0.5
    assert "WARN" not in "".join(capfd.readouterr())
    usual = appearance_opt.compare(ball, other, views=2, resolution=48, samples=7)
    assert np.abs(usual.reference - unlike.reference).max() > 0.05


def test_what_the_path_tracer_leaves_out_is_said() -> None:
    mesh = make_asset(8, 16).meshes[0]
    painted = replace(mesh, colors=np.full((len(mesh.positions), 3), 0.5, np.float32))
    given = {"views": 1, "resolution": 32, "samples": 1}
    found = appearance_opt.compare(Asset((painted,)), Asset((painted,)), renderer="path", **given)
    assert any("leaves out vertex colours" in note for note in found.notes)
    assert not appearance_opt.compare(Asset((painted,)), Asset((painted,)), **given).notes


def test_an_old_compiler_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mi, "variant", lambda: backend.CPU)
    monkeypatch.setattr(dr.detail, "llvm_version", lambda: (15, 0, 7))
    with pytest.raises(BackendError, match="needs libLLVM 17 or newer, and finds 15"):
        path_traced.PathTraced(make_asset())
