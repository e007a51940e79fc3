"""Parts of a file: names, hierarchy, pivots, extras and copyright go in and out; what is dropped is
said."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from appearance_opt.asset import FileOptions, hierarchy, load, save
from appearance_opt.asset.types import Asset, Credits, Mesh, Node
from appearance_opt.jobs.inspect import inspect
from tests.conftest import grid_sphere
from tests.test_written_files import document, painted, part
from tests.validators import khronos_messages, usd_messages

SHEAR = np.eye(4)
SHEAR[0, 1] = 0.5


def placed(
    translation: tuple[float, ...] = (0, 0, 0),
    turn: tuple[float, ...] = (0, 0, 0),
    scale: float | tuple[float, ...] = 1.0,
) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix() * scale
    out[:3, 3] = translation
    return out


NODES = (
    Node("car", None, placed((1, 2, 3), (0, 30, 0)), {"id": 7, "tags": ["a", None]}),
    Node("door", 0, placed((0.5, 0, 0), (0, 0, 40), 2.0)),
    Node("handle", 1, placed((0, 0.2, 0), (10, 20, 30), (1.0, 0.5, 2.0))),
    Node("hook", 0, placed((0, -1, 0))),
    Node("mirror", 0, placed((-0.5, 0, 0), scale=(-1.0, 1.0, 1.0))),
)


def car(nodes: tuple[Node, ...] = NODES) -> Asset:
    """A part for each node but the hook, one of them of two meshes."""
    body = part(painted(), name="car")
    meshes = (
        replace(body, node=0),
        replace(part(painted(), 2.5, "door"), node=1),
        replace(part(painted(double_sided=False), 5.0, "handle"), node=2),
        replace(part(painted(), 5.0, "handle.1"), node=2),
        replace(part(painted(), 7.5, "mirror"), node=4),
    )
    return Asset(meshes, "model", nodes=nodes, credits=Credits("(c) the author", {"job": 3}))


def world(asset: Asset) -> dict[str, np.ndarray]:
    """(4, 4) of each node to the world, by name."""
    _, matrices = hierarchy.place_nodes(asset.nodes)
    return {n.name: m for n, m in zip(asset.nodes, matrices, strict=True)}


def points(asset: Asset, mesh: Mesh) -> np.ndarray:
    """The corners of a mesh in the world."""
    return mesh.positions[mesh.faces].reshape(-1, 3).astype(np.float64) + asset.origin


def check_shapes(again: Asset, asset: Asset, tolerance: float = 1e-4) -> None:
    """Fails if meshes are elsewhere, or of other nodes by name."""
    assert len(again.meshes) == len(asset.meshes)
    for one, other in zip(sorted(again.meshes, key=_x), sorted(asset.meshes, key=_x), strict=True):
        found, truth = points(again, one), points(asset, other)
        assert len(found) == len(truth)
        assert cKDTree(found).query(truth)[0].max() <= tolerance
        assert cKDTree(truth).query(found)[0].max() <= tolerance
        names = again.nodes[one.node].name, asset.nodes[other.node].name
        # in USD, shapes beside others, or in a place of their own, are nodes
        assert names[0] == names[1] or (names[0].startswith("G") and names[1] in names[0])


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".usda", ".usdz"])
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (512345.5, 10.0, -4000000.25)])
def test_a_hierarchy_comes_back(
    tmp_path: Path, suffix: str, origin: tuple[float, float, float]
) -> None:
    asset = replace(car(), origin=origin)
    save(asset, tmp_path / f"a{suffix}")
    again = load(tmp_path / f"a{suffix}")
    names = [n.name for n in asset.nodes if n.name != "hook" or suffix in (".glb", ".gltf")]
    assert sorted(set(names) - {n.name for n in again.nodes}) == []
    parents = {
        n.name: None if n.parent is None else again.nodes[n.parent].name for n in again.nodes
    }
    assert parents["car"] is None and parents["door"] == "car" and parents["handle"] == "door"
    for name in names:  # pivots and axes
        np.testing.assert_allclose(world(again)[name], world(asset)[name], rtol=1e-6, atol=1e-6)
    assert again.credits.copyright == "(c) the author"
    if suffix in (".glb", ".gltf"):
        assert again.nodes[0].extras == NODES[0].extras and again.credits.extras == {"job": 3}
    check_shapes(again, asset)


def _x(mesh: Mesh) -> tuple[float, bool]:
    return round(float(mesh.positions[:, 0].mean()), 1), mesh.material.double_sided


def test_meshes_of_a_node_are_one_mesh_of_the_file(tmp_path: Path) -> None:
    save(car(), tmp_path / "a.glb")
    written = document(tmp_path / "a.glb")
    meshes = {m["name"]: len(m["primitives"]) for m in written["meshes"]}
    assert meshes == {"car": 1, "door": 1, "handle": 2, "mirror": 1}
    nodes = {n["name"]: n for n in written["nodes"]}
    assert "mesh" not in nodes["hook"] and nodes["car"]["extras"] == NODES[0].extras
    assert written["asset"]["copyright"] == "(c) the author"
    assert not any("matrix" in n for n in written["nodes"])  # engines keep these three


def test_what_undoes_a_grid_does_not_move_pivots(tmp_path: Path) -> None:
    save(car(), tmp_path / "a.glb", FileOptions(quantize=True))
    again = load(tmp_path / "a.glb")
    for name, matrix in world(car()).items():
        np.testing.assert_allclose(world(again)[name], matrix, rtol=1e-6, atol=1e-6)
    check_shapes(again, car())
    assert [n.name for n in again.nodes] == [n.name for n in car().nodes]


@pytest.mark.parametrize("suffix", [".glb", ".usda"])
@pytest.mark.parametrize("bad", ["sheared", "flat", "not a number"])
def test_transforms_that_engines_do_not_keep(tmp_path: Path, suffix: str, bad: str) -> None:
    """A node keeps its place then, what is below it keeps its own, and no vertex moves."""
    matrix = placed((1, 2, 3), (0, 30, 0)) @ SHEAR
    if bad == "flat":
        matrix = placed((1, 2, 3), scale=(1.0, 0.0, 1.0))
    elif bad == "not a number":
        matrix = np.full((4, 4), np.nan)
    asset = car((replace(NODES[0], matrix=matrix), *NODES[1:]))
    save(asset, tmp_path / f"a{suffix}")
    again = load(tmp_path / f"a{suffix}")
    check_shapes(again, asset)
    if bad != "not a number":
        np.testing.assert_allclose(world(again)["car"][:3, 3], [1, 2, 3], atol=1e-6)
    if suffix == ".glb":
        json.loads(json.dumps(document(tmp_path / "a.glb"), allow_nan=False))


def test_validators_are_content_with_hierarchies(tmp_path: Path) -> None:
    save(car(), tmp_path / "a.usdz")
    assert usd_messages(tmp_path / "a.usdz") == []
    for options in (FileOptions(), FileOptions(quantize=True)):
        save(car(), tmp_path / "a.glb", options)
        assert khronos_messages(tmp_path / "a.glb") == []


def test_objects_of_obj_files_are_nodes(tmp_path: Path) -> None:
    save(car(), tmp_path / "a.obj")
    again = load(tmp_path / "a.obj")
    assert [n.name for n in again.nodes] == ["car", "door", "handle", "mirror"]
    assert [m.node for m in again.meshes] == [0, 1, 2, 2, 3]
    assert "# copyright: (c) the author" in (tmp_path / "a.obj").read_text()
    one = Asset((part(painted()),), "one")
    save(one, tmp_path / "b.obj")
    assert load(tmp_path / "b.obj").nodes == ()


def test_joints_are_no_parts(tmp_path: Path) -> None:
    save(car(), tmp_path / "a.gltf")
    written = json.loads((tmp_path / "a.gltf").read_text())
    hook = next(k for k, n in enumerate(written["nodes"]) if n["name"] == "hook")
    written["skins"] = [{"joints": [hook]}]
    (tmp_path / "a.gltf").write_text(json.dumps(written))
    assert [n.name for n in load(tmp_path / "a.gltf").nodes] == ["car", "door", "handle", "mirror"]


def test_idle_nodes_go() -> None:
    asset = hierarchy.without_idle_nodes(car(), ())
    assert [n.name for n in asset.nodes] == ["car", "door", "handle", "mirror"]
    assert [m.node for m in asset.meshes] == [0, 1, 2, 2, 3]
    assert [n.parent for n in asset.nodes] == [None, 0, 1, 0]


def test_what_a_gltf_file_loses_is_said(tmp_path: Path) -> None:
    save(car(), tmp_path / "a.gltf")
    written = json.loads((tmp_path / "a.gltf").read_text())
    written["cameras"] = [{"type": "perspective", "name": "front"}, {"type": "perspective"}]
    written["extensionsUsed"] = ["KHR_lights_punctual"]
    written["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point", "name": "sun"}]}}
    attributes = written["meshes"][1]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = attributes["TEXCOORD_0"]
    attributes["_HEAT"] = attributes["TEXCOORD_0"]
    written["materials"][0]["extras"] = {"shader": "toon"}
    written["meshes"][0]["extras"] = {"targetNames": []}
    (tmp_path / "a.gltf").write_text(json.dumps(written))
    notes = load(tmp_path / "a.gltf").notes
    assert notes == (
        "2 cameras dropped ('front', 'camera1')",
        "1 light dropped ('sun')",
        "texture coordinates that no texture reads dropped, of 1 mesh ('door')",
        "attributes of vertices dropped: '_HEAT'",
        "extras of 1 object dropped (meshes, materials, images, scenes)",
    )


def test_what_a_usd_file_loses_is_said(tmp_path: Path) -> None:
    from pxr import Sdf, Usd, UsdGeom, UsdLux

    save(car(), tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    UsdGeom.Camera.Define(stage, "/car/Front")
    UsdLux.SphereLight.Define(stage, "/car/Lamp")
    UsdLux.DistantLight.Define(stage, "/car/Sun")
    mesh = next(p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh))
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st1", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.constant
    ).Set([(0, 0)])
    stage.GetPrimAtPath("/car/door").SetCustomDataByKey("note", "squeaks")
    stage.Save()
    notes = load(tmp_path / "a.usda").notes
    name = mesh.GetName()
    assert notes == (
        "1 camera dropped ('Front')",
        "2 lights dropped ('Lamp', 'Sun')",
        f"texture coordinates that no texture reads dropped, of 1 mesh ('{name}')",
        "custom data of 1 prim dropped ('door')",
    )


def test_meshes_of_blender_and_of_flat_files_are_parts(tmp_path: Path) -> None:
    """A shape that has no place of its own belongs to the only Xform above it; of several beside
    each other, each is a part."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    positions, faces, _ = grid_sphere(4, 6)

    def shape(path: str) -> None:
        mesh = UsdGeom.Mesh.Define(stage, path)
        mesh.CreatePointsAttr(positions.tolist())
        mesh.CreateFaceVertexCountsAttr([3] * len(faces))
        mesh.CreateFaceVertexIndicesAttr(faces.ravel().tolist())

    UsdGeom.Xform.Define(stage, "/root")
    UsdGeom.Xform.Define(stage, "/root/Cube").AddTranslateOp().Set((100, 200, 300))
    shape("/root/Cube/Cube_001")
    for name in ("left", "right"):
        shape(f"/root/{name}")
    stage.Save()
    asset = load(tmp_path / "a.usda")
    assert [asset.nodes[m.node].name for m in asset.meshes] == ["Cube", "left", "right"]
    np.testing.assert_allclose(world(asset)["Cube"], placed((1, 3, -2)), atol=1e-9)


def test_inspect_names_parts_and_owners(tmp_path: Path) -> None:
    save(car(), tmp_path / "a.glb")
    found = inspect(tmp_path / "a.glb")
    assert found.parts == ("car", "door", "handle", "mirror")
    lines = found.lines()
    assert "copyright   (c) the author" in lines
    assert "parts       4: car, door, handle, mirror" in lines
