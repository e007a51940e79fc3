"""One fit over all parts, each of which stays what it is: name, hierarchy, pivot; and parts that
pass through by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import hierarchy, load, save
from appearance_opt.asset.types import Asset, Credits, Material, Mesh, Node
from appearance_opt.errors import InputError
from appearance_opt.initial.decimate import decimate_with_source
from appearance_opt.jobs.joint import joint
from appearance_opt.jobs.simplify import simplify
from appearance_opt.latent.export import to_asset
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.reference.survey import Triangles
from appearance_opt.stages.parts import split
from appearance_opt.stages.start import Start, inherit_owners
from tests.conftest import grid_sphere

COLORS = {"red": (0.8, 0.1, 0.1), "green": (0.1, 0.7, 0.2), "blue": (0.1, 0.2, 0.9)}


def turned(x: float) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    out[0, 3] = x
    return out


NODES = (
    Node("machine", None, np.eye(4), {"id": 7}),
    Node("base", 0, turned(0.0)),
    Node("arm", 1, turned(1.0)),
    Node("socket", 2, turned(0.5)),
    Node("tip", 0, turned(-2.0)),
)


def machine(sides: tuple[bool, bool, bool] = (True, False, True)) -> Asset:
    """Three balls in a row, of a node each, of which some are seen from their front only."""
    positions, faces, uvs = grid_sphere(8, 12)
    meshes = []
    for k, (name, color) in enumerate(COLORS.items()):
        p = (positions * 0.4 + [k - 1.0, 0, 0]).astype(np.float32)
        material = Material(name, color, 0.6, double_sided=sides[k])
        node = (1, 2, 4)[k]
        meshes.append(Mesh(p, faces, positions, uvs, None, None, material, NODES[node].name, node))
    return Asset(tuple(meshes), "toy", nodes=NODES, credits=Credits("(c) the author"))


def middle(mesh: Mesh) -> float:
    """Of its extent along x."""
    x = mesh.positions[mesh.faces.ravel(), 0]
    return float(x.min() + x.max()) / 2


def run(asset: Asset, out: Path | None, **values: object):
    given = {"triangles": 240, "steps": 1, "texture_size": 64, "resolution": 32, "reallocate": 0}
    return simplify(asset, out, **{**given, **values})


def test_parts_stay_parts(tmp_path: Path) -> None:
    result = run(machine(), tmp_path / "a.glb")
    again = load(tmp_path / "a.glb")
    for asset in (result.asset, again):
        parts = {asset.nodes[m.node].name: m for m in asset.meshes}
        assert list(parts) == ["base", "arm", "tip"] and len(asset.meshes) == 3
        for x, mesh in zip((-1.0, 0.0, 1.0), parts.values(), strict=True):
            assert abs(middle(mesh) - x) < 0.05 and len(mesh.faces) > 40
        assert [m.material.double_sided for m in asset.meshes] == [True, False, True]
        assert asset.credits.copyright == "(c) the author"
    assert sum(len(m.faces) for m in result.asset.meshes) == result.triangles <= 240
    # one atlas, one set of textures
    textures = {id(m.material.base_color_texture) for m in result.asset.meshes}
    assert len(textures) == 1
    assert [n.name for n in again.nodes] == [n.name for n in NODES]
    for found, truth in zip(again.nodes, NODES, strict=True):
        np.testing.assert_allclose(found.matrix, truth.matrix, atol=1e-7)
    assert again.nodes[0].extras == {"id": 7}


def test_parts_are_one_where_that_is_asked_for() -> None:
    asset = run(machine((True,) * 3), None, parts="merge").asset
    assert len(asset.meshes) == 1 and asset.nodes == () and asset.meshes[0].node is None


def test_levels_and_the_start_are_made_of_the_same_parts() -> None:
    result = run(machine(), None, displacement=True, subdivision=1, write_tessellated=True)
    for asset in (result.start, result.asset, *result.tessellated.values()):
        assert [asset.nodes[m.node].name for m in asset.meshes] == ["base", "arm", "tip"]


def test_triangles_that_stem_from_none_take_the_part_of_what_they_face() -> None:
    """Of two shells, one within the other, each triangle takes the one that faces its way."""
    positions, faces, _ = grid_sphere(12, 16)
    heavy = Triangles(
        np.concatenate([positions, positions * 0.97]).astype(np.float32),
        np.concatenate([faces, faces[:, ::-1] + len(positions)]).astype(np.int32),
        np.zeros(2 * len(faces), bool),
        None,  # type: ignore[arg-type]
        np.repeat(np.array([3, 8], np.int32), len(faces)),
    )
    p, f, uvs = grid_sphere(6, 8)
    both = np.concatenate([f, f[:, ::-1]]).astype(np.int32)
    corners = np.arange(len(p), dtype=np.int32)
    mesh = LatentMesh((0.985 * p).astype(np.float32), both, corners, both, uvs)
    start = inherit_owners(Start(mesh, {}, True, np.zeros((4, 4), bool)), heavy)
    np.testing.assert_array_equal(start.mesh.owner, np.repeat([3, 8], len(f)))


def test_edges_between_parts_are_not_flipped() -> None:
    """The long diagonal of a flat kite goes, unless a part ends there."""
    kite = np.array([[0, 0, 0], [4, 0, 0], [2, 0.3, 0], [2, -0.3, 0]], float)
    faces = np.array([[0, 1, 2], [1, 0, 3]])

    def long_edges(owner: np.ndarray | None) -> int:
        p, f, _ = decimate_with_source(kite, faces, 2, owner=owner)
        return int((np.linalg.norm(p[f] - p[np.roll(f, 1, axis=1)], axis=2) > 3.9).sum())

    assert long_edges(None) == 0 and long_edges(np.array([5, 5])) == 0
    assert long_edges(np.array([5, 6])) == 2


def test_an_export_without_owners_is_one_mesh() -> None:
    p, f, uvs = grid_sphere(6, 8)
    mesh = LatentMesh(p, f, np.arange(len(p), dtype=np.int32), f, uvs)
    assert [m.node for m in to_asset(mesh, p, {"red": 0.5}, "a").meshes] == [None]
    owned = replace(mesh, owner=np.full(len(f), 4, np.int32))
    (one,) = to_asset(owned, p, {"red": 0.5}, "a").meshes
    assert one.node == 4 and len(one.faces) == len(f)
    mixed = replace(mesh, owner=np.where(np.arange(len(f)) % 2, 4, -1).astype(np.int32))
    first, second = to_asset(mixed, p, {"red": 0.5}, "a").meshes
    assert (first.node, second.node) == (None, 4)
    assert len(first.faces) + len(second.faces) == len(f)
    assert first.material is second.material


@pytest.mark.parametrize(
    ("named", "kept"),
    [
        (("base",), {"base", "arm"}),  # with what is below it
        (("arm",), {"arm"}),
        (("blue",), {"tip"}),  # a material
        (("a*", "gre?n"), {"arm"}),
    ],
)
def test_what_is_named_passes_through(named: tuple[str, ...], kept: set[str]) -> None:
    parts = split(machine(), "toy", "simplify", named=named)
    assert {m.name for m in parts.kept} == kept
    assert {m.name for m in parts.fitted.meshes} == {"base", "arm", "tip"} - kept
    (note,) = parts.describe_kept("stay")
    assert note.startswith(f"named parts stay: {len(kept)} (")


def test_names_that_nothing_bears_are_told_with_the_nearest() -> None:
    with pytest.raises(InputError, match=r"--keep tipp: no node .* did you mean 'tip'\?"):
        split(machine(), "toy", "simplify", named=("tipp",))
    with pytest.raises(InputError, match="keeps all of toy: nothing is left to simplify"):
        split(machine(), "toy", "simplify", named=("machine",))


def test_named_parts_are_in_the_result_as_they_were(tmp_path: Path) -> None:
    given = machine()
    result = run(given, tmp_path / "a.glb", keep=("arm",), parts="merge", triangles=120)
    assert result.kept_triangles == len(given.meshes[1].faces) and result.triangles <= 120
    arm = result.asset.meshes[-1]
    np.testing.assert_array_equal(arm.positions, given.meshes[1].positions)
    assert arm.material is given.meshes[1].material
    assert any(n.startswith("named parts pass into the result") for n in result.notes)
    again = load(tmp_path / "a.glb")
    assert again.meshes[-1].name == "arm" or "arm" in {m.name for m in again.meshes}
    assert again.triangle_count == result.triangles + result.kept_triangles


def test_parts_of_which_nothing_is_left_are_told() -> None:
    positions, faces, uvs = grid_sphere(8, 12)
    speck = Mesh(
        (positions * 1e-3 + [0, 3, 0]).astype(np.float32),
        faces,
        positions,
        uvs,
        material=Material("speck"),
        name="speck",
        node=3,
    )
    asset = replace(machine(), meshes=(*machine().meshes, speck))
    result = run(asset, None, triangles=60)
    names = {result.asset.nodes[m.node].name for m in result.asset.meshes}
    told = "nothing is left of 1 part at this budget ('socket')" in result.notes
    assert told == ("socket" not in names)
    assert told


def test_joint_keeps_the_parts_of_low(tmp_path: Path) -> None:
    asset = machine()
    save(asset, tmp_path / "low.glb")
    values = {"steps": 1, "texture_size": 64, "resolution": 32, "unwrap": True, "subdivision": 1}
    result = joint(asset, tmp_path / "low.glb", None, **values)  # type: ignore[arg-type]
    found = {result.asset.nodes[m.node].name for m in result.asset.meshes}
    assert found == {"base", "arm", "tip"}
    _, before = hierarchy.place_nodes(NODES)
    _, after = hierarchy.place_nodes(result.asset.nodes)
    np.testing.assert_allclose(after, before, atol=1e-6)
