"""Meshes that are fitted to what is no mesh: anything with bounds that renders."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

import appearance_opt as ao
from appearance_opt.asset import save
from appearance_opt.asset.types import Asset, Material, Mesh
from appearance_opt.errors import InputError, ReferenceRenderError
from appearance_opt.placement import Placement
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.subject import Subject
from appearance_opt.views import ViewSampler
from tests.conftest import grid_sphere

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.views import Views

CENTRE, RADIUS = np.array([3.0, -1.0, 0.5]), 0.25
QUICK = {"texture_size": 64, "resolution": 48, "pool": 24, "views": 4, "reallocate": 0, "seed": 2}


class Ball:
    """A matt red ball, drawn by its formula, in metres."""

    bounds = np.stack([CENTRE - RADIUS, CENTRE + RADIUS])

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]:
        fine = 3 * resolution
        at = (np.arange(fine) + 0.5) / fine * 2 - 1
        eye, forward, right, down, light = (
            np.float64(v)[:, None, None]
            for v in (views.eye, views.forward, views.right, views.down, views.light)
        )
        ray = forward + at[None, None, :, None] * right + at[None, :, None, None] * down
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        o = eye - CENTRE
        b = np.sum(o * ray, axis=-1)
        under = b * b - np.sum(o * o, axis=-1) + RADIUS**2
        normal = (o + ray * (-b - np.sqrt(np.maximum(under, 0)))[..., None]) / RADIUS
        way = light - CENTRE - normal * RADIUS
        far = np.linalg.norm(way, axis=-1)
        lit = np.maximum(np.sum(normal * way, axis=-1), 0) / far**3 / np.pi
        lit *= views.intensity[:, None, None]
        image = np.stack([0.8 * lit, 0.1 * lit, 0.1 * lit, np.ones_like(lit)], axis=-1)
        image *= (under > 0)[..., None]
        shape = (len(views), resolution, 3, resolution, 3, 4)
        return image.reshape(shape).mean(axis=(2, 4)).astype(np.float32)


def ball_asset(radius: float, color: tuple[float, float, float], atlas: bool = False) -> Asset:
    p, f, uvs = grid_sphere(10, 16, radius)
    at = (p + CENTRE).astype(np.float32)
    material = Material("m", color, roughness=1.0)
    return Asset((Mesh(at, f, uvs=uvs if atlas else None, material=material),), "wrong")


def radii(asset: Asset) -> NDArray[np.float64]:
    return np.linalg.norm(asset.points() - CENTRE, axis=1)


def test_a_wrong_mesh_becomes_the_ball(tmp_path: Path) -> None:
    """Too small and blue, without an atlas; from an asset, and from a file."""
    wrong = ball_asset(0.8 * RADIUS, (0.1, 0.1, 0.8))
    save(wrong, tmp_path / "wrong.glb")
    result = ao.fit(Ball(), wrong, preset="draft", steps=60, out=tmp_path / "ball.glb", **QUICK)
    curve = result.fit.curve
    assert curve[-1].psnr > curve[0].psnr + 2  # measured 4.0 dB
    assert 0.83 < np.median(radii(result.asset)) / RADIUS < 1.1  # measured 0.876, from 0.8
    assert result.triangles == wrong.triangle_count
    assert ao.load(tmp_path / "ball.glb").triangle_count == wrong.triangle_count
    again = ao.fit(Ball(), tmp_path / "wrong.glb", preset="draft", steps=1, **QUICK)
    assert again.fit.curve[0].psnr == pytest.approx(curve[0].psnr, abs=0.5)


def test_a_sphere_finds_the_ball_and_its_colour(tmp_path: Path) -> None:
    report = tmp_path / "report"
    result = ao.fit(Ball(), 200, preset="draft", steps=60, report=report, **QUICK)
    assert result.triangles <= 200
    assert np.median(radii(result.asset)) == pytest.approx(RADIUS, rel=0.08)
    assert result.fit.curve[-1].psnr > 20
    assert (report / "report.html").is_file()
    material = result.asset.meshes[0].material
    texture = material.base_color_texture
    color = material.base_color if texture is None else texture.pixels.mean(axis=(0, 1))
    assert color[0] > 1.5 * color[2]


def test_an_atlas_is_kept_where_there_is_one() -> None:
    start = ball_asset(RADIUS, (1, 0, 0), atlas=True)
    (given,), (mesh,) = (
        start.meshes,
        ao.fit(Ball(), start, preset="draft", steps=1, **QUICK).asset.meshes,
    )
    assert mesh.uvs is not None and given.uvs is not None
    np.testing.assert_allclose(mesh.uvs[mesh.faces], given.uvs[given.faces], atol=1e-6)


def test_views_of_the_world_show_the_same_as_local_ones() -> None:
    asset = ball_asset(RADIUS, (0.5, 0.4, 0.3))
    placement = Placement.around(asset.points())
    views = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=1).draw(0, 2)
    local = MeshReference(placement.local(asset)).render(views, 32, 4)
    world = MeshReference(asset).render(placement.views_to_world(views), 32, 4)
    np.testing.assert_allclose(world, local, atol=5e-3)
    subject = Subject.of_reference(MeshReference(asset))
    assert hasattr(subject.reference, "pair")
    middle = subject.reference.bounds.mean(axis=0)
    np.testing.assert_allclose(middle, 0, atol=1e-6)


class Odd(Ball):
    def __init__(self, bounds: object) -> None:
        self.bounds = bounds  # type: ignore[assignment]


@pytest.mark.parametrize(
    "bounds", [[[0, 0, 0]], [[1, 1, 1], [0, 0, 0]], [[0, 0, 0], [1, 1, np.inf]], [[0] * 3] * 2]
)
def test_bounds_that_are_no_box_are_refused(bounds: list) -> None:
    with pytest.raises(ReferenceRenderError, match="bounds of the reference"):
        ao.fit(Odd(bounds), 100, preset="draft", steps=1, **QUICK)


def test_what_is_no_reference_or_start_is_refused() -> None:
    asset = ball_asset(RADIUS, (1, 0, 0))
    for thing in (asset, object(), "file.glb"):
        with pytest.raises(InputError, match="is no reference"):
            ao.fit(thing, 100, preset="draft", steps=1)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="needs a number of triangles"):
        ao.fit(Ball(), preset="draft", steps=1)
    with pytest.raises(InputError, match="cannot start from 0"):
        ao.fit(Ball(), 0, preset="draft", steps=1)
    glass = replace(asset.meshes[0], material=Material("glass", opacity=0.2, alpha_mode="blend"))
    with pytest.raises(InputError, match="nothing to start from"):
        ao.fit(Ball(), Asset((glass,), "glass"), preset="draft", steps=1)
