"""What of a file's shapes is drawn: default morph weights, scenes and their roots, holes,
opacity."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import load, save
from appearance_opt.asset.normals import unit
from appearance_opt.asset.types import Asset
from appearance_opt.errors import InputError
from appearance_opt.reference.mesh import merge
from tests.conftest import make_asset
from tests.test_asset_gltf import triangle_document, write_glb
from tests.test_asset_gltf_nodes import ball, document


def sparse(
    given: dict, binary: bytes, count: int, where: np.ndarray, values: np.ndarray
) -> tuple[dict, bytes, int]:
    """The document with one accessor more: zeros, but for ``values`` (N, 3) at the indices
    ``where`` (N,)."""
    first = len(given["bufferViews"])
    for data in (where.astype(np.uint32), values.astype(np.float32)):
        given["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(binary), "byteLength": data.nbytes}
        )
        binary += data.tobytes()
    given["buffers"][0]["byteLength"] = len(binary)
    indices = {"bufferView": first, "componentType": 5125}
    given["accessors"].append(
        {
            "componentType": 5126,
            "count": count,
            "type": "VEC3",
            "sparse": {
                "count": len(where),
                "indices": indices,
                "values": {"bufferView": first + 1},
            },
        }
    )
    return given, binary, len(given["accessors"]) - 1


@pytest.mark.parametrize("where", ["mesh", "node"])
def test_default_morph_weights_are_part_of_the_shape(tmp_path: Path, where: str) -> None:
    positions, faces = ball(1)
    count = len(positions)
    tangents = np.tile(np.array([[1, 0, 0, -1]], np.float32), (count, 1))
    rng = np.random.default_rng(0)
    moved, turned, along = (rng.normal(size=(count, 3)).astype(np.float32) for _ in range(3))
    attributes = {"POSITION": positions, "NORMAL": positions, "TANGENT": tangents}
    given, binary = document(attributes, faces, (moved, turned, along))
    few = np.array([1, 5, 7])
    given, binary, second = sparse(given, binary, count, few, moved[few])
    targets = [{"POSITION": 3, "NORMAL": 4, "TANGENT": 5}, {"POSITION": second}, {"POSITION": 4}]
    given["meshes"][0]["primitives"][0]["targets"] = targets
    given["meshes"][0]["weights"] = [0.5, 2.0, 0.0] if where == "mesh" else [9.0, 9.0, 9.0]
    if where == "node":
        given["nodes"][0]["weights"] = [0.5, 2.0, 0.0]
    write_glb(tmp_path / "x.glb", given, binary)
    asset = load(tmp_path / "x.glb")
    want = positions + 0.5 * moved
    want[few] += 2.0 * moved[few]
    mesh = asset.meshes[0]
    np.testing.assert_allclose(mesh.positions, want, atol=1e-6)
    np.testing.assert_allclose(mesh.normals, unit(positions + 0.5 * turned), atol=1e-6)
    np.testing.assert_allclose(mesh.tangents[:, :3], unit(tangents[:, :3] + 0.5 * along), atol=1e-6)
    np.testing.assert_array_equal(mesh.tangents[:, 3], -1)
    assert any("default weights" in note for note in asset.notes)


def test_flat_normals_are_those_of_the_morphed_shape(tmp_path: Path) -> None:
    given, binary = triangle_document()
    given["meshes"][0] |= {"weights": [1.0]}
    given["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 1}]
    given, binary, _ = sparse(given, binary, 3, np.array([1]), np.array([[0.0, 0, 1]]))
    write_glb(tmp_path / "x.glb", given, binary)
    mesh = load(tmp_path / "x.glb").meshes[0]
    np.testing.assert_allclose(
        mesh.normals, np.tile(unit(np.array([-1.0, 0, 1])), (3, 1)), atol=1e-6
    )


def test_a_morph_target_of_another_length_is_refused(tmp_path: Path) -> None:
    given, binary = triangle_document()
    given["meshes"][0] |= {"weights": [1.0]}
    given["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 1}]
    given, binary, _ = sparse(given, binary, 2, np.array([1]), np.array([[0.0, 0, 1]]))
    write_glb(tmp_path / "x.glb", given, binary)
    with pytest.raises(InputError, match="moves 2 vertices of 3"):
        load(tmp_path / "x.glb")


def test_without_scenes_every_mesh_is_drawn_once(tmp_path: Path) -> None:
    given, binary = triangle_document(
        nodes=[{"mesh": 0}, {"children": [0], "translation": [5, 0, 0]}, {"mesh": 0}]
    )
    del given["scenes"], given["scene"]
    write_glb(tmp_path / "x.glb", given, binary)
    meshes = load(tmp_path / "x.glb").meshes
    assert sorted(float(m.positions[:, 0].min()) for m in meshes) == [0, 5]


@pytest.mark.parametrize(("given", "taken", "place"), [({}, "left", 0), ({"scene": 1}, "right", 5)])
def test_the_scene_that_is_taken_is_named(
    tmp_path: Path, given: dict, taken: str, place: int
) -> None:
    changed, binary = triangle_document(
        nodes=[{"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}],
        scenes=[{"nodes": [0], "name": "left"}, {"nodes": [1], "name": "right"}],
    )
    del changed["scene"]
    write_glb(tmp_path / "x.glb", {**changed, **given}, binary)
    asset = load(tmp_path / "x.glb")
    assert [float(m.positions[:, 0].min()) for m in asset.meshes] == [place]
    other = {"left": "right", "right": "left"}[taken]
    assert f"scene '{taken}' is taken, others ignored: '{other}'" in asset.notes


SQUARES = (
    "int[] faceVertexCounts = [4, 4]\nint[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]\n"
    "point3f[] points = [(0, 0, 0), (1, 0, 0), (2, 0, 1), (0, 1, 0), (1, 1, 0), (2, 1, 1)]\n"
)
"""Two squares side by side, folded where they meet by 45 degrees."""


def usd(folder: Path, text: str, more: str = "", **options: object) -> Asset:
    """A stage with one mesh of these squares."""
    path = folder / "x.usda"
    path.write_text(
        f'#usda 1.0\n(upAxis = "Y"\nmetersPerUnit = 1)\n{more}def Mesh "m"\n{{\n{SQUARES}{text}\n}}\n'
    )
    return load(path, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("scheme", "each"), [("none", 2), ("catmullClark", 8)])
def test_holes_are_not_drawn(tmp_path: Path, scheme: str, each: int) -> None:
    text = f'uniform token subdivisionScheme = "{scheme}"\nint[] holeIndices = [0]'
    mesh = usd(tmp_path, text).meshes[0]
    assert len(mesh.faces) == each
    whole = usd(tmp_path, f'uniform token subdivisionScheme = "{scheme}"').meshes[0]
    # a hole shapes what lies around it
    assert set(map(tuple, mesh.positions.tolist())) <= set(map(tuple, whole.positions.tolist()))
    assert mesh.positions[:, 0].min() >= 0.9


FOLDED = np.array([[0, 0, 1], [-(0.5**0.5), 0, 0.5**0.5]])


@pytest.mark.parametrize("scheme", ["none", "bilinear"])
@pytest.mark.parametrize(
    ("more", "sign"), [("", 1), ('uniform token orientation = "leftHanded"', -1)]
)
def test_a_polygonal_mesh_without_normals_is_faceted(
    tmp_path: Path, scheme: str, more: str, sign: int
) -> None:
    mesh = usd(tmp_path, f'uniform token subdivisionScheme = "{scheme}"\n{more}').meshes[0]
    np.testing.assert_allclose(mesh.normals[mesh.faces[::2, 0]], sign * FOLDED, atol=1e-6)
    np.testing.assert_allclose(mesh.normals[mesh.faces[1::2, 0]], sign * FOLDED, atol=1e-6)
    assert len(mesh.positions) == 8
    p = mesh.positions[mesh.faces].astype(np.float64)
    wound = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert (np.sum(wound * mesh.normals[mesh.faces[:, 0]], axis=1) > 0).all()


def test_a_mesh_to_be_baked_onto_keeps_its_vertices(tmp_path: Path) -> None:
    mesh = usd(tmp_path, 'uniform token subdivisionScheme = "none"', keep_layout=True).meshes[0]
    assert mesh.normals is None
    assert len(mesh.positions) == 6


READER = """def Material "glass"
{
    token outputs:surface.connect = </glass/Surface.outputs:surface>
    def Shader "Surface"
    {
        uniform token info:id = "UsdPreviewSurface"
        float inputs:opacity.connect = </glass/veil.outputs:result>
        float inputs:opacityThreshold = THRESHOLD
        token outputs:surface
    }
    def Shader "veil"
    {
        uniform token info:id = "UsdPrimvarReader_float"
        string inputs:varname = "displayOpacity"
        float outputs:result
    }
}
"""


@pytest.mark.parametrize(
    ("how", "values", "alpha"),
    [
        ("constant", "[0.25]", [0.25] * 6),
        ("vertex", "[0, 0.2, 0.4, 0.6, 0.8, 1]", [0, 0.2, 0.4, 0.6, 0.8, 1]),
    ],
)
@pytest.mark.parametrize(("bound", "mode"), [(None, "blend"), ("0", "blend"), ("0.5", "mask")])
def test_display_opacity_is_kept(
    tmp_path: Path, how: str, values: str, alpha: list[float], bound: str | None, mode: str
) -> None:
    text = f'float[] primvars:displayOpacity = {values} (interpolation = "{how}")\n'
    text += 'uniform token subdivisionScheme = "none"\n'
    if bound:
        text += "rel material:binding = </glass>"
    asset = usd(tmp_path, text, READER.replace("THRESHOLD", bound) if bound else "")
    for again in (asset, written(asset, tmp_path / "y.usda"), written(asset, tmp_path / "y.glb")):
        mesh = again.meshes[0]
        assert mesh.material.alpha_mode == mode
        assert mesh.colors is not None
        got = {
            tuple(p): a
            for p, a in zip(mesh.positions.tolist(), mesh.colors[:, 3].tolist(), strict=True)
        }
        points = [(0, 0, 0), (1, 0, 0), (2, 0, 1), (0, 1, 0), (1, 1, 0), (2, 1, 1)]
        np.testing.assert_allclose([got[p] for p in points], alpha, atol=1e-6)


def written(asset: Asset, path: Path) -> Asset:
    """The asset after it was written and read."""
    save(asset, path)
    return load(path)


@pytest.mark.parametrize("bound", [False, True])
def test_display_opacity_that_says_nothing_changes_nothing(tmp_path: Path, bound: bool) -> None:
    text = 'float[] primvars:displayOpacity = [1] (interpolation = "constant")\n'
    if bound:  # by a material that does not read it
        text = text.replace("[1]", "[0.5]") + "rel material:binding = </plain>\n"
    more = 'def Material "plain"\n{\n}\n' if bound else ""
    mesh = usd(tmp_path, text + 'uniform token subdivisionScheme = "none"', more).meshes[0]
    assert mesh.material.alpha_mode == "opaque"
    assert mesh.colors is None


def test_colours_with_and_without_alpha_are_drawn_together() -> None:
    ball = make_asset(8, 16)
    mesh = ball.meshes[0]
    count = len(mesh.positions)
    both = tuple(replace(mesh, colors=np.ones((count, width), np.float32)) for width in (3, 4))
    merged = merge(replace(ball, meshes=both), [0, 0], False)
    np.testing.assert_array_equal(merged.colors, np.ones((2 * count, 4)))


FACE = """#usda 1.0
(upAxis = "Y"
metersPerUnit = 1)
def SkelRoot "root"
{
    def Skeleton "skeleton" (prepend apiSchemas = ["SkelBindingAPI"])
    {
        rel skel:animationSource = </root/animation>
    }
    def SkelAnimation "animation"
    {
        uniform token[] blendShapes = ["up", "unused", "side"]
        float[] blendShapeWeights = [0.5, 3, 0.25]
        float[] blendShapeWeights.timeSamples = { 1: [9, 9, 9] }
    }
    def Mesh "m" (prepend apiSchemas = ["SkelBindingAPI"])
    {
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        normal3f[] normals = [(0, 0, 1), (0, 0, 1), (0, 0, 1)] (interpolation = "HOW")
        uniform token subdivisionScheme = "none"
        uniform token[] skel:blendShapes = ["side", "up"]
        rel skel:blendShapeTargets = [</root/m/side>, </root/m/up>]
        rel skel:skeleton = </root/skeleton>
        def BlendShape "up"
        {
            vector3f[] offsets = [(0, 0, 2)]
            vector3f[] normalOffsets = [(2, 0, 0)]
            int[] pointIndices = [1]
        }
        def BlendShape "side"
        {
            vector3f[] offsets = [(4, 0, 0), (4, 0, 0), (4, 0, 0)]
            vector3f[] inbetweens:half = [(0, 0, 0), (0, 0, 0), (0, 8, 0)] (weight = 0.5)
        }
    }
}
"""


@pytest.mark.parametrize("how", ["vertex", "faceVarying"])
def test_default_weights_of_blend_shapes_are_part_of_the_shape(tmp_path: Path, how: str) -> None:
    path = tmp_path / "x.usda"
    path.write_text(FACE.replace("HOW", how))
    asset = load(path)
    mesh = asset.meshes[0]
    corner = mesh.faces[0]
    # the weight 0.25 of "side" is half of its in-between shape
    np.testing.assert_allclose(mesh.positions[corner], [[0, 0, 0], [1, 0, 1], [0, 5, 0]], atol=1e-6)
    tilted = np.array([1, 0, 1]) / 2**0.5
    np.testing.assert_allclose(mesh.normals[corner], [[0, 0, 1], tilted, [0, 0, 1]], atol=1e-6)
    assert any("default weights" in note for note in asset.notes)
    path.write_text(
        FACE.replace("HOW", how).replace("float[] blendShapeWeights = [0.5, 3, 0.25]", "")
    )
    mesh = load(path).meshes[0]
    np.testing.assert_allclose(mesh.positions[mesh.faces[0]], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
