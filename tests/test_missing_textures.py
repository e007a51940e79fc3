"""Textures that an asset names and that are not there: refused with the way out, or ignored with a
note."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import Asset, Texture, load, save
from appearance_opt.cli import main
from appearance_opt.errors import InputError

ROUGHNESS, METALNESS, COLOR = 0.25, 0.75, (0.5, 0.25, 0.125)


@pytest.fixture
def painted(ball: Asset) -> Asset:
    """All three kinds of textures, and factors that are not one."""
    mesh = ball.meshes[0]
    normal = Texture(np.full((4, 4, 3), (128, 128, 255), np.uint8))
    material = replace(
        mesh.material,
        base_color=COLOR,
        roughness=ROUGHNESS,
        metalness=METALNESS,
        normal_texture=normal,
    )
    return replace(ball, meshes=(replace(mesh, material=material),))


def written(asset: Asset, folder: Path, suffix: str) -> tuple[Path, list[Path]]:
    """A file without its pictures, and what their names were."""
    path = folder / f"ball{suffix}"
    save(asset, path)
    pictures = sorted(folder.rglob("*.png"))
    for picture in pictures:
        picture.unlink()
    return path, pictures


@pytest.mark.parametrize("suffix", [".gltf", ".obj", ".usda"])
def test_a_missing_texture_is_refused_with_the_way_out(
    tmp_path: Path, painted: Asset, suffix: str
) -> None:
    path, pictures = written(painted, tmp_path, suffix)
    with pytest.raises(
        InputError, match=r"which does not exist.*--missing-textures ignore"
    ) as caught:
        load(path)
    assert any(p.name in str(caught.value) for p in pictures)


@pytest.mark.parametrize("suffix", [".gltf", ".obj", ".usda"])
def test_ignored_textures_leave_the_factors_and_one_note_each(
    tmp_path: Path, painted: Asset, suffix: str
) -> None:
    path, pictures = written(painted, tmp_path, suffix)
    asset = load(path, missing_textures="ignore")
    material = asset.meshes[0].material
    assert material.base_color_texture is None
    assert material.orm_texture is None
    assert material.normal_texture is None
    if suffix != ".usda":  # there a texture replaces the constant, and its scale holds the factor
        np.testing.assert_allclose(material.base_color, COLOR, atol=1e-6)
        np.testing.assert_allclose(
            (material.roughness, material.metalness), (ROUGHNESS, METALNESS), atol=1e-6
        )
    assert len(pictures) >= 3
    for picture in pictures:
        assert sum(picture.name in note for note in asset.notes) == 1


def test_a_missing_material_file(tmp_path: Path) -> None:
    path = tmp_path / "x.obj"
    path.write_text("mtllib absent.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"absent\.mtl.*--missing-textures ignore"):
        load(path)
    asset = load(path, missing_textures="ignore")
    assert len(asset.meshes[0].faces) == 1
    assert sum("absent.mtl" in note for note in asset.notes) == 1


def test_a_material_without_a_name_is_the_default_one(tmp_path: Path) -> None:
    path = tmp_path / "x.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl \nf 1 2 3\n")
    assert len(load(path).meshes[0].faces) == 1


def test_textures_that_are_there_are_kept(tmp_path: Path, painted: Asset) -> None:
    save(painted, tmp_path / "ball.obj")
    next(tmp_path.glob("*_roughness.png")).unlink()
    material = load(tmp_path / "ball.obj", missing_textures="ignore").meshes[0].material
    assert material.base_color_texture is not None
    assert material.orm_texture is not None
    assert material.roughness == pytest.approx(ROUGHNESS, abs=1e-6)  # its constant
    assert (material.orm_texture.pixels[..., 1] == 255).all()
    assert material.metalness == 1.0  # the map's


def test_a_usd_texture_leaves_its_fallback(tmp_path: Path) -> None:
    path = tmp_path / "quad.usda"
    path.write_text(
        """#usda 1.0
(upAxis = "Y")
def Mesh "quad" (prepend apiSchemas = ["MaterialBindingAPI"])
{
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    rel material:binding = </m>
}
def Material "m"
{
    token outputs:surface.connect = </m/s.outputs:surface>
    def Shader "s"
    {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </m/t.outputs:rgb>
        float inputs:roughness = 0.9
        float inputs:roughness.connect = </m/t.outputs:g>
        float inputs:metallic.connect = </m/t.outputs:b>
        token outputs:surface
    }
    def Shader "t"
    {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @gone.png@
        float4 inputs:fallback = (0.1, 0.2, 0.3, 1)
        float3 outputs:rgb
        float outputs:g
        float outputs:b
    }
}
"""
    )
    asset = load(path, missing_textures="ignore")
    material = asset.meshes[0].material
    np.testing.assert_allclose(material.base_color, (0.1, 0.2, 0.3), atol=1e-6)
    assert material.roughness == pytest.approx(0.9)  # a value of its own comes before the fallback
    assert material.metalness == pytest.approx(0.3)
    assert sum("gone.png" in note for note in asset.notes if "USD:" not in note) == 1


def test_the_elephant_without_its_picture(assets_dir: Path) -> None:
    path = assets_dir / "elephant" / "SoC-ElephantWithMonochord.usdc"
    with pytest.raises(InputError, match=r"0/Monochord_diff\.png.*--missing-textures ignore"):
        load(path)
    asset = load(path, missing_textures="ignore")
    assert asset.triangle_count == 2762
    assert sum("Monochord_diff.png" in note for note in asset.notes) == 1


@pytest.mark.parametrize("command", ["inspect", "compare", "simplify", "bake"])
def test_every_command_takes_the_option(
    tmp_path: Path,
    painted: Asset,
    command: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    path, _ = written(painted, tmp_path, ".obj")
    quick = ["--texture-size", "32", "--out", str(tmp_path / "out.glb"), "--no-report"]
    rest = {
        "inspect": [],
        "compare": [str(path), "--views", "1", "--resolution", "16"],
        "simplify": ["--triangles", "200", "--steps", "0", *quick],
        "bake": [str(path), "--closed-form", *quick],
    }[command]
    words = ["appearance-opt", command, str(path), *rest, "--device", "cpu"]
    words = words[:-2] if command == "inspect" else words
    monkeypatch.setattr("sys.argv", words)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "--missing-textures ignore" in capsys.readouterr().err
    monkeypatch.setattr("sys.argv", [*words, "--missing-textures", "ignore"])
    main()
    printed = capsys.readouterr()
    notes = [line for line in (printed.out + printed.err).splitlines() if line.startswith("note:")]
    assert any("base_color.png', which does not exist: ignored" in note for note in notes)


def test_an_unknown_choice_is_refused(tmp_path: Path, painted: Asset) -> None:
    path, _ = written(painted, tmp_path, ".obj")
    with pytest.raises(InputError, match="choose from error, ignore"):
        load(path, missing_textures="maybe")  # type: ignore[arg-type]
