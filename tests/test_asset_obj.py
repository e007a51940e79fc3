"""OBJ and MTL: names, options of maps, bump maps, transparency, vertex colours, factors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import images, load, save
from appearance_opt.asset.types import Asset, Material, Mesh, Texture, srgb_to_linear
from appearance_opt.errors import InputError

FACE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
NORMALS = np.full((4, 4, 3), (128, 128, 255), np.uint8)
HEIGHTS = np.linspace(0, 255, 48).astype(np.uint8).reshape(4, 4, 3)


def read(folder: Path, mtl: str, **pictures: np.ndarray) -> Asset:
    """A triangle with a material of these statements; ``pictures`` by stem."""
    for name, pixels in pictures.items():
        (folder / f"{name}.png").write_bytes(images.encode_png(pixels))
    (folder / "x.mtl").write_text("newmtl m\n" + mtl + "\n")
    (folder / "x.obj").write_text("mtllib x.mtl\n" + FACE)
    return load(folder / "x.obj")


def painted(ball: Asset, *names: str) -> Asset:
    """The ball several times, each with a material of its own."""
    mesh = ball.meshes[0]
    return Asset(tuple(replace(mesh, material=replace(mesh.material, name=n)) for n in names), "x")


@pytest.mark.parametrize("suffix", [".obj", ".gltf", ".usda"])
@pytest.mark.parametrize(
    "name", ["Metal/Gold", "../../up", "a\\b:c*?", "two\nlines", "ä" * 300, ""]
)
def test_names_that_are_no_file_names(tmp_path: Path, ball: Asset, suffix: str, name: str) -> None:
    save(painted(ball, name), tmp_path / f"x{suffix}")
    again = load(tmp_path / f"x{suffix}").meshes[0].material
    assert again.base_color_texture is not None and again.orm_texture is not None
    for file in tmp_path.rglob("*.png"):
        assert set(file.name) <= set(
            "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789._-"
        )


def test_names_that_become_equal_keep_their_pictures_apart(tmp_path: Path, ball: Asset) -> None:
    both = painted(ball, "a/b", "a_b")
    other = Texture(np.zeros((2, 2, 3), np.uint8), "srgb")
    material = replace(both.meshes[1].material, base_color_texture=other)
    save(
        replace(both, meshes=(both.meshes[0], replace(both.meshes[1], material=material))),
        tmp_path / "x.obj",
    )
    first, second = (m.material.base_color_texture.pixels for m in load(tmp_path / "x.obj").meshes)
    np.testing.assert_array_equal(first, ball.meshes[0].material.base_color_texture.pixels)
    np.testing.assert_array_equal(second, other.pixels)


@pytest.mark.parametrize("options", ["-s 2 2", "-s 2 2 1", "-s 2 2 -clamp off -bm 1"])
def test_values_of_options_may_be_left_out(tmp_path: Path, options: str) -> None:
    asset = read(tmp_path, f"map_Kd {options} my picture.png", **{"my picture": NORMALS})
    assert asset.meshes[0].material.base_color_texture is not None
    np.testing.assert_allclose(np.ptp(asset.meshes[0].uvs, axis=0), 2)


@pytest.mark.parametrize(
    "name", ['"my  picture.png"', "my  picture.png", "-clamp on my  picture.png"]
)
def test_names_with_spaces_and_quotation_marks(tmp_path: Path, name: str) -> None:
    assert (
        read(tmp_path, f"map_Kd {name}", **{"my  picture": NORMALS})
        .meshes[0]
        .material.base_color_texture
    )


@pytest.mark.parametrize("statement", ["map_Kd -s", "map_Kd -s x t.png", "map_Kd -bm", "Tr x"])
def test_options_without_their_values_are_refused(tmp_path: Path, statement: str) -> None:
    with pytest.raises(
        InputError, match=r"x\.mtl: a value of material 'm' is missing or not a number"
    ):
        read(tmp_path, statement, t=NORMALS)


def test_a_file_whose_name_is_a_number(tmp_path: Path) -> None:
    (tmp_path / "7").write_bytes(images.encode_png(NORMALS))
    assert read(tmp_path, "map_Kd -s 2 2 7").meshes[0].material.base_color_texture is not None


def test_scale_and_offset_move_the_coordinates(tmp_path: Path) -> None:
    """u' = scale u + offset, v upward: Blender's exporter writes its mapping node so."""
    mesh = read(tmp_path, "map_Kd -o 0.25 0.5 -s 2 3 t.png", t=NORMALS).meshes[0]
    at = [
        int(np.flatnonzero((mesh.positions == p).all(axis=1))[0])
        for p in ([0, 0, 0], [1, 0, 0], [0, 1, 0])
    ]
    np.testing.assert_allclose(
        mesh.uvs[at], [[0.25, 1 - 0.5], [2.25, 1 - 0.5], [0.25, 1 - 3.5]], atol=1e-6
    )


@pytest.mark.parametrize("key", ["map_Bump", "bump", "norm", "map_Kn"])
def test_normal_maps_by_all_their_names(tmp_path: Path, key: str) -> None:
    material = read(tmp_path, f"{key} -bm 0.5 t.png", t=NORMALS).meshes[0].material
    np.testing.assert_array_equal(material.normal_texture.pixels, NORMALS)
    assert material.normal_scale == 0.5


@pytest.mark.parametrize("pixels", [HEIGHTS, HEIGHTS[..., :1], np.full((4, 4, 3), 128, np.uint8)])
def test_a_bump_map_of_heights_is_dropped_with_a_note(tmp_path: Path, pixels: np.ndarray) -> None:
    asset = read(tmp_path, "map_Bump t.png", t=pixels)
    assert asset.meshes[0].material.normal_texture is None
    assert [n for n in asset.notes if "heights" in n and "t.png" in n]


@pytest.mark.parametrize(
    ("mtl", "opacity"),
    [
        ("d 1.00", 1), ("d 1", 1), ("d 0.5", 0.5), ("d -halo 0.5", 0.5), ("Tr 0", 1), ("Tr 0.75", 0.25),
        ("Tr 0.7\nd 1.0", 1), ("d 0", 1), ("Tr 1", 1),
    ],
)  # fmt: skip
def test_dissolve_becomes_opacity(tmp_path: Path, mtl: str, opacity: float) -> None:
    asset = read(tmp_path, mtl)
    material = asset.meshes[0].material
    assert (material.opacity, material.alpha_mode) == (
        opacity,
        "blend" if opacity < 1 else "opaque",
    )
    # exporters write so for all that they export
    assert any("nothing of it is seen" in n for n in asset.notes) is (mtl in ("d 0", "Tr 1"))


ALPHA = np.arange(16, dtype=np.uint8).reshape(4, 4, 1) * 17
COLOR = np.full((4, 4, 3), (200, 100, 50), np.uint8)


@pytest.mark.parametrize(
    ("mtl", "picture"),
    [
        ("map_d t.png", ALPHA),
        ("d 0\nmap_d t.png", ALPHA),  # constants beside a map do not count
        ("map_d t.png", np.concatenate([COLOR, ALPHA], axis=2)),  # a picture with alpha
        ("map_d -imfchan g t.png", np.concatenate([COLOR[..., :1], ALPHA, COLOR[..., 1:]], axis=2)),
        (
            "map_d t.png",
            np.concatenate([np.repeat(ALPHA, 3, axis=2), np.full_like(ALPHA, 255)], axis=2),
        ),
    ],
)
def test_maps_of_dissolve_become_alpha(tmp_path: Path, mtl: str, picture: np.ndarray) -> None:
    material = read(tmp_path, f"map_Kd c.png\n{mtl}", t=picture, c=COLOR).meshes[0].material
    np.testing.assert_array_equal(
        material.base_color_texture.pixels, np.concatenate([COLOR, ALPHA], axis=2)
    )
    assert (material.alpha_mode, material.opacity) == ("blend", 1)
    alone = read(tmp_path, f"Kd 0.5 0.25 1\n{mtl}", t=picture).meshes[0].material
    np.testing.assert_array_equal(alone.base_color_texture.pixels[..., 3:], ALPHA)
    np.testing.assert_allclose(
        alone.base_color_texture.linear()[..., :3] * alone.base_color, [[(0.5, 0.25, 1)] * 4] * 4
    )


def test_maps_that_are_not_read_are_noted(tmp_path: Path) -> None:
    notes = read(
        tmp_path, "map_Ks t.png\nmap_Kd -mm 0.1 2 t.png\nmap_Ka t.png\ndisp t.png", t=NORMALS
    ).notes
    assert "material 'm': map_ks, disp ignored" in notes
    assert "material 'm': -mm of map_kd ignored" in notes


def test_float_pictures_are_linear(tmp_path: Path) -> None:
    (tmp_path / "t.exr").write_bytes(images.encode_exr(np.full((2, 2, 3), 0.5, np.float32)))
    np.testing.assert_allclose(
        read(tmp_path, "map_Kd t.exr").meshes[0].material.base_color_texture.linear(), 0.5
    )


def test_vertex_colours_are_srgb_encoded_in_the_file(tmp_path: Path) -> None:
    (tmp_path / "x.obj").write_text("v 0 0 0 0.5 0 1\nv 1 0 0 0.5 0 1\nv 0 1 0 0.5 0 1\nf 1 2 3\n")
    colors = load(tmp_path / "x.obj").meshes[0].colors
    np.testing.assert_allclose(
        colors, np.tile(srgb_to_linear(np.float32([0.5, 0, 1])), (3, 1)), atol=1e-6
    )


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_vertex_colours_survive_a_round_trip(tmp_path: Path, suffix: str) -> None:
    colors = np.array([[0.1, 0.5, 1], [0, 0.002, 0.9], [1, 0.25, 0.3]], np.float32)
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    save(
        Asset((Mesh(positions, np.array([[0, 1, 2]], np.int32), colors=colors),)),
        tmp_path / f"x{suffix}",
    )
    np.testing.assert_allclose(load(tmp_path / f"x{suffix}").meshes[0].colors, colors, atol=1e-6)


def test_factors_become_part_of_the_maps(tmp_path: Path, ball: Asset) -> None:
    """Readers that multiply constants and maps, and those that ignore the constants, see the
    same."""
    factors = {"base_color": (0.5, 0.2, 0.1), "roughness": 0.5, "metalness": 0.25}
    mesh = ball.meshes[0]
    before = replace(mesh.material, **factors)
    save(Asset((replace(mesh, material=before),)), tmp_path / "x.obj")
    after = load(tmp_path / "x.obj").meshes[0].material
    statements = [line.split() for line in (tmp_path / "x.mtl").read_text().splitlines()]
    assert [s for s in statements if s and s[0] in ("Kd", "Pr", "Pm")] == [
        ["Kd", "1", "1", "1"],
        ["Pr", "1"],
        ["Pm", "1"],
    ]
    expected = before.base_color_texture.linear() * before.base_color
    # half a step of eight bits: measured 0.0042 where sRGB is steepest in linear values
    np.testing.assert_allclose(
        after.base_color_texture.linear() * after.base_color, expected, atol=0.005
    )
    for channel, before_, after_ in (
        (1, before.roughness, after.roughness),
        (2, before.metalness, after.metalness),
    ):
        expected = before.orm_texture.linear()[..., channel] * before_
        np.testing.assert_allclose(
            after.orm_texture.linear()[..., channel] * after_, expected, atol=0.0021
        )


def test_a_strength_of_normals_survives(tmp_path: Path, ball: Asset) -> None:
    material = Material("m", normal_texture=Texture(NORMALS), normal_scale=0.7)
    save(Asset((replace(ball.meshes[0], material=material),)), tmp_path / "x.obj")
    assert load(tmp_path / "x.obj").meshes[0].material.normal_scale == pytest.approx(0.7)
