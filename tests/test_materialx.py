"""MaterialX networks, in USD prims and in documents: what becomes of base colour, roughness,
metalness and normals."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import Asset, images, load
from appearance_opt.asset.types import srgb_to_linear
from appearance_opt.asset.usd_networks import category
from appearance_opt.errors import InputError

SPARE = "texture coordinates that no texture reads dropped, of 1 mesh ('Q')"
"""Each material here reads one of the two sets of the quad, or none."""

STAGE = """#usda 1.0
(
    defaultPrim = "R"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "R"
{{
    def Material "M"
    {{
        {output}
        {shaders}
    }}
    def Mesh "Q" (prepend apiSchemas = ["MaterialBindingAPI"])
    {{
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")
        texCoord2f[] primvars:second = [(0.5, 0.5), (1, 0.5), (1, 1), (0.5, 1)] (interpolation = "vertex")
        uniform token subdivisionScheme = "none"
        rel material:binding = </R/M>
    }}
}}
"""


def shader(name: str, identifier: str, *inputs: str, output: str = "token outputs:out") -> str:
    lines = "\n".join(inputs)
    return (
        f'def Shader "{name}"\n{{\nuniform token info:id = "{identifier}"\n{lines}\n{output}\n}}\n'
    )


MTLX = "token outputs:mtlx:surface.connect = </R/M/S.outputs:out>"


def network(folder: Path, *shaders: str, output: str = MTLX) -> Asset:
    (folder / "x.usda").write_text(STAGE.format(output=output, shaders="\n".join(shaders)))
    return load(folder / "x.usda")


def image(name: str, file: str, kind: str = "color3", *more: str, space: str = "") -> str:
    meta = f' (colorSpace = "{space}")' if space else ""
    types = {"color3": "color3f", "float": "float", "vector3": "float3"}
    output = f"{types[kind]} outputs:out"
    return shader(
        name, f"ND_image_{kind}", f"asset inputs:file = @{file}@{meta}", *more, output=output
    )


def picture(path: Path, seed: int = 0, size: int = 8) -> np.ndarray:
    """Random pixels, whose neighbours are alike."""
    small = np.random.default_rng(seed).integers(40, 216, (size // 4, size // 4, 3), np.uint8)
    pixels = small.repeat(4, axis=0).repeat(4, axis=1)
    path.write_bytes(images.encode_png(pixels))
    return pixels


SURFACES = [
    (
        "standard_surface",
        ("base", "base_color", "specular_roughness", "metalness"),
        (0.8, 0.2, 0.0),
    ),
    (
        "open_pbr_surface",
        ("base_weight", "base_color", "specular_roughness", "base_metalness"),
        (0.8, 0.3, 0.0),
    ),
    ("gltf_pbr", ("", "base_color", "roughness", "metallic"), (1.0, 1.0, 1.0)),
]


@pytest.mark.parametrize(("kind", "names", "defaults"), SURFACES)
def test_constants_and_defaults_of_the_surfaces(
    tmp_path: Path, kind: str, names: tuple, defaults: tuple
) -> None:
    weight, color, rough, metal = names
    plain = network(tmp_path, shader("S", f"ND_{kind}_surfaceshader")).meshes[0].material
    assert (plain.base_color, plain.roughness, plain.metalness) == (
        pytest.approx((defaults[0],) * 3),
        pytest.approx(defaults[1]),
        defaults[2],
    )
    given = [
        f"color3f inputs:{color} = (0.5, 0.25, 1)",
        f"float inputs:{rough} = 0.75",
        f"float inputs:{metal} = 0.5",
    ]
    if weight:
        given.append(f"float inputs:{weight} = 0.5")
    asset = network(tmp_path, shader("S", f"ND_{kind}_surfaceshader", *given))
    material = asset.meshes[0].material
    share = 0.5 if weight else 1.0
    assert material.base_color == pytest.approx((0.5 * share, 0.25 * share, share))
    assert (material.roughness, material.metalness) == (0.75, 0.5)
    assert asset.notes == (SPARE,)


def test_pictures_and_factors_of_a_usd_network(tmp_path: Path) -> None:
    color, rough, normal = (
        picture(tmp_path / f"{n}.png", k) for k, n in enumerate(("c", "r", "n"))
    )
    asset = network(
        tmp_path,
        shader(
            "S",
            "ND_standard_surface_surfaceshader",
            "color3f inputs:base_color.connect = </R/M/scaled.outputs:out>",
            "float inputs:specular_roughness.connect = </R/M/rough.outputs:out>",
            "float3 inputs:normal.connect = </R/M/bumps.outputs:out>",
        ),
        shader(
            "scaled",
            "ND_multiply_color3",
            "color3f inputs:in1.connect = </R/M/color.outputs:out>",
            "color3f inputs:in2 = (0.5, 1, 0.25)",
            output="color3f outputs:out",
        ),
        image("color", "c.png", space="srgb_texture"),
        image("rough", "r.png", "float"),
        shader(
            "bumps",
            "ND_normalmap_float",
            "float3 inputs:in.connect = </R/M/normal.outputs:out>",
            "float inputs:scale = 0.5",
            output="float3 outputs:out",
        ),
        image("normal", "n.png", "vector3"),
    )
    material = asset.meshes[0].material
    base, orm, bumps = material.base_color_texture, material.orm_texture, material.normal_texture
    assert base is not None and orm is not None and bumps is not None
    np.testing.assert_array_equal(base.pixels, color)
    assert base.color_space == "srgb"
    assert material.base_color == pytest.approx((0.5, 1, 0.25))
    np.testing.assert_array_equal(orm.pixels[..., 1], rough[..., 0])
    assert (material.roughness, material.metalness) == (1.0, 0.0)
    np.testing.assert_array_equal(bumps.pixels, normal)
    assert (bumps.color_space, material.normal_scale) == ("linear", 0.5)
    assert asset.notes == (SPARE,)


def test_arithmetic_of_pictures_is_done_in_linear_values(tmp_path: Path) -> None:
    first, second = picture(tmp_path / "a.png", 1), picture(tmp_path / "b.png", 2)
    asset = network(
        tmp_path,
        shader(
            "S",
            "ND_gltf_pbr_surfaceshader",
            "color3f inputs:base_color.connect = </R/M/mix.outputs:out>",
        ),
        shader(
            "mix",
            "ND_mix_color3",
            "color3f inputs:fg.connect = </R/M/a.outputs:out>",
            "color3f inputs:bg.connect = </R/M/b.outputs:out>",
            "float inputs:mix = 0.25",
            output="color3f outputs:out",
        ),
        image("a", "a.png", space="srgb_texture"),
        image("b", "b.png", space="lin_rec709"),
    )
    texture = asset.meshes[0].material.base_color_texture
    assert texture is not None
    want = 0.25 * srgb_to_linear(first / np.float32(255)) + 0.75 * second / 255
    np.testing.assert_allclose(texture.linear(), want, atol=1e-6)


def upward(uv: np.ndarray) -> np.ndarray:
    return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)


def place2d(uv: np.ndarray, pivot, scale, degrees, offset, trs: bool) -> np.ndarray:
    """NG_place2d_vector2 of MaterialX, step by step; coordinates count v upward."""
    turn = lambda p: np.stack([c * p[:, 0] + s * p[:, 1], -s * p[:, 0] + c * p[:, 1]], axis=1)  # noqa: E731
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    p = uv - pivot
    p = turn(p - offset) / scale if trs else turn(p / scale) - offset
    return p + pivot


@pytest.mark.parametrize("order", [0, 1])
def test_transforms_of_texture_coordinates(tmp_path: Path, order: int) -> None:
    pixels = picture(tmp_path / "c.png", 3)
    asset = network(
        tmp_path,
        shader(
            "S",
            "ND_gltf_pbr_surfaceshader",
            "color3f inputs:base_color.connect = </R/M/color.outputs:out>",
        ),
        image(
            "color", "c.png", "color3", "float2 inputs:texcoord.connect = </R/M/place.outputs:out>"
        ),
        shader(
            "place",
            "ND_place2d_vector2",
            "float2 inputs:texcoord.connect = </R/M/uv.outputs:out>",
            "float2 inputs:pivot = (0.5, 0.25)",
            "float2 inputs:scale = (0.5, 2)",
            "float inputs:rotate = 30",
            "float2 inputs:offset = (0.1, -0.2)",
            f"int inputs:operationorder = {order}",
            output="float2 outputs:out",
        ),
        shader(
            "uv",
            "ND_geompropvalue_vector2",
            'string inputs:geomprop = "second"',
            output="float2 outputs:out",
        ),
    )
    mesh = asset.meshes[0]
    given = np.array([(0.5, 0.5), (1, 0.5), (1, 1), (0.5, 1)])
    want = place2d(given, (0.5, 0.25), (0.5, 2), 30, (0.1, -0.2), order == 1)
    by_corner = {
        tuple(p[:2].tolist()): uv
        for p, uv in zip(mesh.positions, upward(np.asarray(mesh.uvs)), strict=True)
    }
    got = [by_corner[corner] for corner in ((0, 0), (1, 0), (1, 1), (0, 1))]
    np.testing.assert_allclose(got, want, atol=1e-5)
    assert mesh.material.base_color_texture is not None
    np.testing.assert_array_equal(mesh.material.base_color_texture.pixels, pixels)


def test_tiled_images_and_gltf_images(tmp_path: Path) -> None:
    """uv * uvtiling - uvoffset; and KHR_texture_transform, which counts v downward and turns the
    other way round."""
    picture(tmp_path / "c.png", 3)
    asset = network(
        tmp_path,
        shader(
            "S",
            "ND_gltf_pbr_surfaceshader",
            "color3f inputs:base_color.connect = </R/M/color.outputs:out>",
        ),
        shader(
            "color",
            "ND_tiledimage_color3",
            "asset inputs:file = @c.png@",
            "float2 inputs:uvtiling = (3, 2)",
            "float2 inputs:uvoffset = (0.25, 0.5)",
            output="color3f outputs:out",
        ),
    )
    uvs = upward(np.asarray(asset.meshes[0].uvs))
    np.testing.assert_allclose(uvs.min(axis=0), (-0.25, -0.5), atol=1e-6)
    np.testing.assert_allclose(uvs.max(axis=0), (2.75, 1.5), atol=1e-6)
    asset = network(
        tmp_path,
        shader(
            "S",
            "ND_gltf_pbr_surfaceshader",
            "color3f inputs:base_color.connect = </R/M/color.outputs:outcolor>",
        ),
        shader(
            "color",
            "ND_gltf_colorimage",
            "asset inputs:file = @c.png@",
            "color4f inputs:color = (0.5, 0.25, 0.125, 1)",
            "float2 inputs:scale = (2, 3)",
            "float2 inputs:offset = (0.25, 0.125)",
            output="color3f outputs:outcolor",
        ),
    )
    mesh = asset.meshes[0]
    # (0, 0) of glTF is the upper left corner, from which it scales and which it moves to the offset
    np.testing.assert_allclose(np.asarray(mesh.uvs).min(axis=0), (0.25, 0.125), atol=1e-6)
    np.testing.assert_allclose(np.asarray(mesh.uvs).max(axis=0), (2.25, 3.125), atol=1e-6)
    assert mesh.material.base_color == pytest.approx((0.5, 0.25, 0.125))


def test_what_is_not_understood_is_named_and_keeps_its_default(tmp_path: Path) -> None:
    asset = network(
        tmp_path,
        shader(
            "S",
            "ND_standard_surface_surfaceshader",
            "color3f inputs:base_color.connect = </R/M/noise.outputs:out>",
            "float inputs:specular_roughness = 0.6",
            "float inputs:coat = 1",
        ),
        shader("noise", "ND_fractal3d_color3", output="color3f outputs:out"),
    )
    material = asset.meshes[0].material
    assert material.base_color == pytest.approx((0.8, 0.8, 0.8))
    assert material.roughness == pytest.approx(0.6)
    assert [n for n in asset.notes if "base_color" in n and "'fractal3d'" in n and "0.8" in n]
    assert [n for n in asset.notes if "coat ignored" in n]
    asset = network(tmp_path, shader("S", "ND_toon_surfaceshader"))
    assert [n for n in asset.notes if "toon" in n and "not understood" in n]
    asset = network(tmp_path, output="")
    assert [n for n in asset.notes if "no surface shader" in n]


def test_networks_that_run_in_circles_end(tmp_path: Path) -> None:
    asset = network(
        tmp_path,
        shader(
            "S",
            "ND_gltf_pbr_surfaceshader",
            "color3f inputs:base_color.connect = </R/M/a.outputs:out>",
        ),
        shader(
            "a",
            "ND_add_color3",
            "color3f inputs:in1.connect = </R/M/b.outputs:out>",
            output="color3f outputs:out",
        ),
        shader(
            "b",
            "ND_add_color3",
            "color3f inputs:in1.connect = </R/M/a.outputs:out>",
            output="color3f outputs:out",
        ),
    )
    assert asset.meshes[0].material.base_color == (1, 1, 1)
    assert [n for n in asset.notes if "circles" in n]


def test_a_preview_surface_is_preferred(tmp_path: Path) -> None:
    both = f"{MTLX}\ntoken outputs:surface.connect = </R/M/P.outputs:surface>"
    red = "color3f inputs:diffuseColor = (1, 0, 0)"
    preview = shader("P", "UsdPreviewSurface", red, output="token outputs:surface")
    asset = network(tmp_path, shader("S", "ND_gltf_pbr_surfaceshader"), preview, output=both)
    assert asset.meshes[0].material.base_color == (1, 0, 0)


def test_opacity_and_emission(tmp_path: Path) -> None:
    asset = network(
        tmp_path,
        shader(
            "S",
            "ND_open_pbr_surface_surfaceshader",
            "float inputs:geometry_opacity = 0.5",
            "float inputs:emission_luminance = 3",
            "color3f inputs:emission_color = (1, 0.5, 0)",
        ),
    )
    material = asset.meshes[0].material
    assert (material.alpha_mode, material.opacity) == ("blend", 0.5)
    assert material.emission == pytest.approx((3, 1.5, 0))


@pytest.mark.parametrize(
    ("identifier", "found"),
    [
        ("ND_standard_surface_surfaceshader_100", ("standard_surface", 0)),
        ("ND_image_float", ("image", 1)),
        ("ND_gltf_image_color3_color3_1_0", ("gltf_image", 3)),
        ("ND_multiply_color3FA", ("multiply", 3)),
        ("ND_convert_float_color3", ("convert", 3)),
        ("ND_extract_color3", ("extract", 1)),
        ("ND_UsdUVTexture_23", ("UsdUVTexture", 0)),
        ("UsdPrimvarReader_float2", ("UsdPrimvarReader", 2)),
        ("ND_normalmap", ("normalmap", 3)),
    ],
)
def test_names_of_node_definitions(identifier: str, found: tuple[str, int]) -> None:
    assert category(identifier)[:2] == found


DOCUMENT = """<?xml version="1.0"?>
<materialx version="1.38" {space}>
  {more}
  <nodegraph name="G">
    <input name="tint" type="color3" value="0.5, 0.25, 1" />
    <image name="i" type="color3">
      <input name="file" type="filename" value="c.png" colorspace="srgb_texture" />
    </image>
    <multiply name="m" type="color3">
      <input name="in1" type="color3" nodename="i" />
      <input name="in2" type="color3" interfacename="tint" />
    </multiply>
    <output name="color" type="color3" nodename="m" />
  </nodegraph>
  <open_pbr_surface name="S" type="surfaceshader">
    {color}
    <input name="base_metalness" type="float" value="1" />
    {inputs}
  </open_pbr_surface>
  <surfacematerial name="M" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="S" />
  </surfacematerial>
</materialx>
"""


GRAPH = '<input name="base_color" type="color3" nodegraph="G" output="color" />'


def document(
    folder: Path, inputs: str = "", space: str = "", more: str = "", color: str = GRAPH
) -> Asset:
    """A quad that wears the material of a document, which usd-core cannot compose."""
    (folder / "x.mtlx").write_text(
        DOCUMENT.format(inputs=inputs, space=space, more=more, color=color)
    )
    stage = STAGE.format(output="", shaders="").replace(
        'def Material "M"', 'def "Look" (references = @x.mtlx@)'
    )
    (folder / "x.usda").write_text(stage)
    return load(folder / "x.usda")


def test_a_document_with_a_node_graph(tmp_path: Path) -> None:
    color = picture(tmp_path / "c.png")
    asset = document(tmp_path)
    # and not that USD cannot read it
    assert asset.notes == ("material 'M': read from x.mtlx", SPARE)
    material = asset.meshes[0].material
    assert material.base_color_texture is not None
    np.testing.assert_array_equal(material.base_color_texture.pixels, color)
    assert material.base_color == pytest.approx((0.5, 0.25, 1))
    assert (material.metalness, material.roughness) == (1, pytest.approx(0.3))


def test_tile_sizes_have_units(tmp_path: Path) -> None:
    picture(tmp_path / "c.png")
    more = """<tiledimage name="t" type="color3">
      <input name="file" type="filename" value="c.png" />
      <input name="realworldimagesize" type="vector2" value="0.5 0.25" unit="foot" unittype="distance" />
      <input name="realworldtilesize" type="vector2" value="1, 1" unit="inch" unittype="distance" />
    </tiledimage>"""
    color = '<input name="base_color" type="color3" nodename="t" />'
    uvs = np.asarray(document(tmp_path, more=more, color=color).meshes[0].uvs)
    np.testing.assert_allclose(np.ptp(uvs, axis=0), (1 / 6, 1 / 3), atol=1e-6)


def test_colours_of_a_document_are_in_its_colour_space(tmp_path: Path) -> None:
    picture(tmp_path / "c.png")
    material = document(tmp_path, space='colorspace="srgb_texture"').meshes[0].material
    assert material.base_color == pytest.approx(srgb_to_linear(np.array([0.5, 0.25, 1.0])).tolist())


def test_nodes_that_a_document_defines_itself_and_documents_that_it_includes(
    tmp_path: Path,
) -> None:
    picture(tmp_path / "c.png")
    (tmp_path / "inner.mtlx").write_text("""<?xml version="1.0"?>
<materialx version="1.38">
  <nodedef name="ND_half_float" node="half">
    <input name="in" type="float" value="0" />
    <output name="out" type="float" />
  </nodedef>
  <nodegraph name="NG_half_float" nodedef="ND_half_float">
    <multiply name="m" type="float">
      <input name="in1" type="float" interfacename="in" />
      <input name="in2" type="float" value="0.5" />
    </multiply>
    <output name="out" type="float" nodename="m" />
  </nodegraph>
</materialx>
""")
    more = """<xi:include href="inner.mtlx" xmlns:xi="http://www.w3.org/2001/XInclude" />
  <half name="h" type="float"><input name="in" type="float" value="0.5" /></half>"""
    inputs = '<input name="specular_roughness" type="float" nodename="h" />'
    assert document(tmp_path, inputs, more=more).meshes[0].material.roughness == 0.25


def test_documents_are_read_within_their_folder_only(tmp_path: Path) -> None:
    (tmp_path / "secret.mtlx").write_text('<?xml version="1.0"?><materialx version="1.38" />')
    inner = tmp_path / "in"
    inner.mkdir()
    picture(inner / "c.png")
    more = '<xi:include href="../secret.mtlx" xmlns:xi="http://www.w3.org/2001/XInclude" />'
    with pytest.raises(InputError, match="outside its own folder"):
        document(inner, more=more)


def test_a_damaged_document_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"x\.mtlx.*not a readable MaterialX file") as caught:
        document(tmp_path, more="<image")
    assert "\n" not in str(caught.value)


def test_reading_usd_without_documents_does_not_import_materialx(tmp_path: Path) -> None:
    network(tmp_path, shader("S", "ND_gltf_pbr_surfaceshader"))
    code = f"""
import sys
from appearance_opt.asset import load
load({str(tmp_path / "x.usda")!r})
sys.exit("MaterialX" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
