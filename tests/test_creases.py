"""Normals of files without: hard edges, smoothing groups, noise; what else PLY and STL files
hold."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from appearance_opt import bake_options, compare, simplify_options
from appearance_opt.asset import load
from appearance_opt.asset.creases import add_normals, smooth_by_angle, split
from appearance_opt.asset.edges import Edges
from appearance_opt.asset.normals import unit, vertex_normals
from appearance_opt.asset.types import Asset, Mesh, srgb_to_linear
from appearance_opt.baking.target_mesh import movable, unwrap_asset
from appearance_opt.errors import InputError
from appearance_opt.initial.decimate import decimate
from appearance_opt.jobs.lifecycle import load_source
from appearance_opt.latent.mesh import LatentMesh


def soup(faces: np.ndarray, attribute: np.ndarray | None = None, header: bytes = b"") -> bytes:
    """A binary STL file of (F, 3, 3) corners."""
    rows = np.zeros(
        len(faces),
        np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]),
    )
    rows["corners"] = faces
    rows["attribute"] = 0 if attribute is None else attribute
    return header.ljust(80, b"\0") + struct.pack("<I", len(faces)) + rows.tobytes()


def written(folder: Path, kind: str, vertices: np.ndarray, faces: np.ndarray) -> Path:
    """A file of triangles that says nothing of normals."""
    path = folder / f"x.{kind}"
    if kind == "stl":
        path.write_bytes(soup(vertices[faces]))
        return path
    rows = [" ".join(f"{x:.9g}" for x in row) for row in vertices.tolist()]
    if kind == "obj":
        corners = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces.tolist()]
        path.write_text("\n".join([*(f"v {r}" for r in rows), *corners]) + "\n")
        return path
    head = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(rows)}",
        *(f"property float {a}" for a in "xyz"),
    ]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    path.write_text(
        "\n".join([*head, *rows, *(f"3 {a} {b} {c}" for a, b, c in faces.tolist())]) + "\n"
    )
    return path


def face_normals(mesh: Mesh) -> np.ndarray:
    p = mesh.positions.astype(np.float64)[mesh.faces]
    return unit(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]))


KINDS = ["stl", "ply", "obj"]


@pytest.mark.parametrize("kind", KINDS)
def test_the_edges_of_a_cube_are_hard(tmp_path: Path, kind: str) -> None:
    box = trimesh.creation.box()
    mesh = load(written(tmp_path, kind, box.vertices, box.faces)).meshes[0]
    assert len(mesh.positions) == 24
    np.testing.assert_allclose(
        mesh.normals[mesh.faces], np.repeat(face_normals(mesh)[:, None], 3, 1), atol=1e-6
    )


@pytest.mark.parametrize("kind", KINDS)
def test_a_cylinder_is_round_and_its_rims_are_hard(tmp_path: Path, kind: str) -> None:
    rod = trimesh.creation.cylinder(1, 3, sections=12)
    mesh = load(written(tmp_path, kind, rod.vertices, rod.faces)).meshes[0]
    side = np.abs(face_normals(mesh)[:, 2]) < 0.5
    np.testing.assert_allclose(mesh.normals[mesh.faces[~side]][..., :2], 0, atol=1e-6)
    corner = mesh.faces[side].ravel()
    radial = mesh.positions[corner] * (1, 1, 0)
    # the fans on both sides of a vertex weigh by their angles, which differ: 30 degrees lie between
    # facets
    assert (np.sum(mesh.normals[corner] * radial, axis=1) > np.cos(np.radians(10))).all()
    np.testing.assert_allclose(mesh.normals[corner][:, 2], 0, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_round_shape_stays_as_it_was(tmp_path: Path, kind: str) -> None:
    ball = trimesh.creation.icosphere(3)
    mesh = load(written(tmp_path, kind, ball.vertices, ball.faces)).meshes[0]
    assert len(mesh.positions) == len(ball.vertices)
    np.testing.assert_allclose(mesh.normals, vertex_normals(mesh.positions, mesh.faces), atol=1e-6)


@pytest.mark.parametrize("deviation", [0.1, 0.2, 0.3])
def test_a_noisy_scan_stays_smooth(deviation: float) -> None:
    """Up to 40 % of its edges are sharper than the angle: without the rule for noise, there would
    be
    2.6 times the vertices in the last case."""
    ball = trimesh.creation.icosphere(4)
    noise = np.random.default_rng(0).normal(size=ball.vertices.shape)
    positions = ball.vertices + deviation * ball.edges_unique_length.mean() * noise
    (mesh,) = add_normals([Mesh(positions.astype(np.float32), ball.faces.astype(np.int32))])
    assert len(mesh.positions) <= 1.05 * len(ball.vertices)


def test_the_edges_of_a_noisy_cube_are_hard() -> None:
    """A scan of something with edges: nearly all corners at them have a normal of their own."""
    box = trimesh.creation.box()
    for _ in range(4):
        box = box.subdivide()
    noise = np.random.default_rng(0).normal(size=box.vertices.shape)
    positions = (box.vertices + 0.05 * box.edges_unique_length.mean() * noise).astype(np.float32)
    (mesh,) = add_normals([Mesh(positions, box.faces.astype(np.int32))])
    original = box.vertices[box.faces]
    cross = unit(np.cross(original[:, 1] - original[:, 0], original[:, 2] - original[:, 0]))
    agree = np.einsum("fkc,fc->fk", mesh.normals[mesh.faces], cross)
    at_edge = (np.abs(np.abs(original) - 0.5) < 1e-6).sum(axis=2) > 1
    assert (agree[at_edge] > np.cos(np.radians(25))).mean() > 0.98


def test_engraved_letters_are_hard() -> None:
    """Convex and concave edges side by side are no noise: steps as high as they are wide."""
    outline = [(x, z) for k in range(6) for x, z in ((k, k), (k, k + 1))]
    p = np.array([(x, y, z) for y in (0, 1) for x, z in outline], np.float32)
    n = len(outline)
    quads = [(k, k + 1, k + 1 + n, k + n) for k in range(n - 1)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    (mesh,) = add_normals([Mesh(p, faces.astype(np.int32))])
    np.testing.assert_allclose(
        mesh.normals[mesh.faces], np.repeat(face_normals(mesh)[:, None], 3, 1), atol=1e-6
    )


def folded(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Three squares in a row, each turned by ``angle`` degrees against the one before."""
    turn = np.radians([0, angle, 2 * angle])
    x = np.concatenate([[0], np.cumsum(np.cos(turn))])
    z = np.concatenate([[0], np.cumsum(np.sin(turn))])
    rows = [[(a, y, b) for a, b in zip(x, z, strict=True)] for y in (0.0, 1.0)]
    return np.array(rows).reshape(-1, 3), np.array([(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6)])


GROUPS = [
    ("s 1|s 1|s 1", [True, True]),
    ("s 1|s 1|s 2", [True, False]),
    ("s off|s off|s off", [False, False]),
    ("s 0||", [False, False]),
    ("|s 1|s 1", [False, True]),  # of none before the first statement
    ("s 7|s off|s 7", [False, False]),
    ("s left|s left|s OFF", [True, False]),
    ("||", [True, False]),  # nothing is said: the angles, 30 and 80 degrees
]


@pytest.mark.parametrize(("statements", "joined"), GROUPS)
def test_smoothing_groups_of_obj_files(tmp_path: Path, statements: str, joined: list[bool]) -> None:
    points, quads = folded(30.0)
    if statements == "||":
        points[[3, 7]] = points[[2, 6]] + (np.cos(np.radians(110)), 0, np.sin(np.radians(110)))
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points.tolist()]
    for k, (said, quad) in enumerate(zip(statements.split("|"), quads.tolist(), strict=True)):
        lines += [said, f"usemtl m{k}", "f " + " ".join(str(i + 1) for i in quad)]
    (tmp_path / "x.obj").write_text("\n".join(lines) + "\n")
    meshes = load(tmp_path / "x.obj").meshes
    assert [m.material.name for m in meshes] == ["m0", "m1", "m2"]
    own = [face_normals(m)[0] for m in meshes]
    for k, smooth in enumerate(joined):
        shared = points[k + 1]
        at = [
            m.normals[np.linalg.norm(m.positions - shared, axis=1) < 1e-6][0]
            for m in meshes[k : k + 2]
        ]
        if smooth:  # the squares weigh alike
            np.testing.assert_allclose(at, [unit(own[k] + own[k + 1])] * 2, atol=1e-6)
        else:
            for got, normal, other in zip(at, own[k : k + 2], own[k : k + 2][::-1], strict=True):
                assert np.dot(got, normal) > np.dot(got, other) + 0.1


def test_normals_of_an_obj_file_stay(tmp_path: Path) -> None:
    (tmp_path / "x.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 1 0 0\ns off\nf 1//1 2//1 3//1\n"
    )
    np.testing.assert_array_equal(load(tmp_path / "x.obj").meshes[0].normals, [[1, 0, 0]] * 3)


@pytest.mark.parametrize("kind", KINDS)
def test_the_angle_may_be_given(tmp_path: Path, kind: str) -> None:
    rod = trimesh.creation.cylinder(1, 3, sections=12)
    path = written(tmp_path, kind, rod.vertices, rod.faces)
    counts = [len(load(path, crease_angle=a).meshes[0].positions) for a in (180, 80, 35, 25)]
    # two centres; rims that are whole, or split into side and caps; and a pair of vertices for each
    # facet
    assert counts == [2 + 24, 2 + 48, 2 + 48, 2 + 24 + 48]
    flat = load(path, crease_angle=0).meshes[0]
    np.testing.assert_allclose(
        flat.normals[flat.faces], np.repeat(face_normals(flat)[:, None], 3, 1), atol=1e-6
    )
    for wrong in (-1, 181, float("nan")):
        with pytest.raises(InputError, match=r"--crease-angle .* from 0 to 180"):
            load(path, crease_angle=wrong)
        with pytest.raises(InputError, match="crease-angle"):
            simplify_options(ratio=0.5, crease_angle=wrong)


def test_the_angle_reaches_the_reader(tmp_path: Path) -> None:
    rod = trimesh.creation.cylinder(1, 3, sections=12)
    path = written(tmp_path, "stl", rod.vertices, rod.faces)
    for options in (simplify_options(ratio=0.5, crease_angle=180), bake_options(crease_angle=180)):
        assert len(load_source(path, options).meshes[0].positions) == 26
    flat = load(path, crease_angle=180)
    assert compare(path, flat, views=1, resolution=32, samples=4).metrics.psnr_covered < 50
    assert (
        compare(
            path, flat, views=1, resolution=32, samples=4, crease_angle=180
        ).metrics.psnr_covered
        == 99
    )


@pytest.mark.parametrize("kind", KINDS)
def test_a_mesh_to_be_baked_onto_keeps_its_vertices(tmp_path: Path, kind: str) -> None:
    box = trimesh.creation.box()
    mesh = load(written(tmp_path, kind, box.vertices, box.faces), keep_layout=True).meshes[0]
    assert mesh.normals is None
    assert len(mesh.positions) == 8


def test_hard_edges_do_not_tear_a_mesh() -> None:
    """Decimation, and a fit of the shape, join what lies at one place."""
    box = trimesh.creation.box()
    for _ in range(3):
        box = box.subdivide()
    whole = Mesh(box.vertices.astype(np.float32), box.faces.astype(np.int32))
    (mesh,) = add_normals([whole])
    assert len(mesh.positions) > len(whole.positions)
    positions, faces = decimate(mesh.positions, mesh.faces, 12)
    assert len(faces) == 12
    again = trimesh.Trimesh(positions, faces, process=False)
    assert again.is_watertight
    np.testing.assert_allclose(again.volume, 1, rtol=0.1)
    laid = unwrap_asset(Asset((mesh,), "x"), 64).meshes[0]
    corners = np.arange(len(laid.positions), dtype=np.int32)
    latent = LatentMesh(
        laid.positions, laid.faces, corners, laid.faces, laid.uvs, laid.normals, None
    )
    assert len(movable(latent).positions) == len(whole.positions)


def test_one_hard_edge_that_ends_within_a_surface_splits_nothing() -> None:
    ball = trimesh.creation.icosphere(2)
    p, f = ball.vertices, ball.faces.astype(np.int32)
    edges = Edges.of(p, f)
    assert len(edges.ends) == 3 * len(f) / 2  # closed
    smooth = np.ones(len(edges.ends), bool)
    smooth[40] = False
    index, new, _ = split(p, f, np.arange(len(p)), edges, smooth)
    np.testing.assert_array_equal(index[new], f)
    assert smooth_by_angle(p, f, edges).all()


def test_edges_join_only_faces_that_run_along_them_in_opposite_directions() -> None:
    """Three faces at one edge, of which two look alike, and one that is turned over."""
    p = np.array([(0, 0, 0), (0, 1, 0), (1, 0, 0), (-1, 0, 0), (0, 0, 1)], np.float32)
    faces = np.array([(0, 2, 1), (0, 1, 3), (0, 1, 4)])
    edges = Edges.of(p, faces)
    assert len(edges.ends) == 1
    assert sorted(edges.faces[0]) == [0, 1]
    for corner, end in zip(edges.corners[0], edges.ends[0], strict=True):
        assert faces.ravel()[corner].tolist() == [end, end]
    assert not len(Edges.of(p, np.array([(0, 1, 2), (0, 1, 3)])).ends)
    (mesh,) = add_normals([Mesh(p, faces.astype(np.int32))])
    assert np.isfinite(mesh.normals).all()
    # a face without area divides its neighbours from itself alone
    flat = np.array([(0, 0, 0), (2, 0, 0), (1, 0, 0), (1, 1, 0), (1, -1, 0)], np.float32)
    (mesh,) = add_normals(
        [Mesh(flat, np.array([(0, 2, 3), (2, 1, 3), (0, 1, 2), (0, 4, 1)], np.int32))]
    )
    np.testing.assert_allclose(
        mesh.normals[mesh.faces[[0, 1, 3]]], np.tile((0, 0, 1), (3, 3, 1)), atol=1e-6
    )


@pytest.mark.parametrize("statement", ["s 1\n", ""])
def test_the_sides_of_a_sheet_are_smooth_each(tmp_path: Path, statement: str) -> None:
    """Many OBJ files have each face twice, once for each side, over the same vertices."""
    angle = np.radians(np.arange(0, 181, 15))
    points = np.array([(np.sin(a), y, np.cos(a)) for y in (0.0, 1.0, 2.0) for a in angle])
    n = len(angle)
    quads = [(k + r, k + 1 + r, k + 1 + r + n, k + r + n) for r in (0, n) for k in range(n - 1)]
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points.tolist()] + [statement]
    lines += ["f " + " ".join(str(i + 1) for i in q[::way]) for q in quads for way in (1, -1)]
    (tmp_path / "x.obj").write_text("\n".join(lines) + "\n")
    mesh = load(tmp_path / "x.obj").meshes[0]
    assert len(mesh.positions) == 2 * len(points)
    radial = unit(mesh.positions.astype(np.float64) * (1, 0, 1))
    inner = np.abs(mesh.positions[:, 2]) < np.cos(
        np.radians(10)
    )  # at both ends there is half a fan only
    assert (np.abs(np.sum(mesh.normals * radial, axis=1))[inner] > np.cos(np.radians(1))).all()
    own = face_normals(mesh)
    assert (np.einsum("fkc,fc->fk", mesh.normals[mesh.faces], own) > np.cos(np.radians(10))).all()


def test_other_attributes_go_with_the_vertices() -> None:
    box = trimesh.creation.box()
    uvs = np.random.default_rng(0).random((8, 2)).astype(np.float32)
    (mesh,) = add_normals(
        [
            Mesh(
                box.vertices.astype(np.float32),
                box.faces.astype(np.int32),
                uvs=uvs,
                colors=uvs[:, [0] * 3],
            )
        ]
    )
    np.testing.assert_array_equal(mesh.uvs[mesh.faces], uvs[box.faces])
    np.testing.assert_array_equal(
        mesh.positions[mesh.faces], box.vertices[box.faces].astype(np.float32)
    )
    assert add_normals([mesh])[0] is mesh
    broken = Mesh(mesh.positions, mesh.faces + 99)
    assert add_normals([broken])[0] is broken


@pytest.mark.parametrize("kind", ["float", "double"])
def test_normals_of_a_ply_file_are_read(tmp_path: Path, kind: str) -> None:
    head = [
        "ply",
        "format ascii 1.0",
        "element vertex 3",
        *(f"property {kind} {a}" for a in ("x", "y", "z")),
    ]
    head += [*(f"property {kind} {a}" for a in ("nx", "ny", "nz")), "element face 1"]
    head += ["property list uchar int vertex_indices", "end_header"]
    rows = ["0 0 0 0 0 2", "1 0 0 0.6 0 0.8", "0 1 0 1 0 0", "3 0 1 2"]
    (tmp_path / "x.ply").write_text("\n".join([*head, *rows]) + "\n")
    np.testing.assert_allclose(
        load(tmp_path / "x.ply").meshes[0].normals, [[0, 0, 1], [0.6, 0, 0.8], [1, 0, 0]]
    )
    rows = ["0 0 0 0 0 0", "1 0 0 0 0 0", "0 1 0 0 0 0", "3 0 1 2"]
    (tmp_path / "x.ply").write_text("\n".join([*head, *rows]) + "\n")
    np.testing.assert_allclose(load(tmp_path / "x.ply").meshes[0].normals, [[0, 0, 1]] * 3)


RED, GREEN = 0b11111, 0b11111 << 5
"""In the order of Materialise Magics; VisCAM has red where this has blue."""


def facets(attribute: list[int], header: bytes, folder: Path) -> tuple[Asset, np.ndarray]:
    """(asset, colours of the corners of the facets (F, 3, 3)) of a flat strip with these
    attributes."""
    p, quads = folded(0.0)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])[: len(attribute)]
    (folder / "x.stl").write_bytes(soup(p[faces], np.array(attribute), header))
    asset = load(folder / "x.stl")
    mesh = asset.meshes[0]
    assert mesh.colors is not None
    return asset, mesh.colors[mesh.faces]


def test_colours_of_viscam(tmp_path: Path) -> None:
    own = 1 << 15
    asset, colors = facets([own | RED, own | GREEN, 0, own | 7], b"", tmp_path)
    want = np.array([(0, 0, 1), (0, 1, 0), (1, 1, 1), (0, 0, srgb_to_linear(np.array(7 / 31)))])
    np.testing.assert_allclose(colors, np.repeat(want[:, None], 3, axis=1), atol=1e-6)
    # colours split vertices, but not the surface
    np.testing.assert_allclose(
        asset.meshes[0].normals, np.tile((0, 0, 1), (len(asset.meshes[0].positions), 1))
    )


def test_colours_of_magics(tmp_path: Path) -> None:
    whole = 1 << 15
    asset, colors = facets(
        [RED, GREEN, whole, whole], b"a part COLOR=" + bytes([51, 102, 204, 128]), tmp_path
    )
    part = srgb_to_linear(np.array([51, 102, 204]) / 255)
    want = np.array([(1, 0, 0), (0, 1, 0), part, part])
    np.testing.assert_allclose(colors, np.repeat(want[:, None], 3, axis=1), atol=1e-6)
    assert any("alpha" in note for note in asset.notes)


def test_binary_stl_files_whose_length_is_not_their_number(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    whole, path = soup(box.vertices[box.faces], header=b"solid, but binary"), tmp_path / "x.stl"

    def with_count(count: int) -> bytes:
        return b"not text".ljust(80) + struct.pack("<I", count) + whole[84:]

    for data, triangles, told in (
        (whole, 12, None),
        (with_count(12) + b"\0\0\0", 12, "3 bytes behind its 12 facets"),
        (with_count(11), 11, "50 bytes behind its 11 facets"),
        (with_count(0), 12, "all 12 are read"),
    ):
        path.write_bytes(data)
        asset = load(path)
        assert asset.triangle_count == triangles
        assert any(told in note for note in asset.notes) if told else len(asset.notes) == 1
    for data, told in (
        (with_count(13), "12 of 13 facets"),
        (with_count(12)[:-1], "11 of 12"),
        (with_count(0)[:84], "no triangles"),
    ):
        path.write_bytes(data)
        with pytest.raises(InputError, match=f"x.stl: .*{told}"):
            load(path)


def test_text_stl_files_of_several_solids(tmp_path: Path) -> None:
    one = trimesh.creation.box().export(file_type="stl_ascii")
    for mark in ("", "\ufeff"):
        (tmp_path / "x.stl").write_text(
            mark + one + one.upper().replace("\n", "\r\n"), encoding="utf-8"
        )
        assert load(tmp_path / "x.stl").triangle_count == 24


def test_an_stl_file_without_colours_has_none(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    # what some programs count there
    (tmp_path / "x.stl").write_bytes(soup(box.vertices[box.faces], np.arange(12)))
    assert load(tmp_path / "x.stl").meshes[0].colors is None
