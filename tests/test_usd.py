"""USD beyond plain meshes: instancers, animation, creases, texture transforms, scales and biases of
samplers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import images, load
from appearance_opt.asset.polygons import Polygons
from appearance_opt.asset.subdivide import Sharpness, catmull_clark
from appearance_opt.asset.uv_transforms import apply, usd_affine
from appearance_opt.errors import InputError

HEAD = '#usda 1.0\n(metersPerUnit = 1\nupAxis = "Y")\n'
TRIANGLE = (
    "int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, 2]\n"
    'uniform token subdivisionScheme = "none"\npoint3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]\n'
)
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
CUBE_FACES = Polygons(
    np.full(6, 4),
    np.array([0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]),
)


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "x.usda"
    path.write_text(HEAD + text)
    return path


def test_point_instancers_draw_their_prototypes_where_they_say(tmp_path: Path) -> None:
    """Twice the first prototype, once the second; the fourth instance is hidden, and prototypes are
    not drawn alone."""
    path = written(
        tmp_path,
        f"""def PointInstancer "trees" {{
    rel prototypes = [</trees/p/a>, </trees/p/b>]
    int[] protoIndices = [0, 1, 0, 0]
    int64[] ids = [10, 11, 12, 13]
    int64[] invisibleIds = [13]
    point3f[] positions = [(10, 0, 0), (20, 0, 0), (30, 0, 0), (40, 0, 0)]
    float3[] scales = [(1, 1, 1), (2, 2, 2), (1, 1, 1), (1, 1, 1)]
    double3 xformOp:translate = (0, 0, 5)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Scope "p" {{
        def Mesh "a" {{
            {TRIANGLE}
        }}
        def Xform "b" {{
            def Mesh "inside" {{
                {TRIANGLE}
                double3 xformOp:translate = (0, 3, 0)
                uniform token[] xformOpOrder = ["xformOp:translate"]
            }}
        }}
    }}
}}""",
    )
    meshes = load(path).meshes
    assert [(m.name, len(m.faces)) for m in meshes] == [
        ("a", 2),
        ("inside", 1),
    ]  # one mesh holds all its places
    lows = sorted(tuple(p.min(axis=0)) for m in meshes for p in m.positions[m.faces])
    assert lows == [(10, 0, 5), (20, 6, 5), (30, 0, 5)]


def test_animated_meshes_are_read_at_their_first_frame(tmp_path: Path) -> None:
    moving = TRIANGLE.replace(
        "point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]",
        "point3f[] points.timeSamples = { 3: [(0, 0, 7), (1, 0, 7), (0, 1, 7)], 4: [(0, 0, 8), (1, 0, 8), (0, 1, 8)] }",
    )
    path = written(
        tmp_path,
        f'def Mesh "m"\n{{\n{moving}double3 xformOp:translate.timeSamples = {{ 3: (1, 0, 0), 4: (2, 0, 0) }}\n'
        'uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n',
    )
    np.testing.assert_allclose(load(path).meshes[0].positions.min(axis=0), [1, 0, 7])


@pytest.mark.parametrize(
    ("shape", "attributes", "extent", "volume"),
    [
        ("Cube", "double size = 3", (3, 3, 3), 27.0),
        ("Sphere", "double radius = 2", (4, 4, 4), 4 / 3 * np.pi * 8),
        (
            "Cylinder",
            'double radius = 1\ndouble height = 4\nuniform token axis = "X"',
            (4, 2, 2),
            4 * np.pi,
        ),
        (
            "Cone",
            'double radius = 1\ndouble height = 3\nuniform token axis = "Y"',
            (2, 3, 2),
            np.pi,
        ),
        ("Capsule", "double radius = 1\ndouble height = 2", (2, 2, 4), 4 / 3 * np.pi + 2 * np.pi),
        ("Plane", 'double width = 1\ndouble length = 2\nuniform token axis = "Y"', (1, 0, 2), 0.0),
        ("Plane", 'double width = 1\ndouble length = 2\nuniform token axis = "X"', (0, 2, 1), 0.0),
    ],
)
def test_shapes_have_their_size(
    tmp_path: Path, shape: str, attributes: str, extent: tuple, volume: float
) -> None:
    colour = 'color3f[] primvars:displayColor = [(1, 0.5, 0)] (interpolation = "constant")'
    mesh = load(written(tmp_path, f'def {shape} "s"\n{{\n{attributes}\n{colour}\n}}\n')).meshes[0]
    np.testing.assert_allclose(np.ptp(mesh.positions, axis=0), extent, atol=0.01)
    p = mesh.positions[mesh.faces].astype(np.float64)
    face = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert np.einsum("ij,ij->", p[:, 0], face) / 6 == pytest.approx(volume, rel=0.01, abs=1e-9)
    assert (np.einsum("ij,ikj->ik", face, mesh.normals[mesh.faces]) > 0).all()
    np.testing.assert_allclose(mesh.colors, np.tile((1, 0.5, 0), (len(mesh.positions), 1)))


def refined(sharpness: float, levels: int, corner: float = 0.0) -> np.ndarray:
    """A cube with all edges and corners as sharp as that."""
    values, polygons = CUBE, CUBE_FACES
    edges = np.stack([polygons.indices, polygons.indices[polygons.next()]], axis=1)
    sharp = Sharpness(edges, np.full(len(edges), sharpness), np.full(8, corner))
    for _ in range(levels):
        values, polygons, sharp = catmull_clark(values, polygons, False, sharp)
    return values


def test_creases_that_stay_sharp_keep_a_cube() -> None:
    values = refined(10.0, 3)
    np.testing.assert_allclose(np.abs(values).max(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(values[:8], CUBE)


def test_creases_soften_level_by_level() -> None:
    """Sharp for one level: as smooth from then on as a cube whose faces were only split."""
    once = refined(1.0, 1)
    np.testing.assert_allclose(once, refined(10.0, 1))
    again = refined(1.0, 2)
    assert np.abs(again[:8]).max() < 1
    assert np.abs(again[:8]).min() > np.abs(refined(0.0, 2)[:8]).max()
    half = refined(0.5, 1)
    np.testing.assert_allclose(half, (refined(0.0, 1) + refined(1.0, 1)) / 2)


def test_sharp_corners_stay() -> None:
    np.testing.assert_allclose(refined(0.0, 2, corner=10.0)[:8], CUBE)
    assert np.abs(refined(0.0, 2)[:8]).max() < 1


@pytest.mark.parametrize("lengths", ["[2]", "[3]"])
def test_creases_of_a_file(tmp_path: Path, lengths: str) -> None:
    """An open strip of two quads, folded; the crease runs along the fold, or does not fit the
    mesh."""
    path = written(
        tmp_path,
        """def Mesh "m"
{
int[] faceVertexCounts = [4, 4]
int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]
point3f[] points = [(-1, 0, 0), (0, 1, 0), (1, 0, 0), (-1, 0, 2), (0, 1, 2), (1, 0, 2)]
int[] creaseIndices = [1, 4]
int[] creaseLengths = """
        + lengths
        + "\nfloat[] creaseSharpnesses = [10]\n}\n",
    )
    if lengths == "[3]":
        with pytest.raises(InputError, match="creases or corners do not fit"):
            load(path, refine=1)
    else:
        # the middle of the fold stays where it is; without the crease it sinks
        assert load(path, refine=1).meshes[0].positions[:, 1].max() == pytest.approx(1.0)


def test_transforms_of_texture_coordinates_agree_with_their_definition() -> None:
    """Scale, then rotation, then translation, with v upward; ours count it downward."""
    scale, degrees, move = (2.0, 0.5), 30.0, (0.1, -0.2)
    st = np.random.default_rng(0).uniform(size=(20, 2))
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    expected = (st * scale) @ np.array([[c, -s], [s, c]]).T + move
    ours = apply(usd_affine(scale, degrees, move), np.stack([st[:, 0], 1 - st[:, 1]], axis=1))
    np.testing.assert_allclose(
        ours, np.stack([expected[:, 0], 1 - expected[:, 1]], axis=1), atol=1e-12
    )


MATERIAL = """def Material "mat" {{
    token outputs:surface.connect = </mat/s.outputs:surface>
    def Shader "s" {{
        uniform token info:id = "UsdPreviewSurface"
        {inputs}
        token outputs:surface
    }}
    def Shader "reader" {{
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }}
    def Shader "move" {{
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </mat/reader.outputs:result>
        float2 inputs:scale = (0.5, 0.5)
        float2 inputs:translation = (0.25, 0)
        float2 outputs:result
    }}
    def Shader "t" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @t.png@
        float2 inputs:st.connect = </mat/{st}>
        token inputs:sourceColorSpace = "raw"
        {sampler}
        float3 outputs:rgb
        float outputs:r
    }}
}}
def Mesh "m" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
    rel material:binding = </mat>
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (0, 1)] (interpolation = "vertex")
    """


def textured(
    tmp_path: Path, inputs: str, sampler: str = "", st: str = "reader.outputs:result"
) -> Path:
    images_ = np.full((4, 4, 3), (64, 192, 255), np.uint8)
    (tmp_path / "t.png").write_bytes(images.encode_png(images_))
    return written(
        tmp_path, MATERIAL.format(inputs=inputs, sampler=sampler, st=st) + TRIANGLE + "}"
    )


def test_texture_transforms_move_the_coordinates(tmp_path: Path) -> None:
    inputs = "color3f inputs:diffuseColor.connect = </mat/t.outputs:rgb>"
    mesh = load(textured(tmp_path, inputs, st="move.outputs:result")).meshes[0]
    expected = np.array([(0.25, 0), (0.75, 0), (0.25, 0.5)])
    at = [
        int(np.flatnonzero((mesh.positions == p).all(axis=1))[0])
        for p in ([0, 0, 0], [1, 0, 0], [0, 1, 0])
    ]
    np.testing.assert_allclose(
        mesh.uvs[at], np.stack([expected[:, 0], 1 - expected[:, 1]], axis=1), atol=1e-6
    )


def test_a_bias_becomes_part_of_the_texture(tmp_path: Path) -> None:
    inputs = "float inputs:roughness.connect = </mat/t.outputs:r>"
    material = (
        load(
            textured(
                tmp_path,
                inputs,
                "float4 inputs:scale = (0.5, 1, 1, 1)\nfloat4 inputs:bias = (0.25, 0, 0, 0)",
            )
        )
        .meshes[0]
        .material
    )
    np.testing.assert_allclose(
        material.orm_texture.linear()[..., 1] * material.roughness, 0.25 + 32 / 255, atol=1e-5
    )


@pytest.mark.parametrize(
    ("sampler", "expected"),
    [
        ("", (64, 192, 255)),
        (
            "float4 inputs:scale = (2, 2, 2, 1)\nfloat4 inputs:bias = (-1, -1, -1, 0)",
            (64, 192, 255),
        ),
        ("float4 inputs:scale = (2, -2, 2, 1)\nfloat4 inputs:bias = (-1, 1, -1, 0)", (64, 63, 255)),
    ],
)
def test_normal_maps_follow_scale_and_bias(tmp_path: Path, sampler: str, expected: tuple) -> None:
    inputs = "normal3f inputs:normal.connect = </mat/t.outputs:rgb>"
    material = load(textured(tmp_path, inputs, sampler)).meshes[0].material
    np.testing.assert_allclose(material.normal_texture.linear()[0, 0] * 255, expected, atol=1e-3)
    assert material.normal_scale == 1.0
