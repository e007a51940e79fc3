"""What a texture means stays what it means: every pixel type and encoding, through every writer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import images, load, save
from appearance_opt.asset.encoding import encoded_for
from appearance_opt.asset.packing import pack_orm
from appearance_opt.asset.types import Asset, Material, Texture

SCALES = {"uint8": 255, "uint16": 65535, "float32": 1}


def texture(kind: str, space: str) -> Texture:
    """Stored values 0, 0.25, 0.5 and 1."""
    values = np.repeat(np.float32([0, 0.25, 0.5, 1]).reshape(2, 2, 1), 3, axis=2) * SCALES[kind]
    return Texture(values.round() if kind != "float32" else values, space)  # type: ignore[arg-type]


def stored(kind: str, space: str) -> Texture:
    t = texture(kind, space)
    return replace(t, pixels=t.pixels.astype(kind))


@pytest.mark.parametrize("suffix", [".glb", ".usda", ".obj"])
@pytest.mark.parametrize("space", ["srgb", "linear"])
@pytest.mark.parametrize("kind", SCALES)
def test_a_round_trip_keeps_linear_values(
    tmp_path: Path, ball: Asset, suffix: str, space: str, kind: str
) -> None:
    given = stored(kind, space)
    material = Material(
        "m", metalness=1.0, base_color_texture=given, orm_texture=given, normal_texture=given,
        emission=(1.0, 1.0, 1.0), emission_texture=given,
    )  # fmt: skip
    save(Asset((replace(ball.meshes[0], material=material),)), tmp_path / f"x{suffix}")
    again = load(tmp_path / f"x{suffix}").meshes[0].material
    slots = ("base_color_texture", "normal_texture", "emission_texture")
    for got, channels in (
        *((getattr(again, n), slice(3)) for n in slots),
        (again.orm_texture, slice(1, 3)),
    ):
        # half a step of eight bits in either encoding: measured 0.0021 and 0.0023
        np.testing.assert_allclose(
            got.linear()[..., channels], given.linear()[..., channels], atol=0.0035
        )


def test_integers_in_the_slot_s_encoding_are_not_touched() -> None:
    given = stored("uint16", "srgb")
    assert encoded_for(given, "srgb") is given.pixels
    assert encoded_for(given, "linear").dtype == np.uint16


def test_alpha_is_linear_in_every_slot() -> None:
    half = Texture(np.full((1, 1, 4), 0.5, np.float32), "linear")
    np.testing.assert_array_equal(encoded_for(half, "srgb")[0, 0], [188, 188, 188, 128])


def test_roughness_that_a_file_calls_srgb_is_decoded() -> None:
    """A sampler of USD may say so, wrong as it mostly is."""
    dark = Texture(np.full((2, 2, 1), 128, np.uint8), "srgb")
    np.testing.assert_allclose(pack_orm(dark, None).linear()[..., 1], dark.linear()[..., 0])
    assert pack_orm(replace(dark, color_space="linear"), None).pixels.dtype == np.uint8


STAGE = """#usda 1.0
(metersPerUnit = 1
upAxis = "Y")
def Material "mat" {{
    token outputs:surface.connect = </mat/s.outputs:surface>
    def Shader "s" {{
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </mat/t.outputs:rgb>
        token outputs:surface
    }}
    def Shader "t" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @{file}@
        {space}
        float3 outputs:rgb
    }}
}}
def Mesh "m" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
    rel material:binding = </mat>
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    uniform token subdivisionScheme = "none"
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
}}
"""


@pytest.mark.parametrize(
    ("file", "space", "expected"),
    [
        ("t.exr", "", 0.5),
        ("t.exr", 'token inputs:sourceColorSpace = "auto"', 0.5),
        ("t.exr", 'token inputs:sourceColorSpace = "sRGB"', 0.214),
        ("rgb8.png", "", 0.216),
        ("rgb8.png", 'token inputs:sourceColorSpace = "raw"', 0.502),
        ("rgba8.png", "", 0.216),
        ("grey8.png", "", 0.502),
        ("rgb16.png", "", 0.5),
    ],
)
def test_auto_is_srgb_for_eight_bits_of_colour_alone(
    tmp_path: Path, file: str, space: str, expected: float
) -> None:
    """UsdPreviewSurface specification, UsdUVTexture, sourceColorSpace."""
    (tmp_path / "t.exr").write_bytes(images.encode_exr(np.full((2, 2, 3), 0.5, np.float32)))
    for name, channels, kind in (
        ("rgb8", 3, np.uint8),
        ("rgba8", 4, np.uint8),
        ("grey8", 1, np.uint8),
    ):
        (tmp_path / f"{name}.png").write_bytes(
            images.encode_png(np.full((2, 2, channels), 128, kind))
        )
    (tmp_path / "rgb16.png").write_bytes(images.encode_png(np.full((2, 2, 3), 32768, np.uint16)))
    (tmp_path / "x.usda").write_text(STAGE.format(file=file, space=space))
    material = load(tmp_path / "x.usda").meshes[0].material
    np.testing.assert_allclose(material.base_color_texture.linear()[..., :3], expected, atol=1e-3)
