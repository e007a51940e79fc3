"""Textures in tiles (UDIM): each tile's faces get its picture, in every format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import Asset, images, load, udim
from appearance_opt.asset.companions import Companions
from appearance_opt.asset.types import Texture
from appearance_opt.errors import InputError

COLORS = {1001: (255, 0, 0), 1002: (0, 255, 0), 1011: (0, 0, 255)}
QUADS = {1001: (0, 0), 1002: (1, 0), 1011: (0, 1)}


def tiles(folder: Path, name: str = "t_{}.png", of=COLORS, names=str) -> None:
    """Pictures of one colour each, but for a white lower left quarter."""
    for number, color in of.items():
        pixels = np.full((8, 8, 3), color, np.uint8)
        pixels[4:, :4] = 255
        (folder / name.format(names(number))).write_bytes(images.encode_png(pixels))


def obj(folder: Path, texture: str, quads=QUADS, inset: float = 0.0) -> Path:
    """A quad for each tile, over its whole square of the texture coordinates."""
    lines = ["mtllib x.mtl", "usemtl m"]
    for k, (u, v) in enumerate(quads.values()):
        for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)):
            lines.append(f"v {u + x} {v + y} 0")
            lines.append(f"vt {u + x * (1 - 2 * inset) + inset} {v + y * (1 - 2 * inset) + inset}")
        lines.append("f " + " ".join(f"{4 * k + i}/{4 * k + i}" for i in (1, 2, 3, 4)))
    (folder / "x.obj").write_text("\n".join(lines) + "\n")
    (folder / "x.mtl").write_text(f"newmtl m\nKd 0.5 0.25 0.125\nmap_Kd {texture}\n")
    return folder / "x.obj"


def usd(folder: Path, texture: str, scale: float = 1.0) -> Path:
    points, uvs, counts = [], [], []
    for u, v in QUADS.values():
        for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)):
            points.append((float(u + x), float(v + y), 0.0))
            uvs.append(((u + x) / scale, (v + y) / scale))
        counts.append(4)
    (folder / "x.usda").write_text(f"""#usda 1.0
(
    defaultPrim = "R"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "R"
{{
    def Material "m"
    {{
        token outputs:surface.connect = </R/m/s.outputs:surface>
        def Shader "s"
        {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </R/m/t.outputs:rgb>
            token outputs:surface
        }}
        def Shader "t"
        {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{texture}@
            float2 inputs:st.connect = </R/m/move.outputs:result>
            float3 outputs:rgb
        }}
        def Shader "move"
        {{
            uniform token info:id = "UsdTransform2d"
            float2 inputs:in.connect = </R/m/st.outputs:result>
            float2 inputs:scale = ({scale}, {scale})
            float2 outputs:result
        }}
        def Shader "st"
        {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }}
    }}
    def Mesh "q" (prepend apiSchemas = ["MaterialBindingAPI"])
    {{
        uniform bool doubleSided = 1
        int[] faceVertexCounts = {counts}
        int[] faceVertexIndices = {list(range(len(points)))}
        point3f[] points = {points}
        texCoord2f[] primvars:st = {uvs} (interpolation = "vertex")
        uniform token subdivisionScheme = "none"
        rel material:binding = </R/m>
    }}
}}
""")
    return folder / "x.usda"


def check(asset: Asset) -> None:
    """Does each quad show its tile, the white quarter at its lower left?"""
    assert len(asset.meshes) == 3
    for mesh in asset.meshes:
        column, row = (int(x) for x in mesh.positions.min(axis=0)[:2])
        assert mesh.uvs is not None
        np.testing.assert_allclose(mesh.uvs[:, 0], mesh.positions[:, 0] - column, atol=1e-6)
        np.testing.assert_allclose(mesh.uvs[:, 1], 1 - (mesh.positions[:, 1] - row), atol=1e-6)
        texture = mesh.material.base_color_texture
        assert texture is not None
        assert tuple(texture.pixels[0, 0]) == COLORS[1001 + column + 10 * row]
        assert tuple(texture.pixels[7, 0]) == (255, 255, 255)
        assert len(mesh.positions) == 4
    assert sum(len(m.faces) for m in asset.meshes) == 6


def test_tiles_of_an_obj_file(tmp_path: Path) -> None:
    tiles(tmp_path)
    check(load(obj(tmp_path, "t_<UDIM>.png")))


def test_tiles_named_by_column_and_row(tmp_path: Path) -> None:
    tiles(tmp_path, names=lambda n: f"u{(n - 1001) % 10 + 1}_v{(n - 1001) // 10 + 1}")
    check(load(obj(tmp_path, "t_<UVTILE>.png")))


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_tiles_of_a_usd_file(tmp_path: Path, scale: float) -> None:
    (tmp_path / "maps").mkdir()
    tiles(tmp_path / "maps")
    asset = load(usd(tmp_path, "maps/t_<UDIM>.png", scale))
    check(asset)
    assert all(m.material.double_sided for m in asset.meshes)


def test_tiles_in_a_usdz_package(tmp_path: Path) -> None:
    from pxr import Sdf, UsdUtils

    tiles(tmp_path)
    usd(tmp_path, "t_<UDIM>.png")
    package = tmp_path / "out" / "x.usdz"
    package.parent.mkdir()
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(tmp_path / "x.usda")), str(package))
    check(load(package))


def test_a_missing_tile_is_noted_and_leaves_the_constants(tmp_path: Path) -> None:
    tiles(tmp_path, of={n: c for n, c in COLORS.items() if n != 1002})
    asset = load(obj(tmp_path, "t_<UDIM>.png"))
    (lost,) = (m for m in asset.meshes if m.material.base_color_texture is None)
    assert lost.material.base_color == (0.5, 0.25, 0.125)
    assert [n for n in asset.notes if "t_1002.png" in n and "does not exist" in n]


def test_no_tile_at_all_is_a_missing_texture(tmp_path: Path) -> None:
    path = obj(tmp_path, "t_<UDIM>.png")
    with pytest.raises(InputError, match=r"t_<UDIM>\.png.*no tile.*--missing-textures ignore"):
        load(path)
    assert all(
        m.material.base_color_texture is None for m in load(path, missing_textures="ignore").meshes
    )
    with pytest.raises(InputError, match=r"t_<UDIM>\.png.*no tile"):
        load(usd(tmp_path, "t_<UDIM>.png"))


def test_faces_that_cross_tiles_are_counted_and_those_outside_keep_the_constants(
    tmp_path: Path,
) -> None:
    tiles(tmp_path)
    asset = load(obj(tmp_path, "t_<UDIM>.png", {0: (0.25, 0), 1: (-3, 0)}))
    assert [n for n in asset.notes if "2 faces cross the border of a tile" in n]
    assert sorted(m.material.base_color_texture is None for m in asset.meshes) == [False, True]


def test_many_tiles_are_read_smaller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udim, "MAX_TEXELS", 3 * 20)
    tiles(tmp_path)
    asset = load(obj(tmp_path, "t_<UDIM>.png"))
    texture = asset.meshes[0].material.base_color_texture
    assert texture is not None
    assert texture.pixels.shape == (4, 4, 3)
    assert tuple(texture.pixels[0, 0]) == COLORS[1001]
    assert tuple(texture.pixels[3, 0]) == (255, 255, 255)
    assert [n for n in asset.notes if "1/2 of their size" in n]


def test_smaller_tiles_are_means_of_linear_values() -> None:
    pixels = np.zeros((2, 2, 4), np.uint8)
    pixels[0] = 255
    out = udim.fit_to_tile(Texture(pixels, "srgb"), udim.Tile(1001, 1), Companions())
    assert out.pixels.shape == (1, 1, 4)
    assert tuple(out.pixels[0, 0]) == (188, 188, 188, 128)  # alpha is linear
