"""What a file of many parts costs: what is shared is read and mended once, what is alike is noted
once. Counted in calls and lines, not in seconds."""

from __future__ import annotations

from collections import Counter
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import batch, load, save, usd_read, usd_write, uv_unification, validate
from appearance_opt.asset.gltf_accessors import Document
from appearance_opt.asset.gltf_read import _Reader
from appearance_opt.asset.notes import LINES, Notes
from appearance_opt.asset.rows import count_unique_rows, rank_rows, unique_rows
from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.asset.validate import Validation
from appearance_opt.reference import mesh as mesh_reference
from appearance_opt.render.texture_upload import Base, build_pyramid
from tests.conftest import grid_sphere
from tests.test_asset_gltf import write_glb
from tests.test_asset_gltf_nodes import ball, document


def count_calls(monkeypatch: pytest.MonkeyPatch, owner: object, name: str) -> Counter:
    """Calls of a method or function by their first argument after the object, as they happen."""
    calls: Counter = Counter()
    original = getattr(owner, name)

    def counted(*arguments: object, **named: object) -> object:
        calls[str(arguments[1] if isinstance(owner, type) else name)[:200]] += 1
        return original(*arguments, **named)

    monkeypatch.setattr(owner, name, counted)
    return calls


def test_notes_of_a_kind_are_one_line() -> None:
    note = Notes()
    for k in range(5):
        note(f"material 'm{k}': drawn opaque")
        note(f"mesh 'n{k}': {k + 1} faces dropped")
        note("animations dropped")
    note("mesh 'n0': unusable tangents recomputed")
    note("'/a': skinning dropped")
    assert note.lines() == (
        "materials 'm0', 'm1', 'm2' and 2 more: drawn opaque",
        "meshes 'n0', 'n1', 'n2' and 2 more: 15 faces dropped",
        "animations dropped",
        "mesh 'n0': unusable tangents recomputed",
        "'/a': skinning dropped",
    )
    many = Notes()
    for k in range(100):
        many(f"file {k} is not there", "files that are not there")
    assert (
        len(many.lines()) == LINES + 1
        and many.lines()[-1] == "... and 92 more: files that are not there"
    )


def test_an_accessor_is_read_once_and_a_primitive_keeps_what_it_uses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    positions, faces, _ = grid_sphere(8, 16)
    given, binary = document({"POSITION": positions, "NORMAL": positions}, faces)
    primitive = given["meshes"][0]["primitives"][0]
    view = given["accessors"][primitive["indices"]]
    given["meshes"] = []
    for k in range(0, len(faces), 7):
        given["accessors"].append(view | {"byteOffset": 12 * k, "count": 3 * len(faces[k : k + 7])})
        given["meshes"].append(
            {"primitives": [primitive | {"indices": len(given["accessors"]) - 1}]}
        )
    given["nodes"] = [{"mesh": k} for k in range(len(given["meshes"]))]
    given["scenes"] = [{"nodes": list(range(len(given["nodes"])))}]
    write_glb(tmp_path / "x.glb", given, binary)
    calls = count_calls(monkeypatch, Document, "_read_accessor")
    asset = load(tmp_path / "x.glb", mend=False)
    assert max(calls.values()) == 1
    assert len(asset.meshes) == len(given["meshes"])
    assert all(len(m.positions) == len(np.unique(m.faces)) for m in asset.meshes)
    got = np.concatenate([m.positions[m.faces] for m in asset.meshes])
    np.testing.assert_array_equal(got, positions[faces])
    assert not load(tmp_path / "x.glb").notes


def test_nodes_that_share_a_mesh_read_it_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    positions, faces, _ = grid_sphere(4, 8)
    nodes = [{"mesh": 0, "name": f"n{k}", "translation": [k, 0, 0]} for k in range(50)]
    given, binary = document({"POSITION": positions, "NORMAL": positions}, faces, nodes=nodes)
    given["scenes"] = [{"nodes": list(range(50))}]
    write_glb(tmp_path / "x.glb", given, binary)
    calls = count_calls(monkeypatch, _Reader, "_read")
    asset = load(tmp_path / "x.glb")
    assert calls.total() == 1
    assert [m.name for m in asset.meshes] == [f"n{k}" for k in range(50)]
    np.testing.assert_allclose(
        asset.meshes[49].positions, asset.meshes[0].positions + [49, 0, 0], atol=1e-5
    )


def test_instances_are_one_mesh_with_turned_faces_where_they_are_mirrored(tmp_path: Path) -> None:
    positions, faces = ball(1)
    uvs = positions[:, :2].copy()
    scale = np.array([[1, 1, 1], [-1, 1, 2], [1, -1, -1]], np.float32)
    instancing = {"EXT_mesh_gpu_instancing": {"attributes": {"SCALE": 3}}}
    given, binary = document(
        {"POSITION": positions, "NORMAL": positions, "TEXCOORD_0": uvs}, faces, (scale,),
        nodes=[{"mesh": 0, "extensions": instancing}], extensionsUsed=list(instancing),
    )  # fmt: skip
    write_glb(tmp_path / "x.glb", given, binary)
    (mesh,) = load(tmp_path / "x.glb").meshes
    n, f = len(positions), len(faces)
    for k, s in enumerate(scale):
        part = slice(k * n, (k + 1) * n)
        np.testing.assert_allclose(mesh.positions[part], positions * s, atol=1e-6)
        np.testing.assert_array_equal(mesh.uvs[part], uvs)
        normals = positions / s
        np.testing.assert_allclose(
            mesh.normals[part], normals / np.linalg.norm(normals, axis=1, keepdims=True), atol=1e-5
        )
        turned = faces[:, ::-1] if np.prod(s) < 0 else faces
        np.testing.assert_array_equal(mesh.faces[k * f : (k + 1) * f], turned + k * n)


def spoilt_asset(count: int) -> tuple[Asset, list[int]]:
    """(small meshes, numbers of those that have a fault of some kind)."""
    positions, faces = ball(1)
    normals, uvs = positions.copy(), positions[:, :2].copy()
    nan = np.float32(np.nan)
    faults = {
        5: {"faces": np.concatenate([faces, [[0, 0, 1]]]).astype(np.int32)},
        11: {
            "positions": np.concatenate([positions, [[9, 9, 9]]]).astype(np.float32),
            "normals": None,
            "uvs": None,
        },
        17: {"uvs": uvs * np.float32(1e9)},
        23: {"normals": normals * nan},
        29: {"normals": normals * 2},
        31: {"tangents": np.zeros((len(positions), 4), np.float32)},
        37: {"normals": None, "tangents": np.ones((len(positions), 4), np.float32)},
        41: {"colors": positions},
    }
    meshes = [
        replace(Mesh(positions, faces, normals, uvs, name=f"m{k}"), **faults.get(k, {}))  # type: ignore[arg-type]
        for k in range(count)
    ]
    return Asset(tuple(meshes)), sorted(faults)


def test_only_meshes_with_faults_are_mended_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    asset, faulty = spoilt_asset(300)
    calls = count_calls(monkeypatch, validate, "_repair")
    mended = validate.repair(asset, "x")
    assert calls.total() == len(faulty)
    monkeypatch.setattr(validate, "_suspects", lambda meshes: np.ones(len(meshes), bool))
    each = validate.repair(asset, "x")
    assert each.notes == mended.notes
    for one, other in zip(mended.meshes, each.meshes, strict=True):
        for name in ("positions", "faces", "normals", "uvs", "tangents", "colors"):
            a, b = getattr(one, name), getattr(other, name)
            assert (a is None) == (b is None)
            if a is not None:
                np.testing.assert_array_equal(a, b)


def test_counts_of_many_meshes_are_the_sums_of_each() -> None:
    asset, _ = spoilt_asset(60)
    every = validate.validate(asset)
    each = [validate.validate(replace(asset, meshes=(m,))) for m in asset.meshes]
    for f in fields(Validation):
        assert getattr(every, f.name) == sum(getattr(one, f.name) for one in each), f.name
    assert (
        every.connected_parts == 60
        and every.degenerate_faces == 1
        and every.unreferenced_vertices == 1
    )


class CountedReads(list):
    """A list that counts how many of its elements are looked at."""

    reads = 0

    def __iter__(self):
        self.reads += len(self)
        return super().__iter__()

    def __getitem__(self, key):
        self.reads += 1
        return super().__getitem__(key)


@pytest.mark.parametrize("place", [uv_unification.unify, uv_unification.keep_first_sets])
def test_texture_frames_take_time_in_proportion_to_materials(place) -> None:
    positions, faces, uvs = grid_sphere(2, 3)
    reads = []
    for count in (20, 200):
        materials = [Material(f"m{k}") for k in range(count)]
        meshes = CountedReads(Mesh(positions, faces, uvs=uvs, material=m) for m in materials)
        place(meshes, {id(m): {} for m in materials}, lambda text: None)
        reads.append(meshes.reads)
    assert reads[1] == 10 * reads[0]


def test_rows_are_found_equal_as_numpy_finds_them() -> None:
    rng = np.random.default_rng(1)
    for top in (3, 2**40):  # three numbers of 41 bits do not fit into one of 62
        rows = rng.integers(0, 3, (500, 3)) * (top // 3)
        expected, inverse = np.unique(rows, axis=0, return_inverse=True)
        first, kind = unique_rows(rows)
        np.testing.assert_array_equal(rows[first], expected)
        np.testing.assert_array_equal(kind, inverse.ravel())
        assert count_unique_rows(rows) == len(expected)
        values = rows - 1.5
        np.testing.assert_array_equal(
            np.unique(values, axis=0), values[unique_rows(rank_rows(values))[0]]
        )


USD_INSTANCES = """#usda 1.0
( upAxis = "Y"
  metersPerUnit = 1 )
def Xform "Shape"
{
%s
}
%s
def PointInstancer "Many"
{
    rel prototypes = </Shape/T>
    int[] protoIndices = [%s]
    point3f[] positions = [%s]
}
"""


def test_instances_of_usd_are_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tent = """def Mesh "T"
    {
        int[] faceVertexCounts = [3, 3]
        int[] faceVertexIndices = [0, 1, 2, 2, 1, 3]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 1)]
        uniform token subdivisionScheme = "none"
    }"""
    copies = "\n".join(
        f'def Xform "C{k}" (\n instanceable = true\n references = </Shape>\n)\n'
        f"{{\n double3 xformOp:translate = ({k}, 5, 0)\n"
        ' uniform token[] xformOpOrder = ["xformOp:translate"]\n}'
        for k in range(20)
    )
    count = 30
    where = ", ".join(f"({k}, 0, 0)" for k in range(count))
    path = tmp_path / "x.usda"
    path.write_text(USD_INSTANCES % (tent, copies, ", ".join(["0"] * count), where))
    calls = count_calls(monkeypatch, usd_read._Reader, "_split")
    asset = load(path)
    assert calls.total() == 3  # of the shape itself, of the twenty copies, of the thirty instances
    assert [len(m.faces) for m in asset.meshes] == [2] * 21 + [60]
    np.testing.assert_allclose([m.positions[0, 0] for m in asset.meshes[1:21]], np.arange(20))
    alone, instances = asset.meshes[0], asset.meshes[-1]
    every = instances.normals.reshape(count, -1, 3)
    np.testing.assert_allclose(every, np.broadcast_to(alone.normals, every.shape), atol=1e-6)


def test_many_meshes_are_merged_in_one_go_as_each_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Normals and tangents of touching meshes do not mix."""
    positions, faces = (np.array(a) for a in ball(1))
    uvs = positions[:, :2] * np.float32(0.4)
    bump = Texture(np.full((1, 1, 3), 128, np.uint8))
    wearing = Material(normal_texture=bump)
    kinds: list[dict] = [
        {}, {"uvs": uvs, "material": wearing}, {"uvs": uvs, "normals": positions, "material": wearing},
        {"colors": np.full((len(positions), 3), 0.25, np.float32)},
    ]  # fmt: skip
    # open fans of the ball: their borders would be smoothed across if they were taken for one
    # surface
    meshes = []
    for k in range(40):
        used, corners = np.unique(faces[2 * k : 2 * k + 2], return_inverse=True)
        given = {n: v[used] if isinstance(v, np.ndarray) else v for n, v in kinds[k % 4].items()}
        meshes.append(Mesh(positions[used], corners.reshape(-1, 3).astype(np.int32), **given))
    numbers = [m.material is wearing for m in meshes]
    each = [
        mesh_reference.merge(Asset((m,)), [n], True) for m, n in zip(meshes, numbers, strict=True)
    ]
    calls = count_calls(monkeypatch, batch, "summed_normals")
    every = mesh_reference.merge(Asset(tuple(meshes)), numbers, True)
    assert calls.total() == 1
    np.testing.assert_array_equal(every.material, np.repeat(numbers, 2))
    for name in ("positions", "normals", "uvs", "tangents"):
        own = np.concatenate([getattr(m, name)[m.faces] for m in each])
        np.testing.assert_allclose(getattr(every, name)[every.faces], own, atol=1e-6)
    expected = np.repeat([0.25 if k % 4 == 3 else 1.0 for k in range(40)], 2)
    np.testing.assert_array_equal(every.colors[every.faces[:, 0], 0], expected.astype(np.float32))


def test_materials_of_all_sizes_share_one_buffer() -> None:
    rng = np.random.default_rng(0)
    bases = [rng.random((n, n, 8)).astype(np.float32) for n in (1, 1, 2, 1, 1, 1)]
    pyramid = build_pyramid([Base.of(b) for b in bases], [0] * len(bases))
    texels = np.array(pyramid.texels).reshape(-1, 8)
    for base, offsets in zip(bases, pyramid.layout.offsets, strict=True):
        np.testing.assert_array_equal(
            texels[offsets[0] : offsets[0] + base[..., 0].size], base.reshape(-1, 8)
        )


def test_many_meshes_are_written_in_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(usd_write, "SIBLINGS", 3)
    positions, faces = (np.array(a) for a in ball(0))
    meshes = [Mesh(positions + np.float32(k), faces, positions, name=f"m{k}") for k in range(8)]
    save(Asset(tuple(meshes)), tmp_path / "x.usda")
    again = load(tmp_path / "x.usda").meshes
    assert [m.name for m in again] == [f"G{k}_m{k}" for k in range(8)]
    np.testing.assert_allclose(
        [m.positions for m in again], [m.positions for m in meshes], atol=1e-6
    )
    assert (tmp_path / "x.usda").read_text().count('def Scope "Group') == 3


def test_warnings_of_usd_that_differ_in_names_are_counted(tmp_path: Path) -> None:
    parts = "".join(f'def "p{k}" (\n references = @gone{k}.usda@\n)\n{{\n}}\n' for k in range(30))
    mesh = """def Mesh "m"
{
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
}
"""
    (tmp_path / "x.usda").write_text("#usda 1.0\n" + mesh + parts)
    told = [note for note in load(tmp_path / "x.usda").notes if "gone" in note or "more" in note]
    assert len(told) == LINES + 1 and told[-1].startswith("... and 22 more: ")


def test_materials_that_are_not_defined_are_counted(tmp_path: Path) -> None:
    faces = "".join(f"usemtl m{k}\nf 1 2 3\n" for k in range(50))
    (tmp_path / "x.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + faces)
    about = [n for n in load(tmp_path / "x.obj").notes if "defined" in n]
    assert about == [
        "materials 'm0', 'm1', 'm2' and 47 more: not defined, the default material is used"
    ]
