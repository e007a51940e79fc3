"""PLY files: polygons, colours of vertices and faces under their names, textures and their
coordinates."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import Asset, images, load
from appearance_opt.asset.types import srgb_to_linear
from appearance_opt.errors import InputError

SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
CODES = {"float": "f", "uchar": "B", "int": "i", "ushort": "H"}


def ply(
    folder: Path,
    form: str,
    vertices: list[tuple],
    faces: list[list],
    vertex: tuple[str, ...] = (),
    face: tuple[str, ...] = (),
    comments: tuple[str, ...] = (),
) -> Path:
    """A file. ``vertex``, ``face``: "type name", or "list type name", of what follows positions and
    vertex indices."""
    properties = [("float x", "float y", "float z", *vertex), ("list int vertex_indices", *face)]
    lines = ["ply", f"format {form} 1.0", *(f"comment {c}" for c in comments)]
    for name, rows, given in zip(("vertex", "face"), (vertices, faces), properties, strict=True):
        lines.append(f"element {name} {len(rows)}")
        lines += [f"property {p.replace('list', 'list uchar')}" for p in given]
    body = b""
    for rows, given in zip((vertices, faces), properties, strict=True):
        for row in rows:
            words = []
            for value, kind in zip(row, given, strict=True):
                code = CODES[kind.split()[-2]]
                words += (
                    [("B", len(value)), *((code, v) for v in value)]
                    if "list" in kind
                    else [(code, value)]
                )
            if form == "ascii":
                body += (" ".join(f"{v:g}" for _, v in words) + "\n").encode()
            else:
                order = "<" if "little" in form else ">"
                body += b"".join(struct.pack(order + code, v) for code, v in words)
    (folder / "x.ply").write_bytes("\n".join([*lines, "end_header\n"]).encode() + body)
    return folder / "x.ply"


def by_corner(asset: Asset, name: str) -> dict[tuple, list]:
    """Values of an attribute by position, of the vertices that faces use."""
    out: dict[tuple, list] = {}
    for mesh in asset.meshes:
        for k in np.unique(mesh.faces):
            values = np.round(getattr(mesh, name)[k].astype(float), 4).tolist()
            out.setdefault(tuple(mesh.positions[k].tolist()), []).append(tuple(values))
    return out


@pytest.mark.parametrize("form", FORMATS)
def test_polygons_of_any_size_in_one_file(tmp_path: Path, form: str) -> None:
    points = [*SQUARE, (0.5, 2, 0)]
    asset = load(ply(tmp_path, form, points, [[[0, 1, 2, 4, 3]], [[0, 2, 1]]]))
    mesh = asset.meshes[0]
    p = mesh.positions[mesh.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1).sum() / 2
    assert (len(mesh.faces), area) == (4, pytest.approx(1.5 + 0.5))


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(
    "names", ["red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b"]
)
@pytest.mark.parametrize(("kind", "scale"), [("uchar", 255), ("float", 1), ("ushort", 65535)])
def test_colours_of_vertices_by_any_of_their_names(
    tmp_path: Path, form: str, names: str, kind: str, scale: int
) -> None:
    shades = [0.0, 0.2, 0.6, 1.0]
    stored = [s if kind == "float" else round(s * scale) for s in shades]
    rows = [(*p, s, s, 0) for p, s in zip(SQUARE, stored, strict=True)]
    asset = load(
        ply(tmp_path, form, rows, [[[0, 1, 2, 3]]], tuple(f"{kind} {n}" for n in names.split()))
    )
    got = by_corner(asset, "colors")
    for p, s in zip(SQUARE, shades, strict=True):
        linear = float(srgb_to_linear(np.array([s]))[0])
        assert got[p][0] == pytest.approx((linear, linear, 0), abs=1e-4)


def test_colours_of_faces_split_their_vertices(tmp_path: Path) -> None:
    faces = [[[0, 1, 2], 255, 0, 0], [[0, 2, 3], 0, 0, 255]]
    colors = ("uchar red", "uchar green", "uchar blue")
    got = by_corner(
        load(ply(tmp_path, "binary_little_endian", SQUARE, faces, face=colors)), "colors"
    )
    assert got[(1, 0, 0)] == [(1, 0, 0)]
    assert got[(0, 1, 0)] == [(0, 0, 1)]
    assert sorted(got[(0, 0, 0)]) == [(0, 0, 1), (1, 0, 0)]


def picture(path: Path, color: tuple[int, int, int]) -> None:
    path.write_bytes(images.encode_png(np.full((4, 4, 3), color, np.uint8)))


@pytest.mark.parametrize("names", ["texture_u texture_v", "u v", "s t"])
def test_a_texture_with_coordinates_of_the_vertices(tmp_path: Path, names: str) -> None:
    picture(tmp_path / "my picture.png", (10, 20, 30))
    rows = [(*p, p[0] / 2, p[1] / 4) for p in SQUARE]
    uvs = tuple(f"float {n}" for n in names.split())
    asset = load(
        ply(
            tmp_path, "ascii", rows, [[[0, 1, 2, 3]]], uvs, comments=("TextureFile my picture.png",)
        )
    )
    texture = asset.meshes[0].material.base_color_texture
    assert texture is not None
    assert (tuple(texture.pixels[0, 0]), texture.color_space) == ((10, 20, 30), "srgb")
    assert by_corner(asset, "uvs")[(1, 1, 0)] == [(0.5, 0.75)]  # v counts upward in the file


@pytest.mark.parametrize("form", FORMATS)
def test_textures_with_coordinates_of_the_faces_corners(tmp_path: Path, form: str) -> None:
    for name, color in (("a", (1, 2, 3)), ("b", (4, 5, 6))):
        picture(tmp_path / f"{name}.png", color)
    faces = [[[0, 1, 2], [0, 0, 0.5, 0, 0.5, 1], 0], [[0, 2, 3], [0, 0, 0.25, 1, 0, 1], 1]]
    lists = ("list float texcoord", "int texnumber")
    asset = load(
        ply(
            tmp_path,
            form,
            SQUARE,
            faces,
            face=lists,
            comments=("TextureFile a.png", "TextureFile b.png"),
        )
    )
    assert [tuple(m.material.base_color_texture.pixels[0, 0]) for m in asset.meshes] == [
        (1, 2, 3),
        (4, 5, 6),
    ]
    assert sorted(by_corner(asset, "uvs")[(1, 1, 0)]) == [(0.25, 0), (0.5, 0)]


def test_a_texture_takes_the_place_of_colours(tmp_path: Path) -> None:
    picture(tmp_path / "a.png", (1, 2, 3))
    rows = [(*p, p[0], p[1], 9, 9, 9) for p in SQUARE]
    given = ("float s", "float t", "uchar red", "uchar green", "uchar blue")
    asset = load(
        ply(tmp_path, "ascii", rows, [[[0, 1, 2, 3]]], given, comments=("TextureFile a.png",))
    )
    assert asset.meshes[0].colors is None
    assert "its colours are not drawn where it has a texture" in asset.notes


def test_missing_and_useless_textures(tmp_path: Path) -> None:
    rows = [(*p, p[0], p[1]) for p in SQUARE]
    path = ply(
        tmp_path,
        "ascii",
        rows,
        [[[0, 1, 2]]],
        ("float s", "float t"),
        comments=("TextureFile a.png",),
    )
    with pytest.raises(InputError, match=r"a\.png.*--missing-textures ignore"):
        load(path)
    assert load(path, missing_textures="ignore").meshes[0].material.base_color_texture is None
    asset = load(ply(tmp_path, "ascii", SQUARE, [[[0, 1, 2]]], comments=("TextureFile a.png",)))
    assert "its texture is ignored: there are no texture coordinates" in asset.notes


def test_normals_of_vertices_are_read(tmp_path: Path) -> None:
    rows = [(*p, 0, 0.6, -0.8) for p in SQUARE]
    asset = load(
        ply(tmp_path, "ascii", rows, [[[0, 1, 2, 3]]], ("float nx", "float ny", "float nz"))
    )
    assert by_corner(asset, "normals")[(0, 0, 0)] == [(0, 0.6, -0.8)]


@pytest.mark.parametrize("cut", [1, 40])
@pytest.mark.parametrize("form", FORMATS)
def test_files_cut_short_are_refused(tmp_path: Path, form: str, cut: int) -> None:
    path = ply(tmp_path, form, SQUARE, [[[0, 1, 2, 3]], [[0, 1, 2]]])
    path.write_bytes(path.read_bytes()[:-cut].rstrip(b"\n0123456789 "))
    with pytest.raises(InputError, match=r"x\.ply.*not a readable PLY file"):
        load(path)


def test_lists_of_changing_length_are_not_taken_for_triangles(tmp_path: Path) -> None:
    """A triangle fewer and a polygon more, so that the file is as long as one of triangles."""
    faces = [[[0, 1, 2]], [[0, 1, 2, 3]], [[0, 2]], [[0, 2, 3]]]
    asset = load(ply(tmp_path, "binary_little_endian", SQUARE, faces))
    assert sum(len(m.faces) for m in asset.meshes) == 4
