"""Map coordinates: what lies far away for its size keeps its shape, and its place."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt import bake, bake_options, compare, simplify, simplify_options
from appearance_opt.asset import load, save
from appearance_opt.asset.normals import weld
from appearance_opt.asset.origin import settle
from appearance_opt.asset.types import Asset, Mesh
from appearance_opt.baking.align import align
from appearance_opt.baking.check import check_place, misfit
from appearance_opt.errors import InputError
from appearance_opt.placement import Placement
from tests.conftest import grid_sphere, make_asset
from tests.test_asset_gltf import write_glb
from tests.test_asset_gltf_nodes import document

PLACE = np.array([4_000_000.125, 1_200_000.25, -3_000_000.5])
MICROMETRE = 1e-6


def small() -> tuple[np.ndarray, np.ndarray]:
    """A sphere of half a metre."""
    positions, faces, _ = grid_sphere(8, 16, 0.25)
    return positions, faces


def corners(asset: Asset) -> np.ndarray:
    """(N, 3) corners of all triangles in the world, in double precision, in the order of the
    faces."""
    meshes = asset.meshes
    return (
        np.concatenate([m.positions.astype(np.float64)[m.faces].reshape(-1, 3) for m in meshes])
        + asset.origin
    )


def write(folder: Path, kind: str, place: np.ndarray = PLACE) -> Path:
    """The sphere at ``place``, in a format that keeps double precision."""
    positions, faces = small()
    world = positions.astype(np.float64) + place
    path = folder / f"x.{kind}"
    rows = [f"{x:.9f} {y:.9f} {z:.9f}" for x, y, z in world.tolist()]
    if kind == "glb":
        given, binary = document({"POSITION": positions, "NORMAL": positions * 4}, faces)
        given["nodes"] = [
            {"children": [1], "translation": (place - 7).tolist()},
            {"mesh": 0, "translation": [7, 7, 7]},
        ]
        write_glb(path, given, binary)
    elif kind == "obj":
        used = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces.tolist()]
        path.write_text("\n".join([*(f"v {r}" for r in rows), *used]) + "\n")
    elif kind == "stl":
        lines = ["solid x"]
        for face in faces.tolist():
            lines += [
                "facet normal 0 0 0",
                "outer loop",
                *(f"vertex {rows[i]}" for i in face),
                "endloop",
                "endfacet",
            ]
        path.write_text("\n".join([*lines, "endsolid x"]) + "\n")
    elif kind == "usda":
        points = ", ".join(f"({x!r}, {y!r}, {z!r})" for x, y, z in positions.tolist())
        x, y, z = (100 * place).tolist()
        path.write_text(
            '#usda 1.0\n(upAxis = "Y"\nmetersPerUnit = 0.01)\n'
            f'def Xform "top"\n{{\ndouble3 xformOp:translate = ({x!r}, {y!r}, {z!r})\n'
            "double3 xformOp:scale = (100, 100, 100)\n"
            'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]\n'
            f'def Mesh "m"\n{{\nint[] faceVertexCounts = {[3] * len(faces)}\n'
            f"int[] faceVertexIndices = {faces.ravel().tolist()}\npoint3f[] points = [{points}]\n"
            'uniform token subdivisionScheme = "none"\n}\n}\n'
        )
    else:
        head = f"ply\nformat {{}} 1.0\nelement vertex {len(world)}\n"
        head += "".join(f"property double {axis}\n" for axis in "xyz")
        head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        path = folder / "x.ply"
        if kind == "ascii ply":
            body = "\n".join([*rows, *(f"3 {a} {b} {c}" for a, b, c in faces.tolist())])
            path.write_text(head.format("ascii") + body + "\n")
        else:
            body = b"".join(struct.pack("<B3i", 3, *face) for face in faces.tolist())
            path.write_bytes(
                head.format("binary_little_endian").encode() + world.astype("<f8").tobytes() + body
            )
    return path


@pytest.mark.parametrize("kind", ["glb", "obj", "stl", "usda", "ascii ply", "binary ply"])
def test_detail_at_map_coordinates_is_kept(tmp_path: Path, kind: str) -> None:
    asset = load(write(tmp_path, kind))
    positions, faces = small()
    assert any(asset.origin)
    assert max(np.abs(m.positions).max() for m in asset.meshes) < 1
    # text has nine decimals; a double has steps of 0.5 nm here, a hundredth of which counts in
    # centimetres
    np.testing.assert_allclose(
        corners(asset), positions[faces].reshape(-1, 3) + PLACE, atol=0.01 * MICROMETRE
    )
    assert not any("degenerate" in note for note in asset.notes)
    assert any("far from the origin" in note for note in asset.notes)
    for part in asset.origin:
        assert part == np.float32(part)  # so that a node kept in single precision is at its place


@pytest.mark.parametrize("kind", ["glb", "obj", "stl", "usda", "ascii ply", "binary ply"])
def test_what_lies_near_is_kept_bit_by_bit(tmp_path: Path, kind: str) -> None:
    """As it always was: world positions rounded to single precision."""
    place = np.array([3.0, -2.0, 5.0])
    asset = load(write(tmp_path, kind, place))
    positions, faces = small()
    assert asset.origin == (0, 0, 0)
    world = positions[faces].reshape(-1, 3) + place
    if kind != "usda":  # whose centimetres are multiplied
        np.testing.assert_array_equal(corners(asset), np.round(world, 9).astype(np.float32))
    assert not any("origin" in note for note in asset.notes)


def test_only_what_faces_use_says_how_far_away_it_is() -> None:
    positions, faces = small()
    stray = np.concatenate([positions + PLACE, np.zeros((1, 3)), np.full((1, 3), np.nan)])
    notes: list[str] = []
    meshes, origin = settle([Mesh(stray, faces), Mesh(stray[:0], faces[:0])], notes.append)  # type: ignore[arg-type]
    np.testing.assert_allclose(origin, PLACE, atol=0.25)
    assert meshes[0].positions.dtype == np.float32
    for rows, used in (
        (np.zeros((3, 3)), faces[:1]),
        (np.full((3, 3), np.inf), faces[:1]),
        (stray[:0], faces),
    ):
        assert settle([Mesh(rows, used)], notes.append)[1] == (0, 0, 0)  # type: ignore[arg-type]


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".usda", ".usdz", ".obj"])
def test_the_place_is_written(tmp_path: Path, suffix: str) -> None:
    asset = load(write(tmp_path, "glb"))
    save(replace(asset, nodes=()), tmp_path / f"again{suffix}")
    again = load(tmp_path / f"again{suffix}")
    # OBJ has the nine digits that single precision needs, as for what lies near
    np.testing.assert_allclose(corners(again), corners(asset), atol=0.01 * MICROMETRE)
    assert again.origin == asset.origin
    if suffix == ".gltf":
        nodes = json.loads((tmp_path / "again.gltf").read_text())["nodes"]
        assert nodes[-1]["translation"] == list(asset.origin)


def test_the_placement_of_a_job_does_not_know_the_origin() -> None:
    ball = make_asset(8, 16)
    far = replace(ball, origin=tuple(PLACE))
    near, moved = Placement().local(ball), Placement(tuple(PLACE)).local(far)
    np.testing.assert_array_equal(moved.meshes[0].positions, near.meshes[0].positions)
    assert moved.origin == (0, 0, 0)


def apart(ball: Asset, origin: np.ndarray) -> Asset:
    """An asset at the same place in the world, relative to another origin."""
    shift = (np.array(ball.origin) - origin).astype(np.float32)
    meshes = tuple(replace(m, positions=m.positions + shift) for m in ball.meshes)
    return replace(ball, meshes=meshes, origin=tuple(origin.tolist()))


def test_assets_of_different_origins_are_compared_where_they_are() -> None:
    first = replace(make_asset(12, 24), origin=tuple(PLACE))
    second = apart(first, PLACE + (2, -1, 0.5))
    assert misfit(first, second)[0] < MICROMETRE
    check_place(first, second)
    with pytest.raises(InputError, match="do not lie in one place"):
        check_place(first, replace(first, origin=(0, 0, 0)))
    same = compare(first, second, views=2, resolution=48, samples=4)
    assert same.metrics.psnr_covered > 50
    assert same.metrics.silhouette_iou > 0.999
    assert not any("apart" in note for note in same.notes)
    moved = compare(first, apart(first, PLACE), views=1, resolution=16, samples=1).notes
    assert not any("apart" in note for note in moved)
    elsewhere = replace(first, origin=tuple((PLACE - (30, 0, 0)).tolist()))
    assert any(
        "30 m apart" in note for note in compare(first, elsewhere, views=2, resolution=64).notes
    )
    with pytest.raises(InputError, match=r"m apart, .* move one of them"):
        compare(first, replace(first, origin=(0, 0, 0)), views=1, resolution=16)


def test_aligned_to_another_origin() -> None:
    still = replace(make_asset(16, 32), origin=tuple(PLACE))
    moving = replace(make_asset(16, 32), origin=(0.5, 0.0, 0.0))
    placed, scale, shift = align(moving, still)
    assert placed.origin == still.origin
    np.testing.assert_allclose(scale, 1, atol=1e-4)
    np.testing.assert_allclose(placed.meshes[0].positions, still.meshes[0].positions, atol=2e-3)
    # the translation is that of world coordinates
    world = (moving.points() * scale + shift) - PLACE
    np.testing.assert_allclose(world, placed.meshes[0].positions, atol=1e-6)


def test_a_result_lies_where_the_input_does(tmp_path: Path) -> None:
    """A start, and one from a file of another origin, equal those near the origin."""
    near = make_asset(12, 24)
    # no two edges cost the same: rounding must not decide between them
    bumps = 1 + 0.05 * np.random.default_rng(0).random((len(near.meshes[0].positions), 1))
    first, place = weld(near.meshes[0].positions)
    bumpy = (near.meshes[0].positions * bumps[first][place] * (1, 1.3, 0.8)).astype(np.float32)
    near = replace(near, meshes=(replace(near.meshes[0], positions=bumpy),))
    far = replace(near, origin=tuple(PLACE))
    given = {
        "steps": 0,
        "texture_size": 32,
        "resolution": 32,
        "pool": 4,
        "reallocate": 0,
        "views": 2,
    }
    results = [
        simplify(a, None, simplify_options("draft", triangles=60, **given)) for a in (near, far)
    ]
    a, b = (r.asset for r in results)
    assert b.origin == far.origin
    np.testing.assert_allclose(b.meshes[0].positions, a.meshes[0].positions, atol=1e-5)
    save(apart(b, PLACE + (4, 0, 0)), tmp_path / "low.glb")
    again = simplify(
        far,
        tmp_path / "again.glb",
        simplify_options("draft", init=str(tmp_path / "low.glb"), **given),
    )
    assert again.asset.origin == far.origin
    low, high = load(tmp_path / "again.glb").bounds()
    np.testing.assert_allclose((low + high) / 2, PLACE, atol=0.1)


def test_a_bake_between_two_origins_is_that_of_one() -> None:
    high = make_asset(16, 32)
    low = make_asset(8, 16)
    maps = []
    for place, other in ((np.zeros(3), np.zeros(3)), (PLACE, PLACE + (1, 2, -1))):
        at = [replace(a, origin=tuple(place.tolist())) for a in (high, low)]
        given = bake_options("draft", closed_form=True, texture_size=32, samples=1, cage=0.1)
        result = bake(at[0], apart(at[1], other), None, given)
        assert result.asset.origin == tuple(other.tolist())
        np.testing.assert_allclose(np.mean(result.asset.bounds(), axis=0), place, atol=0.05)
        maps.append(result.maps)
    for name in ("normal_x", "red", "roughness"):
        # rays near an edge may meet either of its faces
        assert np.quantile(np.abs(maps[1][name] - maps[0][name]), 0.98) < 0.02
