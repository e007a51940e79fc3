"""Light that an asset emits is carried over, though no image under a lamp shows it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import appearance_opt
from appearance_opt.asset import Asset, Texture, load, save
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.survey import Found, MeshSurvey, Place

FACTOR = (3.0, 1.5, 0.75)
QUICK = {"steps": 0, "pool": 4, "views": 2, "resolution": 64, "texture_size": 128}


@pytest.fixture(scope="module")
def glowing(ball: Asset) -> Asset:
    """A ball of which the upper half glows."""
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:32] = (255, 255, 0)
    mesh = ball.meshes[0]
    material = replace(
        mesh.material, emission=FACTOR, emission_texture=Texture(pixels, "srgb", ("clamp", "clamp"))
    )
    return replace(ball, meshes=(replace(mesh, material=material),))


def emitted(asset: Asset) -> tuple[np.ndarray, np.ndarray]:
    """(height, emission (F, 3)) at the middles of all triangles."""
    reference = MeshReference(asset)
    faces = reference.merged.faces
    third = dr.full(mi.Float, 1 / 3, len(faces))
    place = Place(dr.arange(mi.UInt32, len(faces)), third, third)
    found = Found(mi.Float(0), dr.full(mi.Bool, True, len(faces)), place)
    rgb = MeshSurvey(reference).emission(found, mi.Float(1e-6))
    height = reference.merged.positions[faces][..., 1].mean(axis=1)
    return height, np.stack([np.broadcast_to(np.array(c), len(faces)) for c in rgb], axis=1)


@pytest.mark.parametrize("suffix", [".glb", ".usda", ".obj"])
@pytest.mark.parametrize("textured", [True, False])
def test_files_keep_it(tmp_path: Path, glowing: Asset, suffix: str, textured: bool) -> None:
    mesh = glowing.meshes[0]
    if not textured:
        mesh = replace(mesh, material=replace(mesh.material, emission_texture=None))
    save(replace(glowing, meshes=(mesh,)), tmp_path / f"x{suffix}")
    again = load(tmp_path / f"x{suffix}").meshes[0].material
    np.testing.assert_allclose(again.emission, FACTOR, rtol=1e-6)
    if textured:
        np.testing.assert_array_equal(
            again.emission_texture.pixels, mesh.material.emission_texture.pixels
        )
        assert again.emission_texture.color_space == "srgb"
    else:
        assert again.emission_texture is None


@pytest.mark.parametrize("suffix", [".glb", ".usda", ".obj"])
def test_files_without_it_have_none(tmp_path: Path, ball: Asset, suffix: str) -> None:
    save(ball, tmp_path / f"x{suffix}")
    material = load(tmp_path / f"x{suffix}").meshes[0].material
    assert not material.emits
    assert material.emission_texture is None
    assert MeshReference(ball).emission is None


@pytest.mark.parametrize("suffix", [".gltf", ".usda", ".obj"])
def test_nothing_glows_without_the_texture_that_says_where(
    tmp_path: Path, glowing: Asset, suffix: str
) -> None:
    save(glowing, tmp_path / f"x{suffix}")
    for picture in tmp_path.rglob("*.png"):
        picture.unlink()
    assert not load(tmp_path / f"x{suffix}", missing_textures="ignore").meshes[0].material.emits


def test_a_simplified_ball_glows_where_the_ball_does(glowing: Asset) -> None:
    result = appearance_opt.simplify(
        glowing, None, appearance_opt.simplify_options("draft", triangles=300, **QUICK)
    )
    height, rgb = emitted(result.asset)
    # at the poles a sample covers the whole width of the texture, and is read from coarse mip
    # levels
    upper, lower = (height > 0.15) & (height < 0.9), (height < -0.15) & (height > -0.9)
    np.testing.assert_allclose(rgb[upper, :2], np.tile(FACTOR[:2], (upper.sum(), 1)), rtol=0.02)
    assert np.abs(rgb[lower]).max() < 0.02 * FACTOR[0]
    assert np.abs(rgb[:, 2]).max() < 0.02 * FACTOR[2]


def test_the_same_glow_everywhere_needs_no_map(ball: Asset) -> None:
    mesh = ball.meshes[0]
    plain = replace(ball, meshes=(replace(mesh, material=replace(mesh.material, emission=FACTOR)),))
    result = appearance_opt.simplify(
        plain, None, appearance_opt.simplify_options("draft", triangles=300, **QUICK)
    )
    material = result.asset.meshes[0].material
    np.testing.assert_allclose(material.emission, FACTOR, rtol=1e-6)
    assert material.emission_texture is None


@pytest.mark.parametrize("joint", [False, True])
def test_baked_maps_hold_it(glowing: Asset, joint: bool) -> None:
    mesh = glowing.meshes[0]
    low = replace(
        glowing, meshes=(replace(mesh, material=replace(mesh.material, emission=(0.0, 0.0, 0.0))),)
    )
    if joint:
        from appearance_opt.jobs.joint import joint as bake_jointly

        options = appearance_opt.joint_options("draft", subdivision=(0,), **QUICK)
        asset = bake_jointly(glowing, low, None, options).asset
    else:
        asset = appearance_opt.bake(
            glowing, low, None, appearance_opt.bake_options(closed_form=True, texture_size=128)
        ).asset
    height, rgb = emitted(asset)
    assert np.median(rgb[height > 0.15, 0]) == pytest.approx(FACTOR[0], rel=0.02)
    assert np.median(rgb[height < -0.15, 0]) < 0.02


def test_usd_scales_of_textures_are_kept(tmp_path: Path, ball: Asset) -> None:
    """Factors beside textures are the samplers' scales there."""
    mesh = ball.meshes[0]
    normal = Texture(np.full((4, 4, 3), (128, 128, 255), np.uint8))
    material = replace(
        mesh.material,
        base_color=(0.5, 0.25, 1.0),
        roughness=0.75,
        metalness=0.5,
        normal_texture=normal,
        normal_scale=0.8,
    )
    save(replace(ball, meshes=(replace(mesh, material=material),)), tmp_path / "x.usda")
    again = load(tmp_path / "x.usda").meshes[0].material
    np.testing.assert_allclose(again.base_color, material.base_color, rtol=1e-6)
    np.testing.assert_allclose(
        (again.roughness, again.metalness, again.normal_scale), (0.75, 0.5, 0.8), rtol=1e-6
    )
