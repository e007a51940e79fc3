"""Specular-glossiness materials look the same as metallic-roughness ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import Texture, images, load
from appearance_opt.asset.specular_glossiness import (
    DIELECTRIC,
    Specular,
    constants,
    metallic,
    textures,
)
from appearance_opt.asset.types import srgb_to_linear
from tests.test_asset_gltf import triangle_document, write_glb

COLOR = (0.8, 0.4, 0.1)


def test_a_dielectric_keeps_its_reflectance() -> None:
    """Diffuse albedo of glTF's own dielectric: what the 4 % of specular reflection leave."""
    diffuse = np.float32(COLOR) * (1 - DIELECTRIC)
    base, roughness, metalness = constants(Specular(tuple(diffuse), (DIELECTRIC,) * 3, 0.3))
    np.testing.assert_allclose(base, np.float32(COLOR) * (1 - DIELECTRIC), atol=1e-6)
    assert metalness == pytest.approx(0, abs=1e-6)
    assert roughness == pytest.approx(0.7)


def test_a_metal_keeps_its_colour() -> None:
    base, _, metalness = constants(Specular((0, 0, 0), COLOR, 1.0))
    np.testing.assert_allclose(base, COLOR, atol=1e-5)
    assert metalness == pytest.approx(1, abs=1e-5)


def test_metalness_grows_with_specular_and_stays_in_range() -> None:
    specular = np.linspace(0, 1, 101, dtype=np.float32)[:, None] * np.ones(3, np.float32)
    base, metalness = metallic(np.full((101, 3), 0.3, np.float32), specular)
    assert (np.diff(metalness) >= -1e-6).all()
    assert metalness[0] == 0
    assert 0.99 < metalness[-1] <= 1
    assert np.isfinite(base).all()
    assert (base >= 0).all()
    assert (base <= 1).all()


def test_textures_hold_what_constants_give() -> None:
    """Uniform textures of two sizes, taller than a band, times factors."""
    diffuse = Texture(np.full((600, 4, 3), (200, 100, 50), np.uint8), "srgb")
    glossy = Texture(np.full((300, 2, 4), (120, 120, 120, 64), np.uint8), "srgb")
    base, orm = textures(Specular((0.5, 1, 1), (1, 1, 0.5), 0.8, diffuse, glossy))
    assert base.pixels.shape == orm.pixels.shape == (600, 4, 3)
    factors = srgb_to_linear(np.float32((200, 100, 50)) / 255) * (0.5, 1, 1)
    shine = srgb_to_linear(np.float32(120) / 255) * np.array((1, 1, 0.5))
    color, roughness, metalness = constants(Specular(tuple(factors), tuple(shine), 0.8 * 64 / 255))
    np.testing.assert_allclose(base.linear().reshape(-1, 3), np.tile(color, (2400, 1)), atol=4e-3)
    np.testing.assert_allclose(orm.linear()[..., 1], roughness, atol=2e-3)
    np.testing.assert_allclose(orm.linear()[..., 2], metalness, atol=2e-3)


@pytest.mark.parametrize("textured", [False, True])
def test_in_a_file(tmp_path: Path, textured: bool) -> None:
    given: dict = {
        "diffuseFactor": [0, 0, 0, 1],
        "specularFactor": list(COLOR),
        "glossinessFactor": 0.75,
    }
    changes: dict = {}
    if textured:
        png = images.encode_png(np.full((2, 2, 4), (255, 255, 255, 255), np.uint8))
        (tmp_path / "shine.png").write_bytes(png)
        given["specularGlossinessTexture"] = {"index": 0}
        changes = {"textures": [{"source": 0}], "images": [{"uri": "shine.png"}]}
    extension = {"KHR_materials_pbrSpecularGlossiness": given}
    document, binary = triangle_document(
        materials=[{"extensions": extension}], extensionsUsed=list(extension), **changes
    )
    document["meshes"][0]["primitives"][0]["material"] = 0
    write_glb(tmp_path / "x.glb", document, binary)
    asset = load(tmp_path / "x.glb")
    material = asset.meshes[0].material
    assert any("specular-glossiness" in note for note in asset.notes)
    if textured:
        assert material.base_color_texture is not None
        assert material.orm_texture is not None
        np.testing.assert_allclose(material.base_color_texture.linear()[0, 0], COLOR, atol=4e-3)
        np.testing.assert_allclose(material.orm_texture.linear()[0, 0, 1:], (0.25, 1), atol=2e-3)
    else:
        np.testing.assert_allclose(material.base_color, COLOR, atol=1e-5)
        np.testing.assert_allclose((material.roughness, material.metalness), (0.25, 1), atol=1e-5)
