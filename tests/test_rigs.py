"""Rigs of glTF files: read, posed and written, against an evaluator of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import Asset, FileOptions, load, save
from appearance_opt.asset.influences import repair_influences, sparse
from appearance_opt.asset.notes import Notes
from appearance_opt.asset.posing import bone_matrices, pose, pose_asset, pose_mesh, pose_positions
from appearance_opt.asset.rig import Clip, estimate_rate
from appearance_opt.asset.transforms import compose, decompose, slerp
from appearance_opt.errors import InputError
from appearance_opt.jobs.inspect import inspect
from tests.rigs import Evaluator, GltfBuilder, character, sheet, unit_quaternion

TIMES = (-1.0, 0.0, 0.2, 0.5, 0.6, 0.75, 1.3, 1.999, 2.0, 5.0)


def posed(asset: Asset, clip: str | None, time: float) -> dict[str, np.ndarray]:
    matrices = pose(asset, clip, time)
    return {m.name: pose_positions(m, matrices) for m in asset.meshes}


def largest_difference(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> float:
    """Relative to the height of the first, by the names of meshes."""
    assert a.keys() == b.keys()
    height = max(np.ptp(p, axis=0).max() for p in a.values())
    return max(float(np.abs(a[n] - b[n]).max()) for n in a) / height


def test_poses_are_those_of_the_specification(tmp_path: Path) -> None:
    path = character(tmp_path / "x.glb")
    asset, plain = load(path, keep_rig=True), Evaluator.of(path)
    assert asset.rig is not None
    assert [c.name for c in asset.rig.clips] == ["walk", "spin.1"]
    assert largest_difference(plain.positions(None, 0), posed(asset, None, 0)) < 1e-6
    for clip in ("walk", "spin.1"):
        for time in TIMES:
            assert largest_difference(plain.positions(clip, time), posed(asset, clip, time)) < 1e-6


def test_many_times_at_once_are_each_by_itself(tmp_path: Path) -> None:
    rig = load(character(tmp_path / "x.glb"), keep_rig=True).rig
    for clip in rig.clips:
        together = bone_matrices(rig, clip, TIMES)
        for time, matrices in zip(TIMES, together, strict=True):
            np.testing.assert_array_equal(bone_matrices(rig, clip, [time])[0], matrices)


def test_at_rest_it_is_what_the_static_commands_see(tmp_path: Path) -> None:
    path = character(tmp_path / "x.glb")
    still, moving = load(path), load(path, keep_rig=True)
    assert still.rig is None and all(m.skin is None for m in still.meshes)
    at_rest = pose_asset(moving, None, 0)
    assert [m.name for m in at_rest.meshes] == [m.name for m in still.meshes]
    for a, b in zip(still.meshes, at_rest.meshes, strict=True):
        np.testing.assert_allclose(a.positions, b.positions, atol=2e-5)
        np.testing.assert_allclose(a.normals, b.normals, atol=2e-5)
        np.testing.assert_array_equal(a.faces, b.faces)


def test_what_stands_still_has_no_skin_and_what_hangs_on_a_node_one_bone(tmp_path: Path) -> None:
    asset = load(character(tmp_path / "x.glb"), keep_rig=True)
    skins = {m.name: m.skin for m in asset.meshes}
    assert skins["floor"] is None
    assert skins["prop"].rigid and skins["wheel"].rigid
    assert skins["body"].bones.shape[1] == 4 and skins["coat"].bones.shape[1] == 5
    # both skins are of the same joints: in one bind space they share their bones,
    # and the prop, whose node only says where it lies, hangs on the last joint
    assert len(asset.rig.bone_nodes) == 5 + 1


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".usda", ".usdz"])
def test_what_is_written_and_read_again_plays_the_same(tmp_path: Path, suffix: str) -> None:
    asset = load(character(tmp_path / "x.glb"), keep_rig=True)
    save(asset, tmp_path / f"y{suffix}")
    again = load(tmp_path / f"y{suffix}", keep_rig=True)
    assert [c.name for c in again.rig.clips] == ["walk", "spin.1"]
    by_place = {m.name: m for m in asset.meshes}
    height = np.ptp(asset.bounds(), axis=0).max()
    for clip in ("walk", "spin.1"):
        for time in TIMES:
            a, b = pose(asset, clip, time), pose(again, clip, time)
            for mesh in again.meshes:
                given = by_place[mesh.name.split("_")[-1]]
                p, q = (
                    pose_positions(m, x)[m.faces].mean(axis=1) for m, x in ((given, a), (mesh, b))
                )
                # the writers may order vertices anew, but not faces; animated scales of USD have
                # half precision, and steps take a ten-thousandth of the way
                close = 1e-5 if suffix.startswith(".gl") else 4e-4
                assert np.abs(p - q).max() < close * height, (clip, time, mesh.name)


@pytest.mark.parametrize("compress", ["none", "meshopt"])
def test_quantised_characters_play_the_same(tmp_path: Path, compress: str) -> None:
    if compress == "meshopt":
        pytest.importorskip("meshopt")
    asset = load(character(tmp_path / "x.glb"), keep_rig=True)
    save(asset, tmp_path / "y.glb", FileOptions(quantize=True, compress=compress))
    again = load(tmp_path / "y.glb", keep_rig=True)
    height = np.ptp(asset.bounds(), axis=0).max()
    for mesh in again.meshes:
        given = next(m for m in asset.meshes if m.name == mesh.name)
        p, q = (
            np.sort(pose_positions(m, pose(x, "walk", 0.6))[m.faces].mean(axis=1), axis=0)
            for m, x in ((given, asset), (mesh, again))
        )
        assert np.abs(p - q).max() < 2e-4 * height  # sixteen bits of a box larger than a mesh


def test_names_extras_and_clips_go_out_as_they_came_in(tmp_path: Path) -> None:
    asset = load(character(tmp_path / "x.glb"), keep_rig=True)
    save(asset, tmp_path / "y.glb")
    before, after = (Evaluator.of(tmp_path / f"{n}.glb").json for n in "xy")
    names = {n["name"]: n for n in after["nodes"]}
    for node in before["nodes"]:
        assert names[node["name"]].get("extras") == node.get("extras")
    assert [a.get("extras") for a in after["animations"]] == [None, {"loop": True}]
    for old, new in zip(before["animations"], after["animations"], strict=True):
        assert [s["interpolation"] for s in old["samplers"]] == [
            s["interpolation"] for s in new["samplers"]
        ]
    joints = [[j["nodes"][k]["name"] for k in j["skins"][0]["joints"]] for j in (before, after)]
    assert joints[0] == joints[1]


def test_normals_stay_perpendicular_to_the_posed_surface(tmp_path: Path) -> None:
    """Under one bone with shear the transformed normal of a face is the normal of the transformed
    face."""
    asset = load(character(tmp_path / "x.glb"), keep_rig=True)
    mesh = next(m for m in asset.meshes if m.name == "prop")
    corners = mesh.positions[mesh.faces].astype(np.float64)

    def normals(p: np.ndarray) -> np.ndarray:
        n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        return n / np.linalg.norm(n, axis=1, keepdims=True)

    flat = replace(mesh, normals=np.repeat(normals(corners), 3, axis=0).astype(np.float32))
    moved = pose_mesh(flat, pose(asset, "walk", 1.3))
    expected = normals(moved.positions[moved.faces].astype(np.float64))
    np.testing.assert_allclose(moved.normals[::3], expected, atol=1e-4)


def test_a_second_bone_of_a_node_survives_writing(tmp_path: Path) -> None:
    asset = load(character(tmp_path / "x.glb"), keep_rig=True)
    rig = asset.rig
    twisted = rig.inverse_bind[:1] @ compose(
        [[0.1, 0.2, 0.3]], [unit_quaternion(np.random.default_rng(1))], [[1, 1, 1]]
    )
    rig = replace(
        rig,
        bone_nodes=np.append(rig.bone_nodes, rig.bone_nodes[:1]),
        inverse_bind=np.concatenate([rig.inverse_bind, twisted]),
    )
    body = next(m for m in asset.meshes if m.name == "body")
    bones = np.where(body.skin.bones == 1, len(rig.bone_nodes) - 1, body.skin.bones)
    body = replace(body, skin=replace(body.skin, bones=bones.astype(np.int32)))
    asset = replace(asset, meshes=(body,), rig=rig)
    for suffix in ("glb", "usdc"):
        save(asset, tmp_path / f"y.{suffix}")
        again = load(tmp_path / f"y.{suffix}", keep_rig=True)
        p, q = (
            pose_positions(x.meshes[0], pose(x, "spin.1", 0.7))[x.meshes[0].faces].mean(axis=1)
            for x in (asset, again)
        )
        assert np.abs(p - q).max() < 1e-5 * np.ptp(p, axis=0).max()


def test_weights_are_repaired_and_counted() -> None:
    notes = Notes()
    joints = np.array([[0, 1], [0, 1], [1, 0], [1, 0], [0, 1]])
    weights = np.array([[0.5, 0.5], [-0.2, 1.0], [np.nan, 0.5], [0, 0], [1.0, 1.0]])
    skin = repair_influences(joints, weights, 2, "m", "file", notes)
    np.testing.assert_allclose(skin.weights.sum(axis=1), 1, atol=1e-7)
    assert skin.weights[1].tolist() == [0, 1] and skin.weights[2].tolist() == [0, 1]
    assert skin.bones[3, 0] == 1 and skin.weights[3, 0] == 1
    told = " ".join(notes.lines())
    assert "2 vertices have skinning weights that are negative or no numbers" in told
    assert "1 vertices without skinning weights" in told
    assert "2 vertices have skinning weights whose sum is not 1" in told
    with pytest.raises(InputError, match="1 vertices follow joints that do not exist"):
        repair_influences(np.array([[0, 7]]), np.array([[0.5, 0.5]]), 2, "m", "file", notes)
    unused = repair_influences(np.array([[0, 7]]), np.array([[1.0, 0.0]]), 2, "m", "file", notes)
    assert unused.bones.tolist() == [[0]]


def test_a_joint_named_twice_is_one_influence() -> None:
    joints = np.array([[3, 1, 3, 0], [2, 1, 0, 0]])
    weights = np.array([[0.2, 0.3, 0.5, 0.0], [0.5, 0.25, 0.25, 0.0]])
    skin = repair_influences(joints, weights, 4, "m", "file", Notes())
    assert skin.bones.tolist()[0][:2] == [3, 1] and sorted(skin.bones[1].tolist()) == [0, 1, 2]
    np.testing.assert_allclose(skin.weights, [[0.7, 0.3, 0], [0.5, 0.25, 0.25]], atol=1e-7)


def test_the_largest_weights_are_kept() -> None:
    skin = sparse(np.array([[0.1, 0.6, 0.3], [0.0, 0.0, 1.0]]), 2)
    assert skin.bones.tolist() == [[1, 2], [2, 0]]
    np.testing.assert_allclose(skin.weights, [[2 / 3, 1 / 3], [1, 0]], atol=1e-7)


def test_transforms() -> None:
    rng = np.random.default_rng(3)
    q = np.array([unit_quaternion(rng, a) for a in (0.0, 1.0, np.pi, 3.1, -2.0)])
    scale = np.array([[1, 1, 1], [-2, 1, 0.5], [1, 3, 1], [0.1, 0.1, 0.1], [1, 1, 1]])
    m = compose(rng.normal(size=(5, 3)), q, scale)
    t, r, s, exact = decompose(m)
    assert exact.all()
    np.testing.assert_allclose(compose(t, r, s), m, atol=1e-12)
    sheared = m[1] @ compose([[0, 0, 0]], [q[1]], [[1, 2, 1]])[0]
    assert not decompose(sheared[None])[3][0]
    half = slerp(q[1:2], -q[1:2], np.array([0.5]))
    assert abs(abs(half[0] @ q[1]) - 1) < 1e-12


def rigged(path: Path, **change: object) -> Path:
    """A triangle on two joints, with one clip; ``change``: keys of the JSON, or of its parts."""
    rng = np.random.default_rng(0)
    b = GltfBuilder()
    p, faces = sheet(rng, 2)
    joints = np.zeros((6, 4), np.uint8)
    joints[:, 1] = 1
    joints = np.array(change.get("joints", joints), np.uint8)
    weights = np.array(change.get("weights", [[0.5, 0.5, 0, 0]] * 6), np.float32)
    inverse = np.array(change.get("inverse", [np.eye(4).ravel()] * 2), np.float32)
    times = np.array(change.get("times", [[0.0], [1.0]]), np.float32).reshape(-1, 1)
    values = np.array(change.get("values", [[0, 0, 0], [0, 1, 0]]), np.float32).reshape(-1, 3)
    b.json |= {
        "scenes": [{"nodes": [0, 2]}],
        "nodes": [
            {"name": "root", "children": [1]},
            {"name": "tip"},
            {"name": "m", "mesh": 0, "skin": 0},
        ],
        "skins": [{"joints": [0, 1], "inverseBindMatrices": b.accessor(inverse)}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {
                            "POSITION": b.accessor(p),
                            "JOINTS_0": b.accessor(joints),
                            "WEIGHTS_0": b.accessor(weights),
                        },
                        "indices": b.accessor(faces.reshape(-1, 1).astype(np.uint32)),
                    }
                ]
            }
        ],
    }
    sampler = {
        "input": b.accessor(times),
        "output": b.accessor(values),
        **change.get("sampler", {}),
    }
    channel = {
        "sampler": 0,
        "target": {"node": 1, "path": "translation", **change.get("target", {})},
    }
    b.json["animations"] = [
        {"name": "wave", "samplers": [sampler], "channels": change.get("channels", [channel])}
    ]
    return b.write(path)


NOTHING = np.zeros((2, 16))
BAD = {
    "no keys": ({"times": [], "values": []}, "no keys"),
    "keys out of order": ({"times": [[1.0], [0.0]]}, "out of order"),
    "keys that are no numbers": ({"times": [[0.0], [np.nan]]}, "NaN"),
    "no channels": ({"channels": []}, "no channels"),
    "too few values": ({"values": [[0, 0, 0]]}, "1 values of 3 numbers for 2 keys"),
    "an unknown interpolation": ({"sampler": {"interpolation": "BEZIER"}}, "BEZIER"),
    "a joint that is not there": ({"joints": [[0, 9, 0, 0]] * 6}, "do not exist"),
    "a singular inverse bind matrix": ({"inverse": NOTHING}, "singular"),
    "an inverse bind matrix too few": ({"inverse": np.eye(4).reshape(1, 16)}, "1 inverse bind"),
    "an inverse bind matrix that is no number": ({"inverse": np.full((2, 16), np.nan)}, "singular"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_rigs_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    change, word = BAD[name]
    path = rigged(tmp_path / "x.glb", **change)
    with pytest.raises(InputError, match=word) as caught:
        load(path, keep_rig=True)
    assert "\n" not in str(caught.value) and "structure is broken" not in str(caught.value)


def test_static_commands_do_not_mind_a_broken_animation(tmp_path: Path) -> None:
    path = rigged(tmp_path / "x.glb", times=[[1.0], [0.0]])
    assert load(path).triangle_count == 2
    told = inspect(path)
    assert "out of order" in told.rig.fault
    assert any("cannot be used" in line for line in told.lines())


def test_keys_damaged_at_random_are_read_or_refused(tmp_path: Path) -> None:
    """Every byte pattern gives a rig, or one line."""
    path = rigged(tmp_path / "x.glb")
    data, rng = path.read_bytes(), np.random.default_rng(5)
    refused = 0
    for _ in range(60):
        changed = bytearray(data)
        for place in rng.integers(20, len(data), 3):
            changed[place] = int(rng.integers(0, 256))
        path.write_bytes(bytes(changed))
        try:
            asset = load(path, keep_rig=True)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error)
            continue
        if asset.rig is not None:
            pose(asset, None, 0.0)
    assert 0 < refused < 60


def test_clips_that_do_not_exist_suggest_the_nearest(tmp_path: Path) -> None:
    asset = load(character(tmp_path / "x.glb"), keep_rig=True)
    with pytest.raises(InputError, match="there is no clip 'Wolk'; did you mean 'walk'"):
        asset.rig.clip("Wolk")
    with pytest.raises(InputError, match="has no animation"):
        replace(asset.rig, clips=()).clip("walk")


def test_the_rate_of_frames_follows_the_keys(tmp_path: Path) -> None:
    rig = load(
        rigged(tmp_path / "x.glb", times=np.arange(4)[:, None] / 30.0, values=np.zeros((4, 3))),
        keep_rig=True,
    ).rig
    assert rig.rate == 30
    assert estimate_rate((Clip("none"),)) == 24


def test_morph_targets_are_named(tmp_path: Path) -> None:
    path = rigged(tmp_path / "x.glb")
    document = Evaluator.of(path)
    primitive = document.json["meshes"][0]["primitives"][0]
    primitive["targets"] = [{"POSITION": primitive["attributes"]["POSITION"]}] * 2
    document.json["meshes"][0]["extras"] = {"targetNames": ["smile"]}
    document.json.pop("buffers")
    b = GltfBuilder()
    b.json, b.binary = document.json, document.binary
    asset = load(b.write(tmp_path / "y.glb"), keep_rig=True)
    assert asset.contents.morph_targets == ("smile", "target1")
    assert any("morph targets" in n and "'smile', 'target1'" in n for n in asset.notes)


def test_inspect_tells_of_the_rig(tmp_path: Path) -> None:
    told = inspect(character(tmp_path / "x.glb"))
    out = " ".join(" ".join(told.lines()).split())
    assert "6 joints, at most 5 influences per vertex" in out and "2 rigid meshes" in out
    assert "walk 2 s, 6 keys" in out
    record = told.record()["rig"]["animations"][1]
    assert record == {"name": "spin.1", "seconds": 0.75, "keys": 2}
