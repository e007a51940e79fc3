"""USD materials and bindings beyond the usual: specular workflow, opacity, several UV sets, sides,
colours, skins."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import images, load, save
from appearance_opt.asset.specular_glossiness import Specular, constants
from appearance_opt.asset.types import Asset, Material, Mesh
from tests.test_usd import TRIANGLE, textured, written

SPECULAR = "int inputs:useSpecularWorkflow = 1\nfloat inputs:roughness = 0.3\n"
DIFFUSE_MAP = "color3f inputs:diffuseColor.connect = </mat/t.outputs:rgb>\n"
GOLD, BROWN = (0.9, 0.6, 0.2), (0.2, 0.1, 0.05)


@pytest.mark.parametrize("specular", [GOLD, (0.04, 0.04, 0.04), (0, 0, 0)])
def test_the_specular_workflow_becomes_metallic(tmp_path: Path, specular: tuple) -> None:
    given = f"{SPECULAR}color3f inputs:diffuseColor = {BROWN}\ncolor3f inputs:specularColor = {specular}"
    asset = load(textured(tmp_path, given))
    material = asset.meshes[0].material
    color, _, metalness = constants(Specular(BROWN, specular, 1.0))
    np.testing.assert_allclose(material.base_color, color, atol=1e-6)
    assert (material.metalness, material.roughness) == pytest.approx((metalness, 0.3), abs=1e-6)
    assert any("specular workflow" in n for n in asset.notes)


def test_the_specular_workflow_with_textures(tmp_path: Path) -> None:
    """The picture is (64, 192, 255) / 255, linear."""
    given = f"{SPECULAR}color3f inputs:diffuseColor = (0, 0, 0)\n"
    given += "color3f inputs:specularColor.connect = </mat/t.outputs:rgb>"
    material = load(textured(tmp_path, given)).meshes[0].material
    tint = tuple(np.float32([64, 192, 255]) / 255)
    color, _, metalness = constants(Specular((0, 0, 0), tint, 1.0))
    np.testing.assert_allclose(material.base_color_texture.linear()[0, 0], color, atol=0.005)
    np.testing.assert_allclose(
        material.orm_texture.linear()[0, 0, 2] * material.metalness, metalness, atol=0.003
    )
    np.testing.assert_allclose(
        material.orm_texture.linear()[0, 0, 1] * material.roughness, 0.3, atol=1e-6
    )


@pytest.mark.parametrize(
    ("inputs", "mode", "opacity", "alpha"),
    [
        # the picture is (64, 192, 255) and has no alpha, which is 1 then
        ("float inputs:opacity.connect = </mat/t.outputs:r>", "blend", 1, 64 / 255),
        (
            "float inputs:opacity.connect = </mat/t.outputs:r>\nfloat inputs:opacityThreshold = 0.3",
            "mask",
            1,
            64 / 255,
        ),
        (
            "float inputs:opacity.connect = </mat/t.outputs:r>\nfloat inputs:opacityThreshold = 0.2",
            "opaque",
            1,
            None,
        ),
        ("float inputs:opacity.connect = </mat/t.outputs:a>", "opaque", 1, None),
        ("float inputs:opacity = 0.5", "blend", 0.5, None),
        ("float inputs:opacity = 0.5\nfloat inputs:opacityThreshold = 0.4", "opaque", 1, None),
        ("float inputs:opacity = 1\nfloat inputs:opacityThreshold = 0.4", "opaque", 1, None),
    ],
)
def test_opacity_becomes_alpha(
    tmp_path: Path, inputs: str, mode: str, opacity: float, alpha: float | None
) -> None:
    path = textured(tmp_path, inputs)
    path.write_text(
        path.read_text().replace("float outputs:r\n", "float outputs:r\nfloat outputs:a\n")
    )
    material = load(path).meshes[0].material
    assert (material.alpha_mode, material.opacity) == (mode, opacity)
    if alpha is not None:
        np.testing.assert_allclose(material.base_color_texture.linear()[..., 3], alpha, atol=1e-6)
        np.testing.assert_allclose(material.base_color_texture.linear()[..., :3], 1)


def test_scale_and_bias_of_opacity_count(tmp_path: Path) -> None:
    inputs = "float inputs:opacity.connect = </mat/t.outputs:r>\ncolor3f inputs:diffuseColor = (0.2, 0.4, 0.6)"
    sampler = "float4 inputs:scale = (0.5, 1, 1, 1)\nfloat4 inputs:bias = (0.25, 0, 0, 0)"
    material = load(textured(tmp_path, inputs, sampler)).meshes[0].material
    np.testing.assert_allclose(
        material.base_color_texture.linear()[..., 3], 0.25 + 32 / 255, atol=1e-6
    )
    np.testing.assert_allclose(material.base_color, (0.2, 0.4, 0.6), atol=1e-6)


def material(name: str, varname: str) -> str:
    return f"""def Material "{name}" {{
    token outputs:surface.connect = </{name}/s.outputs:surface>
    def Shader "s" {{
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </{name}/t.outputs:rgb>
        token outputs:surface
    }}
    def Shader "reader" {{
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "{varname}"
        float2 outputs:result
    }}
    def Shader "t" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @t.png@
        float2 inputs:st.connect = </{name}/reader.outputs:result>
        float3 outputs:rgb
    }}
}}
"""


def test_each_subset_has_its_own_texture_coordinates(tmp_path: Path) -> None:
    (tmp_path / "t.png").write_bytes(images.encode_png(np.zeros((2, 2, 3), np.uint8)))
    mesh = """def Mesh "m" {
    int[] faceVertexCounts = [3, 3]
    int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
    uniform token subdivisionScheme = "none"
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    texCoord2f[] primvars:first = [(0.1, 0), (0.1, 0), (0.1, 0), (0.1, 0)] (interpolation = "vertex")
    texCoord2f[] primvars:second = [(0.7, 0), (0.7, 0), (0.7, 0), (0.7, 0)] (interpolation = "vertex")
    uniform token subsetFamily:materialBind:familyType = "partition"
    def GeomSubset "a" (prepend apiSchemas = ["MaterialBindingAPI"]) {
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [0]
        rel material:binding = </one>
    }
    def GeomSubset "b" (prepend apiSchemas = ["MaterialBindingAPI"]) {
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [1]
        rel material:binding = </two>
    }
}
"""
    asset = load(written(tmp_path, material("one", "first") + material("two", "second") + mesh))
    assert [float(m.uvs[0, 0]) for m in asset.meshes] == pytest.approx([0.1, 0.7])
    assert any("first, second" in n for n in asset.notes)


@pytest.mark.parametrize("double", [True, False])
def test_sides_are_those_of_the_mesh(tmp_path: Path, ball: Asset, double: bool) -> None:
    path = textured(tmp_path, DIFFUSE_MAP)
    if double:
        path.write_text(
            path.read_text().replace(
                "rel material", "uniform bool doubleSided = 1\n    rel material"
            )
        )
    assert load(path).meshes[0].material.double_sided is double
    mesh = replace(ball.meshes[0], material=replace(ball.meshes[0].material, double_sided=double))
    save(Asset((mesh,)), tmp_path / "y.usda")
    assert load(tmp_path / "y.usda").meshes[0].material.double_sided is double


def test_sides_do_not_cost_a_texture_its_transform(tmp_path: Path) -> None:
    mesh = load(textured(tmp_path, DIFFUSE_MAP, st="move.outputs:result")).meshes[0]
    assert not mesh.material.double_sided
    np.testing.assert_allclose(np.ptp(mesh.uvs, axis=0), 0.5, atol=1e-6)


def test_vertex_colours_survive_a_round_trip(tmp_path: Path) -> None:
    """One material, of a mesh with colours and of one without."""
    colors = np.array([[0.1, 0.5, 1], [0, 0.002, 0.9], [1, 0.25, 0.3]], np.float32)
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    mesh = Mesh(
        positions, np.array([[0, 1, 2]], np.int32), material=Material(base_color=(0.5, 1.0, 0.25))
    )
    save(Asset((replace(mesh, colors=colors), mesh)), tmp_path / "x.usda")
    colored, plain = load(tmp_path / "x.usda").meshes
    at = [int(np.flatnonzero((colored.positions == p).all(axis=1))[0]) for p in positions]
    got = colored.colors[at] * np.float32(colored.material.base_color)
    np.testing.assert_allclose(got, colors * np.float32([0.5, 1, 0.25]), atol=1e-6)
    assert plain.colors is None
    np.testing.assert_allclose(plain.material.base_color, (0.5, 1, 0.25), atol=1e-6)


def test_skinned_meshes_keep_their_bind_pose(tmp_path: Path) -> None:
    """The mesh's own transform does not count; geomBindTransform leads into the skeleton's
    frame."""
    text = f"""def SkelRoot "figure" {{
    double3 xformOp:translate = (0, 0, 10)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Skeleton "skeleton" {{
        uniform token[] joints = ["a"]
        uniform matrix4d[] bindTransforms = [((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))]
        uniform matrix4d[] restTransforms = [((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))]
    }}
    def Mesh "m" (prepend apiSchemas = ["SkelBindingAPI"]) {{
        {TRIANGLE}
        rel skel:skeleton = </figure/skeleton>
        rel skel:blendShapeTargets = </figure/m/smile>
        uniform token[] skel:blendShapes = ["smile"]
        int[] primvars:skel:jointIndices = [0, 0, 0] (interpolation = "vertex"; elementSize = 1)
        float[] primvars:skel:jointWeights = [1, 1, 1] (interpolation = "vertex"; elementSize = 1)
        matrix4d primvars:skel:geomBindTransform = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 5, 0, 1))
        double3 xformOp:translate = (100, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
}}
"""
    asset = load(written(tmp_path, text))
    np.testing.assert_allclose(asset.meshes[0].positions.min(axis=0), [0, 5, 10])
    assert "'/figure/m': the bind pose is kept; `appearance-opt animate` keeps skins" in asset.notes
    assert any(
        note.startswith("'/figure/m': blend shapes: the shape of their default")
        for note in asset.notes
    )
