"""Files that are forgiven where their meaning is clear, and errors that say why."""

from __future__ import annotations

import base64
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import images, load
from appearance_opt.asset.types import Asset
from appearance_opt.errors import InputError
from tests.test_asset_gltf import triangle_document, write_glb

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nvt 0 0\nvt 1 0\nvt 0 1\n"
PIXELS = np.full((2, 2, 3), 200, np.uint8)

STAGE = '#usda 1.0\n(\n upAxis = "Y"\n metersPerUnit = 1\n)\n'
MESH = """    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    uniform token subdivisionScheme = "none"
"""


def obj(tmp_path: Path, faces: str | bytes, mtl: str | bytes = "", name: str = "x.mtl") -> Path:
    """An OBJ file, of material m if there are any."""
    raw = [t.encode() if isinstance(t, str) else t for t in (faces, mtl)]
    path = tmp_path / "x.obj"
    (tmp_path / name).write_bytes(raw[1] or b"# none\n")
    head = f"mtllib {name}\nusemtl m\n" if raw[1] else ""
    path.write_bytes((head + TRIANGLE).encode() + raw[0])
    return path


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('def NurbsPatch "a"\n{\n}\n', "NurbsPatch '/a': ignored"),
        (f'def Mesh "a"\n{{\n{MESH}    token visibility = "invisible"\n}}\n', "'/a': hidden"),
        (
            f'def Mesh "a"\n{{\n{MESH}    uniform token purpose = "proxy"\n}}\n',
            "'/a': of purpose proxy",
        ),
    ],
)
def test_an_error_keeps_the_notes_that_explain_it(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "x.usda"
    path.write_text(STAGE + text)
    with pytest.raises(InputError, match="no triangles in it") as error:
        load(path)
    assert why in str(error.value)


def test_an_obj_of_lines_says_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no triangles in it \(points and lines ignored\)"):
        load(obj(tmp_path, "l 1 2 3\n"))


def picture_kinds(tmp_path: Path) -> dict[str, str]:
    """Names of pictures that cannot be used, by what is wrong with them."""
    png = images.encode_png(PIXELS)
    (tmp_path / "damaged.png").write_bytes(png[:-20])
    (tmp_path / "unknown.png").write_bytes(b"what is this?")
    (tmp_path / "empty.png").write_bytes(b"")
    outside = tmp_path.parent / f"{tmp_path.name}_outside.png"
    outside.write_bytes(png)
    return {
        "damaged": "damaged.png", "unknown": "unknown.png", "empty": "empty.png",
        "refused": f"../{outside.name}", "scheme": "http://x/y.png", "gone": "gone.png",
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["damaged", "unknown", "empty", "refused", "scheme", "gone"])
@pytest.mark.parametrize("form", ["obj", "gltf", "usda"])
def test_any_texture_that_is_of_no_use_can_be_ignored(tmp_path: Path, kind: str, form: str) -> None:
    name = picture_kinds(tmp_path)[kind]
    if form == "obj":
        path = obj(tmp_path, "f 1/1 2/2 3/3\n", f"newmtl m\nKd 0.5 0.25 1\nmap_Kd {name}\n")
    elif form == "gltf":
        texture = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 0.25, 1, 1]}
        given, binary = triangle_document(
            images=[{"uri": name}],
            textures=[{"source": 0}],
            materials=[{"pbrMetallicRoughness": texture}],
        )
        given["meshes"][0]["primitives"][0]["material"] = 0
        path = tmp_path / "x.glb"
        write_glb(path, given, binary)
    else:
        path = tmp_path / "x.usda"
        path.write_text(
            STAGE + f'def Mesh "a" (\n prepend apiSchemas = ["MaterialBindingAPI"]\n)\n{{\n{MESH}'
            "    rel material:binding = </M>\n}\n"
            'def Material "M"\n{\n    token outputs:surface.connect = </M/S.outputs:surface>\n'
            '    def Shader "S"\n    {\n        uniform token info:id = "UsdPreviewSurface"\n'
            "        color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>\n        token outputs:surface\n    }\n"
            '    def Shader "T"\n    {\n        uniform token info:id = "UsdUVTexture"\n'
            f"        asset inputs:file = @{name}@\n        float4 inputs:fallback = (0.5, 0.25, 1, 1)\n"
            "        float3 outputs:rgb\n    }\n}\n"
        )
    with pytest.raises(InputError, match="--missing-textures ignore"):
        load(path)
    asset = load(path, missing_textures="ignore")
    material = asset.meshes[0].material
    assert material.base_color_texture is None
    np.testing.assert_allclose(material.base_color, (0.5, 0.25, 1), atol=1e-6)
    assert sum("the material's constants stand alone" in note for note in asset.notes) == 1


def test_line_continuations_of_windows(tmp_path: Path) -> None:
    asset = load(obj(tmp_path, "f 1 2 \\\r\n 3\r\nf 2 4 \\\n 3\n"))
    assert asset.triangle_count == 2


def test_faces_of_two_corners_are_passed_over(tmp_path: Path) -> None:
    asset = load(obj(tmp_path, "f 1 2\nf 1 2 3\n"))
    assert asset.triangle_count == 1
    assert "faces with fewer than three corners ignored" in asset.notes


def test_a_texture_coordinate_that_is_no_number_is_forgiven_among_others(tmp_path: Path) -> None:
    asset = load(obj(tmp_path, "vt nan 0\nf 1/1 2/2 3/3\nf 1/1 2/4 3/3\n"))
    uvs = asset.meshes[0].uvs
    assert np.isfinite(uvs).all() and len(uvs) == 4
    assert "mesh 'x': 1 texture coordinates that are no numbers set to 0" in asset.notes
    with pytest.raises(InputError, match="texture coordinates are NaN"):
        load(obj(tmp_path, "vt nan 0\nf 1/4 2/4 3/4\n"))


@pytest.mark.parametrize("name", ["a.png # the colours", "a.png\t# here", "a #1.png"])
def test_comments_after_the_name_of_a_map(tmp_path: Path, name: str) -> None:
    (tmp_path / (name if name.endswith(".png") else "a.png")).write_bytes(images.encode_png(PIXELS))
    asset = load(obj(tmp_path, "f 1/1 2/2 3/3\n", f"newmtl m\nmap_Kd {name}\n"))
    np.testing.assert_array_equal(asset.meshes[0].material.base_color_texture.pixels, PIXELS)
    assert not asset.notes


@pytest.mark.parametrize("on_disk", [b"bl\xe4tt.png", "blätt.png".encode()])
def test_names_in_latin_1(tmp_path: Path, on_disk: bytes) -> None:
    """The file may have the bytes as its name, or, unpacked by another system, the letters."""
    try:
        Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + on_disk)).write_bytes(
            images.encode_png(PIXELS)
        )
    except OSError:
        pytest.skip("the file system takes no such name")
    mtl = "newmtl Blätt\nmap_Kd blätt.png\n".encode("latin-1")
    path = obj(tmp_path, "usemtl Blätt\nf 1/1 2/2 3/3\n".encode("latin-1"), mtl)
    material = load(path).meshes[0].material
    assert material.name == "Blätt" and material.base_color_texture is not None


@pytest.mark.parametrize("change", ["plain", "unpadded", "lines", "escaped"])
def test_data_uris_without_padding_and_with_line_breaks(tmp_path: Path, change: str) -> None:
    given, binary = triangle_document()
    text = base64.b64encode(binary + b"\0").decode()
    assert text.endswith("=")
    text = {
        "plain": text,
        "unpadded": text.rstrip("="),
        "lines": "\r\n".join(text[k : k + 20] for k in range(0, len(text), 20)),
        "escaped": text.replace("=", "%3D"),
    }[change]
    given["buffers"] = [
        {"uri": f"data:application/octet-stream;base64,{text}", "byteLength": len(binary)}
    ]
    (tmp_path / "x.gltf").write_text(json.dumps(given))
    assert load(tmp_path / "x.gltf").triangle_count == 1


def test_chunks_filled_up_with_zeros(tmp_path: Path) -> None:
    given, binary = triangle_document()
    text = json.dumps(given).encode()
    text += b"\0" * (4 + -len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )
    path = tmp_path / "x.glb"
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    assert load(path).triangle_count == 1
    path.write_bytes(struct.pack("<4sII", b"glTF", 1, 12 + len(chunks)) + chunks)
    with pytest.raises(InputError, match="GLB version 1 is not supported; convert"):
        load(path)


def test_assets_of_several_folders_say_which_root_to_allow(tmp_path: Path) -> None:
    for folder, text in (
        ("geo", f'def Mesh "g"\n{{\n{MESH}}}\n'),
        ("more", f'def Mesh "m"\n{{\n{MESH}}}\n'),
    ):
        (tmp_path / "show" / folder).mkdir(parents=True)
        (tmp_path / "show" / folder / "part.usda").write_text(STAGE + text)
    shots = tmp_path / "show" / "shots"
    shots.mkdir()
    path = shots / "x.usda"
    path.write_text(
        STAGE + 'def "a" (\n references = @../geo/part.usda@</g>\n)\n{\n}\n'
        'def "b" (\n references = @../more/part.usda@</m>\n)\n{\n}\n'
    )
    with pytest.raises(InputError) as error:
        load(path)
    root = str(error.value).split("--root ")[1]
    assert Path(root) == (tmp_path / "show").resolve()
    asset: Asset = load(path, root=root)
    assert asset.triangle_count == 2
