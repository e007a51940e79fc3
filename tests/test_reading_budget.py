"""A few bytes must not ask for any amount of memory or time: what an asset takes is counted before
it is made."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import images, load, mtl, resampling, uv_transforms, uv_unification
from appearance_opt.asset.budget import BYTES, Budget
from appearance_opt.asset.companions import Companions
from appearance_opt.asset.polygons import MOST_CORNERS, Polygons, triangulate
from appearance_opt.asset.types import Asset, Material, Texture
from appearance_opt.errors import InputError
from appearance_opt.initial.atlas import unwrap, uv_areas
from tests.test_reading_door import LAYER, triangle

MESH = (
    "int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, 2]\n"
    "point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]\n"
)


def written(tmp_path: Path, document: dict) -> Path:
    path = tmp_path / "x.gltf"
    path.write_text(json.dumps(document))
    return path


def test_a_budget_is_one_for_all_kinds_and_says_what_would_exceed_it() -> None:
    budget = Budget(limit=1000 * BYTES["vertices"])
    budget.take(600, "vertices", "x.glb")
    budget.take_picture(4, 4, 3, "x.png")
    with pytest.raises(InputError, match=r"x.glb: with 500 vertices, .* may be used here"):
        budget.take(500, "vertices", "x.glb")
    assert budget.used == 600 * BYTES["vertices"] + 4 * 4 * 3 * 2  # what was refused is not taken


def test_pictures_count_before_they_are_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = images.encode_png(np.zeros((64, 64, 3), np.uint8))
    companions = Companions(budget=Budget(limit=3 * 64 * 64 * 3 * 2))
    for _ in range(3):
        assert companions.decoded(data, "x.png").shape == (64, 64, 3)
    with pytest.raises(InputError, match="a picture of 64 x 64 pixels"):
        companions.decoded(data, "x.png")


def test_nodes_that_share_their_children_are_counted_not_walked(tmp_path: Path) -> None:
    nodes = [{"children": [k + 1, k + 1]} for k in range(40)] + [{"mesh": 0}]
    with pytest.raises(InputError, match=r"with 2,199,023,255,551 nodes"):
        load(written(tmp_path, triangle(nodes=nodes)))
    nodes = [{"children": [k + 1, k + 1]} for k in range(3)] + [{"mesh": 0}]
    assert load(written(tmp_path, triangle(nodes=nodes))).triangle_count == 8


@pytest.mark.parametrize("where", ["positions", "instances"])
def test_accessors_without_data_are_no_longer_than_those_with(tmp_path: Path, where: str) -> None:
    document = triangle()
    document["accessors"].append({"componentType": 5126, "count": 1 << 24, "type": "VEC3"})
    if where == "positions":
        document["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = 1
    else:
        instancing = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 1}}}
        document["nodes"][0]["extensions"] = instancing
    with pytest.raises(InputError, match="16777216 elements but no data"):
        load(written(tmp_path, document))


def test_instances_of_instances_are_counted_not_walked(tmp_path: Path) -> None:
    levels = 12
    text = LAYER.replace('"R"\n{', '"R" (\n references = </L0>\n)\n{')
    for k in range(levels):
        child = f" (\n instanceable = true\n references = </L{k + 1}>\n)\n{{\n}}\n"
        text += (
            f'class "L{k}"\n{{\n' + "".join(f'def Xform "c{j}"{child}' for j in range(10)) + "}\n"
        )
    text += f'class "L{levels}"\n{{\ndef Mesh "m"\n{{\n{MESH}}}\n}}\n'
    path = tmp_path / "x.usda"
    path.write_text(text)
    with pytest.raises(InputError, match=r"with [0-9,]{15,} prims"):
        load(path)


@pytest.mark.parametrize("refine", [-1, 6, 30])
def test_levels_of_refinement_have_a_bound_everywhere(tmp_path: Path, refine: int) -> None:
    with pytest.raises(InputError, match=r"--refine .* from 0 to 5"):
        load(written(tmp_path, triangle()), refine=refine)


@pytest.mark.parametrize("size", ["nan", "inf", "-1"])
def test_shapes_without_a_size_are_refused_by_name(tmp_path: Path, size: str) -> None:
    path = tmp_path / "x.usda"
    path.write_text(
        LAYER.replace('"R"\n{', f'"R"\n{{\ndef Sphere "s"\n{{\ndouble radius = {size}\n}}\n')
    )
    with pytest.raises(InputError, match=r"the radius of '/R/s' is"):
        load(path)


def test_faces_that_are_no_polygons_take_no_more_time_than_others() -> None:
    """Ears of a face that visits a few places over and over would take a time that grows with the
    cube of its corners: hours here."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.2, 0.1, 0]])
    count = 100_000
    again = Polygons(np.array([count]), np.tile(np.arange(4), count // 4))
    with pytest.raises(ValueError, match=f"{count} corners"):
        triangulate(again, corners)
    again = Polygons(np.array([MOST_CORNERS]), np.tile(np.arange(4), MOST_CORNERS // 4))
    triangles, _ = triangulate(again, corners)
    assert len(triangles) == MOST_CORNERS - 2


def test_upright_grids_are_resampled_as_other_places_are() -> None:
    rng = np.random.default_rng(0)
    for wrap in (("repeat", "clamp"), ("mirror", "repeat")):
        texture = Texture(rng.integers(0, 255, (5, 7, 3)).astype(np.uint8), "srgb", wrap)
        u, v = rng.uniform(-2, 2, 11), rng.uniform(-2, 2, 13)
        y, x = np.meshgrid(v, u, indexing="ij")
        wanted = resampling.bilinear(texture, np.stack([x.ravel(), y.ravel()], 1)).reshape(
            13, 11, 3
        )
        np.testing.assert_allclose(resampling.bilinear_grid(texture, u, v), wanted, atol=1e-9)
        middles = (np.arange(-7, 14) + 0.5) / 7
        copied = resampling.bilinear_grid(texture, middles, (np.arange(5) + 0.5) / 5)
        assert copied.dtype == np.uint8
        np.testing.assert_array_equal(copied[:, 7:14], texture.pixels)


def test_resampled_textures_have_a_bound_together(
    ball: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Small pictures with different wrap modes, repeated often, would become large ones."""
    monkeypatch.setattr(uv_unification, "ASSET_TEXELS", 2 * 40 * 40)
    one = Texture(np.zeros((4, 4, 3), np.uint8), "srgb")
    other = Texture(np.zeros((4, 4, 3), np.uint8), "linear", ("clamp", "clamp"))
    meshes, frames = [], {}
    for k in range(3):
        material = Material(f"m{k}", base_color_texture=one, orm_texture=other)
        meshes.append(replace(ball.meshes[0], uvs=ball.meshes[0].uvs * 8, material=material))
        whole = uv_transforms.UvTransform(uv_transforms.affine(None))
        frames[id(material)] = {"base_color_texture": whole, "orm_texture": whole}
    notes: list[str] = []
    uv_unification.unify(meshes, frames, notes.append)
    assert [("too large" in n) for n in notes] == [False, True, True]


def test_a_material_file_named_again_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "x.mtl").write_text("newmtl m\nKd 1 0 0\n")
    (tmp_path / "x.obj").write_text(
        "mtllib x.mtl\n" * 9 + "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n"
    )
    made: list[str] = []
    whole = mtl.MaterialReader._material
    monkeypatch.setattr(
        mtl.MaterialReader,
        "_material",
        lambda self, name, *rest: made.append(name) or whole(self, name, *rest),
    )
    assert load(tmp_path / "x.obj").meshes[0].material.base_color == (1.0, 0.0, 0.0)
    assert made == ["m"]


def test_faces_too_thin_or_small_for_the_unwrapper_have_charts_of_their_own() -> None:
    octahedron = np.array(
        [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], np.float64
    )
    sides = np.array(
        [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    )
    far = np.concatenate([octahedron, octahedron + [1e6, 0, 0]]), np.concatenate([sides, sides + 6])
    thin = np.array([[3, 0, 0], [4, 1e-8, 0], [5, 0, 0]])
    mixed = np.concatenate([octahedron, thin]), np.concatenate([sides, [[6, 7, 8], [8, 6, 7]]])
    for positions, faces in (far, mixed, (thin, np.array([[0, 1, 2]]))):
        mesh = unwrap(positions, faces, 64)
        assert (mesh.frame_vertex[mesh.frame_faces] == mesh.faces).all()
        assert mesh.uvs.min() >= 0 and mesh.uvs.max() <= 1
        area = uv_areas(mesh)
        assert area.min() * 64 * 64 > 1  # each face has a texel of its own
        assert area.sum() < 1  # and none lies on another
