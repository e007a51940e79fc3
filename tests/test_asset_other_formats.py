"""OBJ, USD, PLY, STL."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from appearance_opt.asset import images, load, save
from appearance_opt.asset.polygons import Polygons
from appearance_opt.asset.subdivide import catmull_clark
from appearance_opt.asset.types import Asset
from appearance_opt.asset.validate import validate
from appearance_opt.errors import InputError

OBJ = """mtllib x.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl red paint
f 1/1 2/2 3/3 4/4
f -4/1 -3/2 -2/3
"""
MTL = "newmtl red paint\nKd 0.8 0.1 0.2\nPr 0.25\nPm 1\n"


def test_obj_polygons_negative_indices_and_material(tmp_path: Path) -> None:
    (tmp_path / "x.obj").write_text(OBJ)
    (tmp_path / "x.mtl").write_text(MTL)
    mesh = load(tmp_path / "x.obj").meshes[0]
    assert len(mesh.faces) == 3
    assert mesh.material.base_color == pytest.approx((0.8, 0.1, 0.2))
    assert (mesh.material.roughness, mesh.material.metalness) == (0.25, 1.0)
    # v grows downward inside, upward in OBJ
    bottom = mesh.positions[:, 1] == 0
    assert (mesh.uvs[bottom, 1] == 1).all()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("v 0 0 0\n", "no triangles"),
        ("v 0 0 0\nf 1 2 9\n", "refers to position 9"),
        ("v 0 0 x\n", "line 1"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", "no triangles.*fewer than three corners"),
        ("mtllib ../outside.mtl\n", "outside"),
        ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "NaN"),
    ],
)
def test_unusable_obj_files_say_why(tmp_path: Path, text: str, words: str) -> None:
    folder = tmp_path / "asset"
    folder.mkdir()
    (tmp_path / "outside.mtl").write_text(MTL)
    (folder / "x.obj").write_text(text)
    with pytest.raises(InputError, match=words):
        load(folder / "x.obj")


@settings(max_examples=80)
@given(at=st.integers(0, len(OBJ) - 1), byte=st.integers(0, 255), cut=st.integers(0, len(OBJ)))
def test_damaged_obj_is_refused_or_read(tmp_path: Path, at: int, byte: int, cut: int) -> None:
    data = bytearray(OBJ.encode())
    data[at] = byte
    (tmp_path / "x.obj").write_bytes(bytes(data[: len(data) - cut]))
    (tmp_path / "x.mtl").write_text(MTL)
    try:
        load(tmp_path / "x.obj")
    except InputError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize("suffix", [".obj", ".usda", ".usdc", ".usdz", ".glb"])
def test_round_trip_through_every_writer(tmp_path: Path, ball: Asset, suffix: str) -> None:
    save(ball, tmp_path / f"x{suffix}")
    again, mesh = load(tmp_path / f"x{suffix}").meshes[0], ball.meshes[0]
    assert len(again.faces) == len(mesh.faces)
    # OBJ writes nine digits: exact for float32
    before, after = mesh.positions[mesh.faces], again.positions[again.faces]
    np.testing.assert_allclose(after, before, atol=1e-7)
    np.testing.assert_allclose(again.uvs[again.faces], mesh.uvs[mesh.faces], atol=1e-6)
    np.testing.assert_array_equal(
        again.material.base_color_texture.pixels, mesh.material.base_color_texture.pixels
    )
    np.testing.assert_array_equal(
        again.material.orm_texture.pixels[..., 1:], mesh.material.orm_texture.pixels[..., 1:]
    )
    assert {p.name for p in tmp_path.iterdir() if p.name.startswith(".")} == set()


@pytest.mark.parametrize("suffix", [".obj", ".glb", ".usda"])
def test_meshes_that_do_not_have_the_same_attributes(
    tmp_path: Path, ball: Asset, suffix: str
) -> None:
    """One without texture coordinates, one without normals, one with neither, before one with
    both."""
    mesh = ball.meshes[0]
    bare = [
        replace(mesh, uvs=None),
        replace(mesh, normals=None),
        replace(mesh, uvs=None, normals=None),
        mesh,
    ]
    save(
        Asset(tuple(replace(m, tangents=None, name=f"m{k}") for k, m in enumerate(bare)), "x"),
        tmp_path / f"x{suffix}",
    )
    again = load(tmp_path / f"x{suffix}").meshes
    assert len(again) == 4
    # normals that a format lacks are computed
    assert [(m.uvs is not None) for m in again].count(True) == 2
    for m in again:
        np.testing.assert_allclose(
            np.ptp(m.positions, axis=0), np.ptp(mesh.positions[mesh.faces.ravel()], axis=0)
        )
        if m.uvs is not None:
            np.testing.assert_allclose(
                np.sort(m.uvs[m.faces].ravel()), np.sort(mesh.uvs[mesh.faces].ravel()), atol=1e-6
            )


def test_usd_up_axis_and_units(tmp_path: Path) -> None:
    (tmp_path / "x.usda").write_text(
        '#usda 1.0\n(upAxis = "Z"\nmetersPerUnit = 0.01)\n'
        'def Mesh "m"\n{\nint[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, 2]\n'
        'point3f[] points = [(0, 0, 0), (100, 0, 0), (0, 0, 200)]\nuniform token subdivisionScheme = "none"\n}\n'
    )
    p = load(tmp_path / "x.usda").meshes[0].positions
    np.testing.assert_allclose(p[np.lexsort(p.T)], [[0, 0, 0], [1, 0, 0], [0, 2, 0]], atol=1e-6)


def test_a_root_allows_files_outside_of_the_own_folder(tmp_path: Path, ball: Asset) -> None:
    """As productions lay them out: an asset refers to a folder beside its own."""
    for name in ("library", "shot"):
        (tmp_path / name).mkdir()
    save(ball, tmp_path / "library" / "ball.usda")
    scene = tmp_path / "shot" / "scene.usda"
    scene.write_text(
        '#usda 1.0\n(metersPerUnit = 1\nupAxis = "Y"\nsubLayers = [@../library/ball.usda@])\n'
    )
    with pytest.raises(InputError, match=r"outside its own folder.*--root"):
        load(scene)
    with pytest.raises(InputError, match="no such folder"):
        load(scene, root=tmp_path / "absent")
    with pytest.raises(InputError, match="outside its own folder"):
        load(scene, root=tmp_path / "shot")
    mesh = load(scene, root=tmp_path).meshes[0]
    assert len(mesh.faces) == len(ball.meshes[0].faces)
    assert mesh.material.base_color_texture is not None


def test_several_material_files_in_one_statement(tmp_path: Path) -> None:
    (tmp_path / "b.mtl").write_text("newmtl green\nKd 0 1 0\n")
    (tmp_path / "with space.mtl").write_text("newmtl red\nKd 1 0 0\n")
    path = tmp_path / "x.obj"
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl {}\nf 1 2 3\n"
    path.write_text("mtllib a.mtl b.mtl\n" + text.format("green"))
    with pytest.raises(InputError, match=r"a\.mtl.*does not exist"):
        load(path)
    assert load(path, missing_textures="ignore").meshes[0].material.base_color == (0, 1, 0)
    path.write_text("mtllib with space.mtl\n" + text.format("red"))
    assert load(path).meshes[0].material.base_color == (1, 0, 0)


def test_normals_that_an_obj_file_does_not_have_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "x.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1//7 2//8 3//9\n")
    asset = load(path)
    assert asset.meshes[0].normals is None or np.isfinite(asset.meshes[0].normals).all()
    assert any("normals" in note for note in asset.notes)


def test_tga_textures_in_memory(tmp_path: Path) -> None:
    pixels = np.array([[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (9, 8, 7)]], np.uint8)
    head = bytes(
        [0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0, 2, 0, 24, 0x20]
    )  # uncompressed, rows from the top
    np.testing.assert_array_equal(images.decode(head + pixels[..., ::-1].tobytes(), "x"), pixels)


def test_usd_reference_outside_its_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "out.usda").write_text('#usda 1.0\ndef Mesh "m" {}\n')
    (tmp_path / "a" / "x.usda").write_text("#usda 1.0\n(subLayers = [@../out.usda@])\n")
    with pytest.raises(InputError, match="outside"):
        load(tmp_path / "a" / "x.usda")


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".ply", ".stl", ".glb", ".gltf"])
@pytest.mark.parametrize("content", [b"", b"rubbish\0\xff"])
def test_rubbish_is_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    (tmp_path / f"x{suffix}").write_bytes(content)
    with pytest.raises(InputError, match="x" + suffix):
        load(tmp_path / f"x{suffix}")


@pytest.mark.parametrize("suffix", ["ply", "stl"])
def test_geometry_formats(tmp_path: Path, suffix: str) -> None:
    trimesh.creation.box().export(tmp_path / f"x.{suffix}")
    asset = load(tmp_path / f"x.{suffix}")
    report = validate(asset)
    assert (report.triangles, report.boundary_edges, report.connected_parts) == (12, 0, 1)


def test_strips_of_a_ply_file_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "x.ply").write_bytes(
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        b"element tristrips 1\nproperty list int int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    with pytest.raises(InputError, match="triangle strips"):
        load(tmp_path / "x.ply")


def test_catmull_clark_of_a_cube_tends_to_its_known_limit() -> None:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    quads = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]
    values, polygons = corners, Polygons(np.full(6, 4), np.array(quads))
    values, polygons, _ = catmull_clark(values, polygons, False)
    assert (len(values), len(polygons.counts)) == (8 + 12 + 6, 24)
    # first level by hand: corner (F + 2R + 0 V) / 3 with F, R the means of face points and edge
    # middles
    np.testing.assert_allclose(np.abs(values[:8]), 5 / 9, atol=1e-12)
    np.testing.assert_allclose(sorted(np.abs(values[8])), [0, 0.75, 0.75], atol=1e-12)


def test_folders_may_be_links(assets_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "linked").symlink_to(assets_dir / "chess_king")
    asset = load(tmp_path / "linked" / "King.usd", refine=0, variants={"shadingVariant": "White"})
    assert asset.meshes[0].material.normal_texture is not None


def test_a_chess_piece_reads_as_refined(assets_dir: Path) -> None:
    path = assets_dir / "chess_king" / "King.usd"
    asset = load(path, variants={"shadingVariant": "White"})
    assert asset.triangle_count == 162112
    assert asset.meshes[0].material.normal_texture is not None
    with pytest.raises(InputError, match="king_black_base_color"):
        load(path)
    with pytest.raises(InputError, match="no variant"):
        load(path, variants={"shadingVariant": "Green"})


def test_usd_output_passes_usd_validation(tmp_path: Path, ball: Asset) -> None:
    usd = pytest.importorskip("pxr.Usd")
    validation = pytest.importorskip("pxr.UsdValidation")
    save(ball, tmp_path / "x.usda")
    stage = usd.Stage.Open(str(tmp_path / "x.usda"))
    registry = validation.ValidationRegistry()
    context = validation.ValidationContext(registry.GetOrLoadAllValidators())
    errors = [
        e for e in context.Validate(stage) if e.GetType() == validation.ValidationErrorType.Error
    ]
    assert not errors, [e.GetMessage() for e in errors]


def test_nothing_is_left_behind_when_writing_fails(
    tmp_path: Path, ball: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "x.glb").write_bytes(b"old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        save(ball, tmp_path / "x.glb")
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ["x.glb"]
    assert (tmp_path / "x.glb").read_bytes() == b"old"
