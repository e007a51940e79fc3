"""What readers make of bindings, variants, names and encodings of materials."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import images, load
from appearance_opt.errors import InputError

COLORS = {"full": (1, 0, 0), "preview": (0, 1, 0), "all": (0, 0, 1)}

STAGE = """#usda 1.0
(
    defaultPrim = "R"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "R" (
    prepend apiSchemas = ["MaterialBindingAPI", "CollectionAPI:some"]
)
{{
    {above}
    {materials}
    def Mesh "Q" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {{
        int[] faceVertexCounts = [3, 3]
        int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
        uniform token subdivisionScheme = "none"
        {bindings}
    }}
}}
"""

SUBSET = """
        uniform token subsetFamily:materialBind:familyType = "partition"
        def GeomSubset "S" (
            prepend apiSchemas = ["MaterialBindingAPI"]
        )
        {
            uniform token elementType = "face"
            uniform token familyName = "materialBind"
            int[] indices = [1]
            rel material:binding:full = </R/full>
        }
"""

COLLECTION = """
    uniform token collection:some:expansionRule = "expandPrims"
    rel collection:some:includes = </R/Q>
    rel material:binding:collection:full:some = [</R.collection:some>, </R/full>]
"""


def bound(folder: Path, bindings: str, above: str = "") -> list[tuple[int, ...]]:
    """Base colours of the meshes of a stage with these bindings."""
    materials = "".join(
        f"""
    def Material "{name}"
    {{
        token outputs:surface.connect = </R/{name}/S.outputs:surface>
        def Shader "S"
        {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = {color}
            token outputs:surface
        }}
    }}"""
        for name, color in COLORS.items()
    )
    (folder / "x.usda").write_text(
        STAGE.format(above=above, materials=materials, bindings=bindings)
    )
    return [tuple(int(x) for x in m.material.base_color) for m in load(folder / "x.usda").meshes]


def binding(*names: str) -> str:
    return "\n".join(
        f"rel material:binding{'' if n == 'all' else ':' + n} = </R/{n}>" for n in names
    )


@pytest.mark.parametrize(
    ("names", "taken"),
    [
        (("all",), "all"),
        (("preview",), "preview"),
        (("full",), "full"),
        (("all", "preview"), "preview"),
        (("all", "full"), "full"),
        (("all", "preview", "full"), "full"),
    ],
)
def test_the_binding_for_full_is_taken_else_that_for_preview_else_that_for_all(
    tmp_path: Path, names: tuple[str, ...], taken: str
) -> None:
    assert bound(tmp_path, binding(*names)) == [COLORS[taken]]


def test_bindings_of_subsets_and_collections_have_purposes(tmp_path: Path) -> None:
    assert bound(tmp_path, binding("preview") + SUBSET) == [COLORS["full"], COLORS["preview"]]
    assert bound(tmp_path, binding("preview", "all"), COLLECTION) == [COLORS["full"]]


def picture(path: Path, color: tuple[int, int, int], size: int = 4) -> None:
    path.write_bytes(images.encode_png(np.full((size, size, 3), color, np.uint8)))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be"])
def test_byte_order_marks_of_obj_and_mtl_files(tmp_path: Path, encoding: str) -> None:
    picture(tmp_path / "röt.png", (200, 30, 30))
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    obj = (
        "mtllib b.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl m\nf 1/1 2/2 3/3\n"
    )
    (tmp_path / "b.obj").write_bytes((mark + obj).encode(encoding))
    (tmp_path / "b.mtl").write_bytes((mark + "newmtl m\nmap_Kd röt.png\n").encode(encoding))
    asset = load(tmp_path / "b.obj")
    texture = asset.meshes[0].material.base_color_texture
    assert texture is not None
    assert tuple(texture.pixels[0, 0]) == (200, 30, 30)
    assert asset.notes == load_plain(tmp_path, obj).notes


def load_plain(folder: Path, obj: str):
    (folder / "b.obj").write_text(obj)
    (folder / "b.mtl").write_text("newmtl m\nmap_Kd röt.png\n", encoding="utf-8")
    return load(folder / "b.obj")


def case_matters(folder: Path) -> bool:
    (folder / "case").touch()
    return not (folder / "CASE").exists()


def test_a_file_whose_name_differs_in_case_is_taken_if_it_is_the_only_one(tmp_path: Path) -> None:
    if not case_matters(tmp_path):
        pytest.skip("the file system does not tell upper from lower case")
    (tmp_path / "Maps").mkdir()
    picture(tmp_path / "Maps" / "Red.PNG", (200, 30, 30))
    (tmp_path / "b.obj").write_text("mtllib B.MTL\nv 0 0 0\nv 1 0 0\nv 1 1 0\nusemtl m\nf 1 2 3\n")
    (tmp_path / "b.mtl").write_text("newmtl m\nmap_Kd maps\\red.png\n")
    asset = load(tmp_path / "b.obj")
    texture = asset.meshes[0].material.base_color_texture
    assert texture is not None
    assert tuple(texture.pixels[0, 0]) == (200, 30, 30)
    assert [n for n in asset.notes if "upper and lower case" in n and "Red.PNG" in n]
    picture(tmp_path / "Maps" / "RED.png", (0, 0, 0))
    with pytest.raises(InputError, match="does not exist"):
        load(tmp_path / "b.obj")


def test_names_in_another_case_do_not_lead_out_of_the_folder(tmp_path: Path) -> None:
    inside = tmp_path / "in"
    inside.mkdir()
    picture(tmp_path / "red.png", (200, 30, 30))
    (inside / "Link").symlink_to(tmp_path)
    (inside / "b.obj").write_text("mtllib b.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nusemtl m\nf 1 2 3\n")
    (inside / "b.mtl").write_text("newmtl m\nmap_Kd link/red.png\n")
    with pytest.raises(InputError, match="outside its own folder"):
        load(inside / "b.obj")


def variants(folder: Path) -> Path:
    """A triangle in red, whose variants "blue" and "a=b" are others."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    (folder / "x.bin").write_bytes(positions.tobytes())
    colors = [(1, 0, 0, 1), (0, 0, 1, 1), (0, 1, 0, 1)]
    mappings = [{"material": 1, "variants": [0]}, {"material": 2, "variants": [1]}]
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_variants"],
        "extensions": {"KHR_materials_variants": {"variants": [{"name": "blue"}, {"name": "a=b"}]}},
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0},
                        "material": 0,
                        "extensions": {"KHR_materials_variants": {"mappings": mappings}},
                    }
                ]
            }
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": c}} for c in colors],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 3,
                "type": "VEC3",
                "min": [0, 0, 0],
                "max": [1, 1, 0],
            }
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"uri": "x.bin", "byteLength": 36}],
    }
    (folder / "x.gltf").write_text(json.dumps(document))
    return folder / "x.gltf"


def test_a_material_variant_of_gltf_is_chosen_by_its_name(tmp_path: Path) -> None:
    path = variants(tmp_path)
    plain = load(path)
    assert plain.meshes[0].material.base_color == (1, 0, 0)
    assert [n for n in plain.notes if "'blue', 'a=b'" in n]
    assert load(path, variants={"": "blue"}).meshes[0].material.base_color == (0, 0, 1)
    assert load(path, variants={"a": "b"}).meshes[0].material.base_color == (0, 1, 0)
    with pytest.raises(InputError, match="no variant 'green'; there are 'blue', 'a=b'"):
        load(path, variants={"": "green"})
    with pytest.raises(InputError, match="one variant at a time"):
        load(path, variants={"": "blue", "a": "b"})


def test_variants_of_formats_without_any_are_refused(tmp_path: Path) -> None:
    (tmp_path / "x.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n")
    with pytest.raises(InputError, match="no variants"):
        load(tmp_path / "x.obj", variants={"": "blue"})
