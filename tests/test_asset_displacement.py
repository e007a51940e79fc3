"""Height maps in files: 16-bit PNG, EXR, USD, glTF's companion."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from appearance_opt.asset import load, save
from appearance_opt.asset.height import displacement_of, height_exr, height_png, heights_of
from appearance_opt.asset.images import decode
from appearance_opt.asset.types import Asset


@pytest.fixture
def heights() -> np.ndarray:
    rng = np.random.default_rng(0)
    out = rng.uniform(-0.02, 0.03, (16, 16)).astype(np.float32)
    out[0, 0] = 0
    return out


def test_16_bits_hold_heights_to_half_a_step(heights: np.ndarray) -> None:
    d = displacement_of(heights)
    # half a step of 1 / 65535, and float32's rounding of metres (measured 1.00)
    assert np.abs(heights_of(d) - heights).max() <= 1.01 * d.scale / 131070
    assert heights_of(d)[0, 0] == 0
    np.testing.assert_array_equal(heights_of(displacement_of(np.zeros((4, 4), np.float32))), 0)


def test_files_carry_scale_and_mid_level(heights: np.ndarray, tmp_path: Path) -> None:
    d = displacement_of(heights)
    for name, data, scale, mid in (
        ("h.png", height_png(d), d.scale, d.mid),
        ("h.exr", height_exr(heights), 1.0, 0.0),
    ):
        (tmp_path / name).write_bytes(data)
        spec = oiio.ImageInput.open(str(tmp_path / name)).spec()
        assert float(spec.getattribute("DisplacementScale")) == pytest.approx(scale, rel=1e-6)
        assert float(spec.getattribute("DisplacementMidLevel")) == pytest.approx(mid, rel=1e-6)
    assert decode(height_png(d), "h.png").dtype == np.uint16
    np.testing.assert_array_equal(decode(height_exr(heights), "h.exr")[..., 0], heights)


def displaced(ball: Asset, heights: np.ndarray) -> Asset:
    mesh = ball.meshes[0]
    material = replace(mesh.material, displacement=displacement_of(heights), has_occlusion=True)
    return replace(ball, meshes=(replace(mesh, material=material),))


def test_gltf_names_its_companion(ball: Asset, heights: np.ndarray, tmp_path: Path) -> None:
    asset = displaced(ball, heights)
    save(asset, tmp_path / "my ball.gltf")
    material = json.loads((tmp_path / "my ball.gltf").read_text())["materials"][0]
    entry = material["extras"]["displacement"]
    assert entry["uri"] == "my%20ball_displacement.png"
    pixels = decode((tmp_path / "my ball_displacement.png").read_bytes(), "companion")
    found = (pixels[..., 0] / 65535 - entry["midLevel"]) * entry["scale"]
    np.testing.assert_allclose(found, heights, atol=1.01 * entry["scale"] / 131070)
    assert (
        material["occlusionTexture"] == material["pbrMetallicRoughness"]["metallicRoughnessTexture"]
    )
    assert load(tmp_path / "my ball.gltf").triangle_count == asset.triangle_count


def test_usd_displacement_is_in_scene_units(
    ball: Asset, heights: np.ndarray, tmp_path: Path
) -> None:
    from pxr import Usd, UsdShade

    save(displaced(ball, heights), tmp_path / "ball.usda")
    stage = Usd.Stage.Open(str(tmp_path / "ball.usda"))
    shaders = [UsdShade.Shader(p) for p in stage.Traverse() if p.IsA(UsdShade.Shader)]
    surface = next(s for s in shaders if s.GetIdAttr().Get() == "UsdPreviewSurface")
    source, output, _ = surface.GetInput("displacement").GetConnectedSource()
    sampler = UsdShade.Shader(source.GetPrim())
    assert output == "r" and surface.GetInput("occlusion").GetConnectedSource()[1] == "r"
    scale, bias = (sampler.GetInput(n).Get()[0] for n in ("scale", "bias"))
    pixels = decode((tmp_path / sampler.GetInput("file").Get().path).read_bytes(), "companion")
    # scale and bias are stored as float32
    np.testing.assert_allclose(
        pixels[..., 0] / 65535 * scale + bias, heights, atol=1.02 * scale / 131070
    )
    material = next(UsdShade.Material(p) for p in stage.Traverse() if p.IsA(UsdShade.Material))
    assert material.GetDisplacementOutput().HasConnectedSource()
