"""Transparent parts pass through jobs: what lies behind them stays, and they come out as they went
in."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import appearance_opt
from appearance_opt.asset import load, save
from appearance_opt.asset.alpha import kind_of, seen_through
from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.errors import InputError
from appearance_opt.jobs.lifecycle import fingerprint
from appearance_opt.placement import Placement
from appearance_opt.reference.subject import Subject
from appearance_opt.stages.pair import Pair
from appearance_opt.stages.parts import split
from appearance_opt.stages.run import Run
from appearance_opt.stages.start import atlas_of
from tests.conftest import grid_sphere

QUICK = {"texture_size": 64, "resolution": 48, "pool": 4, "views": 2, "steps": 0, "reallocate": 0}
GLASS = Material(
    "glass", (0.8, 0.9, 1.0), 0.05, opacity=0.2, alpha_mode="blend", double_sided=False
)
RED, BLUE = (0.7, 0.1, 0.1), (0.1, 0.1, 0.7)


def ball(radius: float, material: Material, name: str, rows: int = 16) -> Mesh:
    positions, faces, uvs = grid_sphere(rows, 2 * rows, radius)
    return Mesh(positions, faces, positions / np.float32(radius), uvs, None, None, material, name)


@pytest.fixture(scope="module")
def snow_globe() -> Asset:
    """A red ball in a glass ball, and a cut-out label on it."""
    alpha = np.zeros((8, 8, 4), np.uint8)
    alpha[:, 4:, 3] = 255
    label = Material(
        "label", base_color_texture=Texture(alpha, "srgb"), alpha_mode="mask", alpha_cutoff=0.25
    )
    inside = ball(0.5, Material("paint", RED, 0.6), "ball")
    return Asset((ball(1.0, GLASS, "shell"), inside, ball(1.05, label, "sticker", 4)), "globe")


def options(**values: object) -> appearance_opt.SimplifyOptions:
    return appearance_opt.simplify_options("draft", **{"triangles": 200, **QUICK, **values})


def check_kept(result: Asset, source: Asset) -> None:
    """All that the transparent meshes of the source have is there."""
    found = {m.name: m for m in result.meshes}
    for mesh in (m for m in source.meshes if seen_through(m)):
        got = found[mesh.name]
        for name in ("positions", "faces", "normals", "uvs"):
            np.testing.assert_array_equal(getattr(got, name), getattr(mesh, name))
        for f in fields(Material):
            before, after = getattr(mesh.material, f.name), getattr(got.material, f.name)
            if isinstance(before, Texture):
                np.testing.assert_array_equal(after.pixels, before.pixels)
            else:
                assert before == after


def test_simplified_beside_what_stays(tmp_path: Path, snow_globe: Asset) -> None:
    save(snow_globe, tmp_path / "globe.glb")
    source = load(tmp_path / "globe.glb")
    result = appearance_opt.simplify(
        tmp_path / "globe.glb", tmp_path / "low.glb", options(), report=tmp_path / "report"
    )
    assert (tmp_path / "report" / "report.html").is_file()
    kept = sum(len(m.faces) for m in source.meshes if seen_through(m))
    assert result.triangles <= 200
    assert (result.source_triangles, result.kept_triangles) == (len(source.meshes[1].faces), kept)
    told = "transparent parts pass into the result as they are, and count for no --triangles or --ratio: 2"
    assert [
        n for n in result.notes if n.startswith(f"{told} ('shell', 'sticker') of {kept} triangles")
    ]
    written = load(tmp_path / "low.glb")
    for asset in (result.asset, written):
        check_kept(asset, source)
    # what nobody would see behind an opaque shell is there, at its place and in its colour
    (fitted,) = (m for m in written.meshes if m.name == "ball")
    assert len(written.meshes) == 3
    assert len(fitted.faces) == result.triangles
    np.testing.assert_allclose(np.abs(fitted.positions).max(axis=0), 0.5, atol=0.05)
    assert fitted.material.base_color_texture is None  # of one colour
    np.testing.assert_allclose(fitted.material.base_color, RED, atol=0.02)


def test_a_ratio_counts_what_is_simplified(snow_globe: Asset) -> None:
    got = appearance_opt.simplify(snow_globe, None, options(triangles=None, ratio=0.25))
    assert got.triangles <= round(0.25 * len(snow_globe.meshes[1].faces))
    check_kept(got.start, snow_globe)


def test_every_level_of_a_displaced_result_has_them(snow_globe: Asset) -> None:
    got = appearance_opt.simplify(snow_globe, None, options(displacement=True, subdivision=(1,)))
    for asset in (got.asset, got.start, got.tessellated[1], got.shown):
        check_kept(asset, snow_globe)


def test_nothing_left_to_work_on_is_refused(tmp_path: Path, snow_globe: Asset) -> None:
    clear = replace(snow_globe, meshes=snow_globe.meshes[::2])
    with pytest.raises(
        InputError,
        match=r"^globe: all of it is transparent \('glass', 'label'\), .*nothing to simplify",
    ):
        appearance_opt.simplify(clear, None, options())
    baking = appearance_opt.bake_options(**{k: v for k, v in QUICK.items() if k != "reallocate"})
    for high, low, which in ((clear, snow_globe, "HIGH"), (snow_globe, clear, "LOW")):
        with pytest.raises(InputError, match=rf"^{which}, globe: all of it is transparent"):
            appearance_opt.bake(high, low, None, baking)
    save(clear, tmp_path / "clear.glb")
    with pytest.raises(InputError, match=r"--init .*clear.glb: all of it is transparent"):
        appearance_opt.simplify(
            snow_globe, None, options(triangles=None, init=str(tmp_path / "clear.glb"))
        )


def test_a_start_from_a_file_leaves_its_transparent_parts_out(snow_globe: Asset) -> None:
    opaque = replace(snow_globe, meshes=snow_globe.meshes[1:2])
    subject = Subject.of_asset(opaque, placement=Placement())
    mesh, notes = atlas_of(snow_globe, subject, options(triangles=None, init="globe.glb"))
    assert len(mesh.faces) == len(snow_globe.meshes[1].faces)
    assert "of --init are left out" in notes[0]


def test_bakes_leave_them_alone(snow_globe: Asset) -> None:
    """Glass around HIGH would be what rays from outside meet first; glass of LOW keeps its
    material."""
    low = Asset((ball(0.52, Material("low", BLUE), "low", 8), ball(1.1, GLASS, "pane", 6)), "low")
    given = {
        **QUICK,
        "maps": ("material", "ao"),
        "ao_rays": 16,
        "closed_form": True,
        "hit": "outermost",
        "cage": 0.8,
    }
    chosen = appearance_opt.bake_options(**{k: v for k, v in given.items() if k != "reallocate"})
    result = appearance_opt.bake(snow_globe, low, None, chosen)
    check_kept(result.asset, low)
    colors = np.stack([result.maps[c][result.covered] for c in ("red", "green", "blue")], axis=1)
    np.testing.assert_allclose(np.median(colors, axis=0), RED, atol=0.01)
    # glass does not occlude
    assert result.maps["occlusion"][result.covered].mean() > 0.99
    assert any(n.startswith("transparent parts of HIGH are not baked: 2 (") for n in result.notes)
    assert any(
        n.startswith("transparent parts of LOW stay as they are: 1 ('pane')") for n in result.notes
    )


def test_joint_bakes_leave_them_alone(snow_globe: Asset) -> None:
    low = Asset((ball(1.1, GLASS, "pane", 6), ball(0.52, Material("low", BLUE), "low", 8)), "low")
    chosen = {k: v for k, v in QUICK.items() if k != "reallocate"}
    options_ = appearance_opt.joint_options(**{**chosen, "subdivision": (1,)})
    got = appearance_opt.joint(snow_globe, low, None, options_)
    for asset in (got.asset, got.start, got.shown):
        check_kept(asset, low)
    assert (got.triangles, got.kept_triangles) == (
        len(low.meshes[1].faces),
        len(low.meshes[0].faces),
    )


def test_what_is_aligned_is_aligned_whole(snow_globe: Asset) -> None:
    """By what is baked; HIGH's glass, of which a report's pictures show something, goes with it."""
    away = np.float32([3, -2, 1])
    moved = replace(
        snow_globe,
        meshes=tuple(
            replace(m, positions=m.positions * np.float32(2) + away) for m in snow_globe.meshes
        ),
    )
    low = Asset((ball(0.5, Material("low", BLUE), "low", 16),), "low")
    parts = split(moved, "HIGH", "bake"), split(low, "LOW", "bake onto")
    job = Pair.of(*parts, "LOW", appearance_opt.bake_options(align=True, unwrap=True), Run())
    for mesh, name in zip(job.high.meshes, ("ball", "shell", "sticker"), strict=True):
        expected = next(m for m in snow_globe.meshes if m.name == name)
        np.testing.assert_allclose(mesh.positions, expected.positions, atol=2e-3)
    shown = job.shown()
    assert shown.placement.scale > 1.04  # the label, at 1.05, is in the picture
    assert job.subject.placement.scale < 0.6
    assert shown.sampler.hull is not None


def test_resuming_knows_what_stays(snow_globe: Asset) -> None:
    shell = snow_globe.meshes[0]
    thicker = replace(shell, material=replace(GLASS, opacity=0.3))
    tinted = replace(shell, material=replace(GLASS, transmission=0.5))
    moved = replace(shell, positions=shell.positions * np.float32(1.1))
    prints = {
        fingerprint(options(), replace(snow_globe, meshes=(one, *snow_globe.meshes[1:])), None)
        for one in (shell, thicker, tinted, moved)
    }
    assert len(prints) == 4


def test_parts_are_split_by_what_is_seen_of_them(snow_globe: Asset) -> None:
    parts = split(snow_globe, "x", "simplify")
    assert [m.name for m in parts.fitted.meshes] == ["ball"]
    assert [m.name for m in parts.kept] == ["shell", "sticker"]
    assert [m.name for m in parts.whole.meshes] == ["ball", "shell", "sticker"]
    # an asset that was not read from a file may say more than it means, too
    solid = replace(
        snow_globe, meshes=(ball(1.0, replace(GLASS, opacity=1.0), "shell"), snow_globe.meshes[1])
    )
    parts = split(solid, "x", "simplify")
    assert not parts.kept
    assert [kind_of(m.material) for m in parts.fitted.meshes] == ["opaque", "opaque"]
    assert any("count as that: 'glass'" in n for n in parts.fitted.notes)
    opaque = replace(snow_globe, meshes=snow_globe.meshes[1:2])
    assert split(opaque, "x", "simplify").fitted is opaque
