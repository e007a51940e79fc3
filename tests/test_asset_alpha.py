"""Alpha and transmission in files: what is read, what is written, and what only speaks of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import load, save
from appearance_opt.asset.alpha import Share, count_kinds, coverage, kind_of
from appearance_opt.asset.types import Asset, Material, Mesh, Texture, Volume
from appearance_opt.asset.validate import repair
from appearance_opt.cli import main

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
GREEN = np.full((8, 8, 3), (30, 200, 60), np.uint8)
HALF = np.zeros((8, 8, 1), np.uint8)
HALF[:, 4:] = 255
"""Nothing on the left, all on the right."""


def picture(alpha: np.ndarray = HALF) -> Texture:
    return Texture(np.concatenate([GREEN, alpha], axis=2), "srgb", ("clamp", "clamp"))


def card(
    material: Material, uvs: np.ndarray = UVS, colors: np.ndarray | None = None, name: str = "card"
) -> Mesh:
    return Mesh(
        SQUARE, FACES, np.tile(np.float32([0, 0, 1]), (4, 1)), uvs, None, colors, material, name
    )


def after(mesh: Mesh, path: Path) -> Mesh:
    """The mesh, written and read."""
    save(Asset((mesh,), "x"), path)
    return load(path).meshes[0]


LEAF = Material(
    "leaf", base_color_texture=picture(), alpha_mode="mask", alpha_cutoff=0.25, double_sided=True
)
SMOKE = replace(LEAF, name="smoke", alpha_mode="blend", opacity=0.5)
PANE = Material("pane", (0.8, 0.9, 1.0), 0.1, opacity=0.25, alpha_mode="blend")


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".usda", ".usdz", ".obj"])
@pytest.mark.parametrize("material", [LEAF, SMOKE, PANE], ids=lambda m: m.name)
def test_alpha_survives_every_format(tmp_path: Path, material: Material, suffix: str) -> None:
    got = after(card(material), tmp_path / f"x{suffix}").material
    assert got.alpha_mode == material.alpha_mode
    if material.alpha_mode == "mask":
        assert got.alpha_cutoff == pytest.approx(0.25)
    (before, texture), (factor, texels) = coverage(material), coverage(got)
    if texture is None:
        assert texels is None
        assert factor == pytest.approx(before)
    else:  # factors may have become part of the texture, in eight bits
        np.testing.assert_allclose(
            texels.linear() * factor, texture.linear() * before, atol=0.6 / 255
        )
        colors = (m.base_color_texture.pixels[..., :3] for m in (got, material))
        np.testing.assert_array_equal(*colors)


def test_transmission_survives_gltf(tmp_path: Path) -> None:
    share, depth = (
        Texture(np.arange(s, s + 48, dtype=np.uint8).reshape(4, 4, 3)) for s in (0, 100)
    )
    volume = Volume(0.02, 0.5, (0.9, 0.5, 0.25))
    glass = Material(
        "glass", transmission=0.75, transmission_texture=share, ior=1.33, volume=volume
    )
    got = after(card(replace(glass, thickness_texture=depth)), tmp_path / "x.glb")
    assert kind_of(got.material) == "transmission"
    fields = ("transmission", "ior", "volume", "alpha_mode", "opacity")
    assert [getattr(got.material, f) for f in fields] == [getattr(glass, f) for f in fields]
    np.testing.assert_array_equal(got.material.transmission_texture.pixels, share.pixels)
    np.testing.assert_array_equal(got.material.thickness_texture.pixels, depth.pixels)
    assert not any("ignored" in n for n in load(tmp_path / "x.glb").notes)


@pytest.mark.parametrize("suffix", [".usda", ".obj"])
def test_transmission_becomes_coverage_elsewhere(tmp_path: Path, suffix: str) -> None:
    """What glass of index 1.5 keeps back: 4 % by reflection, and what it does not transmit."""
    got = after(card(Material("glass", transmission=0.75)), tmp_path / f"x{suffix}").material
    assert (got.alpha_mode, got.opacity) == ("blend", pytest.approx(1 - 0.75 * 0.96, abs=1e-6))


def test_vertex_alpha_is_kept_where_it_means_something(tmp_path: Path) -> None:
    colors = np.array([[1, 0.5, 0, 1], [1, 1, 1, 0.5], [0, 0, 1, 0], [1, 1, 1, 1]], np.float32)
    clear, solid = (Material("m", alpha_mode=mode) for mode in ("blend", "opaque"))
    np.testing.assert_allclose(
        after(card(clear, colors=colors), tmp_path / "a.glb").colors, colors, atol=1e-6
    )
    got = after(card(solid, colors=colors), tmp_path / "b.glb")
    np.testing.assert_allclose(got.colors, colors[:, :3], atol=1e-6)


def test_occlusion_stays_with_what_stays(tmp_path: Path) -> None:
    """The maps of parts that go into a result as they are: all of them."""
    orm = Texture(np.arange(192, dtype=np.uint8).reshape(8, 8, 3), "linear", ("clamp", "clamp"))
    for material, kept in (
        (replace(LEAF, orm_texture=orm, has_occlusion=True), True),
        (Material("m", orm_texture=orm, has_occlusion=True), False),
    ):
        got = after(card(material), tmp_path / "x.glb").material
        assert got.has_occlusion is kept
        np.testing.assert_array_equal(got.orm_texture.pixels, orm.pixels)


RIGHT = UVS * np.float32([0.2, 0.2]) + np.float32([0.65, 0.1])
"""Where the picture is opaque, by more than a texel."""


@pytest.mark.parametrize(
    ("mesh", "transparent"),
    [
        (card(replace(LEAF, base_color_texture=None)), False),  # exporters write MASK for all
        (card(replace(PANE, opacity=1.0)), False),
        (card(replace(SMOKE, opacity=1.0, base_color_texture=picture(HALF * 0 + 254))), False),
        (card(replace(SMOKE, opacity=1.0, base_color_texture=picture(HALF * 0 + 250))), True),
        (
            card(replace(LEAF, base_color_texture=picture(HALF * 0 + 64))),
            False,
        ),  # 64 / 255 is 0.251
        (card(replace(LEAF, base_color_texture=picture(HALF * 0 + 63))), True),
        (card(LEAF, RIGHT), False),  # a part of an atlas that has cut-outs elsewhere
        (card(LEAF, RIGHT - np.float32([0.3, 0])), True),
        (card(SMOKE, RIGHT), True),
        (card(PANE), True),
        (card(Material("m", alpha_mode="blend"), colors=np.ones((4, 4), np.float32)), False),
        (card(Material("m", alpha_mode="blend"), colors=np.full((4, 4), 0.5, np.float32)), True),
        (
            card(
                Material(
                    "m",
                    transmission=0.5,
                    transmission_texture=Texture(np.zeros((2, 2, 3), np.uint8)),
                )
            ),
            False,
        ),
    ],
)
def test_what_is_opaque_everywhere_counts_as_opaque(mesh: Mesh, transparent: bool) -> None:
    got = repair(Asset((mesh,)), "x")
    assert (kind_of(got.meshes[0].material) != "opaque") is transparent
    assert (
        bool([n for n in got.notes if f"count as that: '{mesh.material.name}'" in n])
        is not transparent
    )


def test_meshes_of_one_material_are_told_apart() -> None:
    got = repair(
        Asset(
            (card(LEAF, name="leaf"), card(LEAF, RIGHT, name="twig"), card(LEAF, RIGHT, name="bud"))
        ),
        "x",
    )
    assert [m.material.alpha_mode for m in got.meshes] == ["mask", "opaque", "opaque"]
    assert got.meshes[1].material is got.meshes[2].material
    assert count_kinds(got) == {
        "opaque": Share(2, 4, "fitted"),
        "mask": Share(1, 2, "kept as it is"),
    }
    assert len(got.notes) == 1
    # repeated: the period in which a face lies does not matter, and across its border lies the
    # other half
    repeating = replace(LEAF, base_color_texture=replace(picture(), wrap=("repeat", "repeat")))
    far, across = (card(repeating, RIGHT + np.float32([x, 0])) for x in (3, 0.2))
    got = repair(Asset((far, across)), "x")
    assert [m.material.alpha_mode for m in got.meshes] == ["opaque", "mask"]


def test_connected_parts_of_a_mesh_are_told_apart() -> None:
    """One material is that of a body and of its hair: nothing that hangs together is taken
    apart."""
    body = card(LEAF, RIGHT)
    hair = replace(card(LEAF), positions=SQUARE + np.float32([5, 0, 0]))
    # a square of one opaque and one cut-out triangle is no place to cut
    half_uvs = np.concatenate(
        [RIGHT[:3], RIGHT[[0, 2]] - np.float32([0.4, 0]), RIGHT[3:] - np.float32([0.4, 0])]
    )
    half = replace(
        card(LEAF), positions=SQUARE[[0, 1, 2, 0, 2, 3]] + np.float32([9, 0, 0]), uvs=half_uvs,
        faces=np.array([[0, 1, 2], [3, 4, 5]], np.int32), normals=np.tile(np.float32([0, 0, 1]), (6, 1)),
    )  # fmt: skip
    parts = (hair, body, half)
    start = np.cumsum([0] + [len(m.positions) for m in parts[:-1]])
    joined = replace(
        body,
        **{
            n: np.concatenate([getattr(m, n) for m in parts])
            for n in ("positions", "normals", "uvs")
        },
        faces=np.concatenate([m.faces + s for m, s in zip(parts, start, strict=True)]).astype(
            np.int32
        ),
    )
    got = repair(Asset((joined,)), "x")
    assert [(m.name, m.material.alpha_mode) for m in got.meshes] == [
        ("card", "opaque"),
        ("card", "mask"),
    ]
    for name in ("positions", "uvs", "normals"):
        np.testing.assert_array_equal(getattr(got.meshes[0], name), getattr(body, name))
        both = np.concatenate([getattr(hair, name), getattr(half, name)])
        np.testing.assert_array_equal(getattr(got.meshes[1], name), both)
    assert got.notes == (
        "parts of transparent materials that are opaque all over are told apart from the others: 'leaf' (2 triangles)",
    )


def test_many_names_are_counted() -> None:
    got = repair(
        Asset(tuple(card(replace(PANE, name=f"m{k}", opacity=1.0)) for k in range(9))), "x"
    )
    assert got.notes == (
        "materials that speak of transparency are opaque wherever they are used, and count as that: "
        "'m0', 'm1', 'm2', 'm3', 'm4' and 4 more",
    )


def test_inspect_says_what_becomes_of_each(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    cards = [card(m, name=m.name) for m in (LEAF, SMOKE, PANE, Material("wall"))]
    save(Asset((*cards, card(LEAF, RIGHT))), tmp_path / "x.glb")
    monkeypatch.setattr("sys.argv", ["appearance-opt", "inspect", str(tmp_path / "x.glb")])
    main()
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "opaque 2 meshes, 4 triangles: fitted" in lines
    assert "mask 1 mesh, 2 triangles: kept as it is" in lines
    assert "blend 2 meshes, 4 triangles: kept as it is" in lines
