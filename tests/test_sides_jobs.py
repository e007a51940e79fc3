"""From single-sided faces of the input to those of the result: sheets back to back, rooms, both
kinds in one asset."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from test_sides import ball, sheet

from appearance_opt import simplify, simplify_options
from appearance_opt.asset import load, save
from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.baking.target_mesh import movable
from appearance_opt.initial.atlas import charts_of, make_charts, unwrap
from appearance_opt.initial.decimate import decimate_with_source
from appearance_opt.initial.sheets import separate
from appearance_opt.jobs.compare import compare
from appearance_opt.latent.export import to_asset
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.latent.subdivision import tessellate

ONE_SIDED = Material(double_sided=False, roughness=0.8)


def picture(*color: float) -> Texture:
    """Stripes in one colour, and black."""
    pixels = np.zeros((32, 32, 3), np.uint8)
    pixels[:, np.arange(32) % 8 < 5] = color
    return Texture(pixels, "srgb")


def part(p: NDArray, f: NDArray, color: tuple[int, int, int], double_sided: bool = False) -> Mesh:
    low, high = p.min(axis=0), p.max(axis=0)
    uvs = ((p - low) / (high - low))[:, :2].astype(np.float32)
    material = Material(
        base_color_texture=picture(*color), roughness=0.8, double_sided=double_sided
    )
    return Mesh(
        np.ascontiguousarray(p), np.ascontiguousarray(f, np.int32), uvs=uvs, material=material
    )


def pages() -> Asset:
    """Two sheets back to back, one red and one green, of 200 triangles each."""
    p, f = sheet(10, 2.0)
    return Asset((part(p, f, (230, 20, 20)), part(p, f[:, ::-1], (20, 230, 20))), "pages")


def hues(asset: Asset) -> list[NDArray]:
    """Mean colour of the texels in the middle of each chart's faces, by orientation: (front,
    back)."""
    out = []
    for way in (1, -1):
        colors = []
        for m in asset.meshes:
            a, b, c = (m.positions[m.faces[:, k]].astype(np.float64) for k in range(3))
            normal = np.cross(b - a, c - a)
            assert m.uvs is not None and m.material.base_color_texture is not None
            pixels = m.material.base_color_texture.pixels
            at = (m.uvs[m.faces].mean(axis=1) * len(pixels)).astype(int)
            own = normal @ _normal(*sheet(10, 2.0)) * way > 0
            colors.append(pixels[at[own, 1], at[own, 0], :3].astype(np.float64))
        out.append(np.concatenate(colors).mean(axis=0))
    return out


def _normal(p: NDArray, f: NDArray) -> NDArray:
    a, b, c = (p[f[:, k]].astype(np.float64) for k in range(3))
    n = np.cross(b - a, c - a).sum(axis=0)
    return n / np.linalg.norm(n)


def test_each_side_of_a_sheet_keeps_its_triangles() -> None:
    p, f = sheet(10)
    faces = np.concatenate([f, f[:, ::-1]])
    q, g, source = decimate_with_source(p, faces, 60, None, np.ones(len(faces), bool))
    assert 50 < len(g) <= 60
    front = source < len(f)
    assert front.sum() == (~front).sum()
    corners = q[g]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ _normal(p, f)
    np.testing.assert_array_equal(normals > 0, front)


def test_sides_of_a_sheet_share_neither_vertices_nor_charts() -> None:
    p, f = sheet()
    faces = np.concatenate([f, f[:, ::-1]])
    single = np.ones(len(faces), bool)
    out = separate(p, faces, single)
    assert len(out.positions) == 2 * len(p)
    front = np.arange(len(faces)) < len(f)
    assert not np.intersect1d(out.faces[front], out.faces[~front]).size
    np.testing.assert_array_equal(out.positions[out.faces], p[faces])
    assert out.behind[front].all() != out.behind[~front].all()
    mesh = make_charts(p, faces, single)
    chart = charts_of(mesh)
    assert not np.intersect1d(chart[front], chart[~front]).size
    np.testing.assert_array_equal(mesh.positions[mesh.faces], p[faces].astype(np.float32))
    np.testing.assert_array_equal(mesh.frame_vertex[mesh.frame_faces], mesh.faces)


@pytest.mark.parametrize("shared", [False, True])
def test_meshes_that_are_baked_onto_keep_their_sides_apart(shared: bool) -> None:
    p, f = sheet()
    faces = np.concatenate([f, f[:, ::-1] if shared else f[:, ::-1] + len(p)]).astype(np.int32)
    p = p if shared else np.concatenate([p, p])
    vertices = np.arange(len(p), dtype=np.int32)
    uvs = np.zeros((len(p), 2), np.float32)
    low = LatentMesh(p, faces, vertices, faces, uvs, single=np.ones(len(faces), bool))
    mesh = movable(low)
    front = np.arange(len(faces)) < len(f)
    assert bool(np.intersect1d(mesh.faces[front], mesh.faces[~front]).size) == shared
    np.testing.assert_array_equal(mesh.positions[mesh.faces], p[faces])
    np.testing.assert_array_equal(mesh.frame_vertex[mesh.frame_faces], mesh.faces)


def test_other_surfaces_stay_in_one_piece() -> None:
    for p, f in (ball(), (ball()[0], ball()[1][20:]), sheet()):
        single = np.ones(len(f), bool)
        assert separate(p, f, single).positions is p
        assert separate(p, f, None).positions is p
    # double-sided sheets back to back are for the stacks to sort out
    p, f = sheet()
    faces = np.concatenate([f, f[:, ::-1]])
    assert separate(p, faces, np.zeros(len(faces), bool)).positions is p


def test_borders_between_sides_are_held() -> None:
    """A flat square, one half of which is seen from both sides: the line between the halves costs
    triangles."""
    n = 12
    y, x = np.mgrid[0 : n + 1, 0 : n + 1] / n
    p = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    i = np.arange(n * n)
    a = i // n * (n + 1) + i % n
    f = np.concatenate([np.stack([a, a + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + n + 1], 1)])
    single = p[f].mean(axis=1)[:, 0] > 0.5
    q, g, source = decimate_with_source(p, f, 24, None, single)
    middle = q[g].mean(axis=1)[:, 0]
    np.testing.assert_array_equal(middle > 0.5, single[source])
    corners = q[g]
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    assert area[single[source]].sum() == pytest.approx(0.5, rel=1e-3)


@pytest.mark.parametrize("form", ["glb", "usda", "obj"])
def test_results_with_both_kinds_of_faces_share_their_textures(form: str, tmp_path: Path) -> None:
    p, f = ball(100)
    mesh = unwrap(p, f, 32, single=p[f].mean(axis=1)[:, 0] > 0)
    maps = {
        n: np.full((32, 32), 0.5, np.float32)
        for n in ("red", "green", "blue", "roughness", "metalness")
    }
    asset = to_asset(mesh, p, maps, "both")
    assert [m.material.double_sided for m in asset.meshes] == [True, False]
    assert sum(len(m.faces) for m in asset.meshes) == len(f)
    assert (
        asset.meshes[0].material.base_color_texture is asset.meshes[1].material.base_color_texture
    )
    path = tmp_path / f"both.{form}"
    save(asset, path)
    again = load(path)
    count = sum(len(m.faces) for m in again.meshes if not m.material.double_sided)
    # OBJ knows nothing of sides
    assert count == (0 if form == "obj" else len(asset.meshes[1].faces))
    assert again.triangle_count == len(f)
    if form == "glb":
        data = path.read_bytes()
        stored = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
        assert len(stored["images"]) == 2
        assert [m["name"] for m in stored["materials"]] == ["both", "both_single_sided"]
    else:
        written = list(tmp_path.rglob("*.png"))
        assert len(written) == (
            3 if form == "obj" else 2
        )  # roughness and metalness are two pictures in OBJ


@pytest.mark.parametrize("kind", [None, True, False])
def test_one_kind_of_faces_needs_one_material(kind: bool | None) -> None:
    p, f = ball(100)
    mesh = unwrap(p, f, 32, single=None if kind is None else np.full(len(f), kind))
    asset = to_asset(mesh, p, {"red": 0.5}, "one")
    (only,) = asset.meshes
    assert only.material.double_sided == (kind is not True)


def test_tessellated_faces_have_the_sides_of_their_base() -> None:
    p, f = ball(60)
    single = p[f].mean(axis=1)[:, 2] > 0
    fine = tessellate(unwrap(p, f, 32, single=single), 2).mesh
    assert fine.single is not None
    np.testing.assert_array_equal(fine.single, fine.positions[fine.faces].mean(axis=1)[:, 2] > 0)


def quick(**more: object) -> object:
    common = {
        "steps": 2,
        "views": 2,
        "resolution": 64,
        "texture_size": 128,
        "reallocate": 0,
        "pool": 4,
    }
    return simplify_options("draft", **{**common, **more})


def test_both_sides_of_a_sheet_show_their_own_picture() -> None:
    heavy = pages()
    result = simplify(heavy, None, quick(triangles=80))
    (mesh,) = result.asset.meshes
    assert not mesh.material.double_sided
    front, back = hues(result.asset)
    assert front[0] > 3 * front[1]
    assert back[1] > 3 * back[0]
    # 12 dB where both pictures are mixed
    assert compare(heavy, result.asset, views=6, resolution=96, samples=4).metrics.psnr_covered > 22


def test_what_stands_in_a_room_that_is_looked_into_is_kept() -> None:
    walls, thing = ball(300), ball(200, 0.5)
    room = Asset(
        (part(walls[0], walls[1][:, ::-1], (90, 90, 200)), part(*thing, (230, 20, 20))), "room"
    )
    closed = Asset((part(*walls, (90, 90, 200)), part(*thing, (230, 20, 20))), "closed")
    for heavy, kept in ((room, True), (closed, False)):
        result = simplify(heavy, None, quick(triangles=150))
        points = np.concatenate([m.positions[m.faces].mean(axis=1) for m in result.asset.meshes])
        assert (np.linalg.norm(points, axis=1) < 0.6).any() == kept


def test_leaves_and_bark_keep_their_sides() -> None:
    leaf, bark = sheet(6, 1.5), ball(200, 0.4)
    heavy = Asset((part(*leaf, (20, 200, 20), True), part(*bark, (120, 80, 40))), "tree")
    result = simplify(heavy, None, quick(triangles=100))
    both, one = result.asset.meshes
    assert both.material.double_sided and not one.material.double_sided
    assert np.linalg.norm(one.positions, axis=1).max() < 0.45
    assert np.linalg.norm(both.positions, axis=1).max() > 0.9
