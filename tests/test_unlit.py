"""Unlit materials: their colour whatever the light, in images, fits, bakes and files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from appearance_opt import bake, compare, simplify
from appearance_opt.asset import Asset, Material, Mesh, Texture, load, save
from appearance_opt.asset.types import srgb_to_linear
from appearance_opt.config import bake_options, simplify_options, with_values
from appearance_opt.jobs.inspect import inspect
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.texels import TEXELS
from appearance_opt.optimize.losses import LOSSES
from appearance_opt.optimize.step import Gradients
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.material import UNLIT
from appearance_opt.render.pixels import Grid
from appearance_opt.render.quality import Quality
from appearance_opt.views import look_at
from tests.conftest import grid_sphere, make_asset
from tests.test_gradients import make_inputs, make_model

COLOR = (0.8, 0.4, 0.1)


def ball(material: Material, x: float = 0.0) -> Mesh:
    positions, faces, uvs = grid_sphere(12, 24)
    normals = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    return Mesh(
        positions + np.float32([x, 0, 0]), faces, normals, uvs, material=material, name=f"ball{x:g}"
    )


def image(asset: Asset, light: tuple[float, float, float]) -> np.ndarray:
    views = look_at([[0, 0, 12]], np.zeros(3), 30.0, np.array([light]), 100.0)
    return MeshReference(asset).render(views, 64, 1)[0]


def middle(picture: np.ndarray, x: float) -> np.ndarray:
    """The pixel in which the centre of a ball at ``x`` lies."""
    half = 12 * np.tan(np.radians(15.0))
    return picture[32, int(32 * (1 + x / half)), :3]


@pytest.mark.parametrize("textured", [False, True])
def test_an_unlit_surface_shows_its_colour_in_any_light(textured: bool) -> None:
    material = Material("u", COLOR, unlit=True)
    if textured:
        material = replace(
            material, base_color_texture=Texture(np.full((8, 8, 3), 188, np.uint8), "srgb")
        )
    want = np.array(COLOR) * (float(srgb_to_linear(np.array([188 / 255]))[0]) if textured else 1.0)
    asset = Asset((ball(material),))
    for light in ((5.0, 5.0, 9.0), (-9.0, 0.0, -9.0)):
        np.testing.assert_allclose(
            middle(image(asset, light), 0.0), want, rtol=2e-3
        )  # half precision


def test_lit_and_unlit_parts_of_one_asset() -> None:
    lit = Material("l", COLOR, 0.9)
    both = Asset((ball(Material("u", COLOR, unlit=True), -1.5), ball(lit, 1.5)))
    alone = Asset((ball(lit, -1.5), ball(lit, 1.5)))
    for light in ((5.0, 5.0, 9.0), (0.0, 0.0, -9.0)):
        got, want = image(both, light), image(alone, light)
        np.testing.assert_allclose(middle(got, -1.5), COLOR, rtol=2e-3)
        np.testing.assert_allclose(middle(got, 1.5), middle(want, 1.5), rtol=2e-3, atol=1e-6)


def test_lit_assets_know_nothing_of_it() -> None:
    maps = MeshReference(make_asset()).maps
    assert maps.unlit is None
    assert UNLIT not in maps.constants


def test_unlit_assets_keep_colours_alone() -> None:
    asset = make_asset()
    mesh = asset.meshes[0]
    unlit = replace(mesh, material=replace(mesh.material, orm_texture=None, unlit=True))
    (layer,) = MeshReference(Asset((unlit,))).maps.layers
    assert layer.channels == ("red", "green", "blue")


def test_gradients_of_unlit_texels_agree_with_finite_differences() -> None:
    mesh = make_model().mesh
    size = 32
    wave = 0.5 + 0.2 * np.sin(np.arange(size) / size * 2 * np.pi)[None, :].astype(
        np.float32
    ).repeat(size, axis=0)
    maps = {"red": wave, "green": 1 - wave, "blue": wave.T.copy(), UNLIT: 1.0}
    model = latent_of(mesh, maps, frozenset({"material"}), Rates())
    grid, quality, loss = Grid(2, 48), Quality(visibility=CameraRays(())), LOSSES["l2"]
    inputs = make_inputs(model, grid)
    _, grads = Gradients(model, grid, quality, loss, freeze=False)(inputs)
    analytic = np.array(grads[TEXELS]).astype(np.float64)
    parameter = model.parameters[TEXELS]
    start = np.array(parameter.value)
    rng = np.random.default_rng(1)
    for _ in range(3):
        direction = rng.normal(size=start.shape).astype(np.float32)
        values = []
        for sign in (1, -1):
            parameter.value = mi.Float(start + sign * np.float32(1e-2) * direction)
            values.append(float(Gradients(model, grid, quality, loss, freeze=False)(inputs)[0][0]))
        numeric = (values[0] - values[1]) / 2e-2
        # the loss is a polynomial of the stored texels: what is left is the rounding of its values
        assert abs(float(analytic @ direction) - numeric) < 0.01 * np.linalg.norm(analytic)


def painted() -> Asset:
    """A ball whose picture is all there is of it."""
    asset = make_asset(16, 32)
    mesh = asset.meshes[0]
    return replace(
        asset,
        meshes=(replace(mesh, material=replace(mesh.material, orm_texture=None, unlit=True)),),
    )


SMALL = {"steps": 4, "resolution": 64, "texture_size": 64, "pool": 8, "views": 2, "seed": 3}


def test_an_unlit_asset_becomes_an_unlit_one(tmp_path: Path) -> None:
    asset = painted()
    options = simplify_options(ratio=0.3, reallocate=0, **SMALL)
    result = simplify(asset, tmp_path / "low.glb", options)
    material = load(tmp_path / "low.glb").meshes[0].material
    assert material.unlit
    assert material.base_color_texture is not None
    assert (material.orm_texture, material.normal_texture) == (None, None)
    # drawn by a light it would be some 10 dB lower, whatever its colours
    assert compare(asset, result.asset, views=4, resolution=64).metrics.psnr_covered > 22


def test_unlit_parts_among_lit_ones_pass_through(tmp_path: Path) -> None:
    lit = make_asset(16, 32).meshes[0]
    sign = ball(Material("sign", COLOR, unlit=True), 3.0)
    options = simplify_options(ratio=0.3, reallocate=0, **SMALL)
    result = simplify(Asset((lit, sign)), None, options)
    fitted, kept = result.asset.meshes
    assert (fitted.material.unlit, kept.material.unlit) == (False, True)
    np.testing.assert_array_equal(kept.faces, sign.faces)
    assert [n for n in result.notes if "unlit parts" in n and "ball3" in n]


def test_what_is_baked_from_an_unlit_asset_is_unlit() -> None:
    high, low = painted(), make_asset(8, 16)
    options = bake_options(
        maps=("base-color",), texture_size=64, steps=2, resolution=64, pool=8, views=2, cage=0.2
    )
    material = bake(high, low, None, options).asset.meshes[0].material
    assert material.unlit
    again = (
        bake(make_asset(16, 32), painted(), None, with_values(options, closed_form=True))
        .asset.meshes[0]
        .material
    )
    assert not again.unlit


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".usda", ".usdz", ".obj"])
def test_files_say_that_a_material_is_unlit(tmp_path: Path, suffix: str) -> None:
    asset = painted()
    mesh = asset.meshes[0]
    plain = replace(mesh, material=Material("plain", COLOR, unlit=True), name="plain")
    save(Asset((mesh, plain), "both"), tmp_path / f"x{suffix}")
    back = load(tmp_path / f"x{suffix}")
    assert [m.material.unlit for m in back.meshes] == [True, True]
    assert back.meshes[1].material.base_color == pytest.approx(COLOR, abs=1e-6)
    first, texture = back.meshes[0].material, mesh.material.base_color_texture
    assert first.base_color_texture is not None and texture is not None
    np.testing.assert_array_equal(first.base_color_texture.pixels[..., :3], texture.pixels)
    assert not first.emits
    save(make_asset(4, 8), tmp_path / f"lit{suffix}")
    assert not load(tmp_path / f"lit{suffix}").meshes[0].material.unlit


def test_metallic_and_roughness_of_unlit_files_mean_nothing(tmp_path: Path) -> None:
    """Their default is a metal."""
    save(painted(), tmp_path / "x.gltf")
    text = (tmp_path / "x.gltf").read_text()
    assert '"KHR_materials_unlit"' in text
    (tmp_path / "x.gltf").write_text(text.replace('"metallicFactor": 0.0', '"metallicFactor": 1.0'))
    assert load(tmp_path / "x.gltf").meshes[0].material.metalness == 0


def test_inspect_says_what_becomes_of_unlit_parts(tmp_path: Path) -> None:
    lit, sign = make_asset(8, 16).meshes[0], ball(Material("sign", COLOR, unlit=True), 3.0)
    save(Asset((lit, sign)), tmp_path / "mixed.glb")
    save(Asset((sign,)), tmp_path / "all.glb")
    mixed, alone = (inspect(tmp_path / f"{name}.glb") for name in ("mixed", "all"))
    assert {m.name: (m.seen, m.simplify) for m in mixed.materials} == {
        "painted": ("opaque", "fitted"),
        "sign": ("opaque, unlit", "kept as it is"),
    }
    assert mixed.alpha["unlit"].becomes == "kept as it is"
    assert (alone.materials[0].simplify, alone.alpha["unlit"].becomes) == ("fitted", "fitted")
