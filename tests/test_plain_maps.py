"""Channels that are constant are written as factors: one test a channel, and mixed; what pictures
say decides on noise."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

import appearance_opt
from appearance_opt.asset import save
from appearance_opt.asset.types import Asset, Material, Mesh, srgb_to_linear
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.export import to_asset
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.latent.parameter import Rates
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.stages.plain import LOSS, NOISE, STEP, Pictures, replace_constant
from appearance_opt.views import views_around
from tests.conftest import grid_sphere

N = 8
COLORS = ("red", "green", "blue")
EMISSION = ("emission_red", "emission_green", "emission_blue")
EVERYWHERE = np.ones((N, N), bool)


def ramp(low: float, high: float) -> np.ndarray:
    return np.linspace(low, high, N * N, dtype=np.float32).reshape(N, N)


def varied() -> dict:
    """Maps of which every channel has something to show."""
    colors = {n: ramp(0.1, 0.2 + 0.1 * k) for k, n in enumerate(COLORS)}
    tilt = ramp(-0.3, 0.3)
    normal = {"normal_x": tilt, "normal_y": np.zeros_like(tilt), "normal_z": np.sqrt(1 - tilt**2)}
    return {**colors, "roughness": ramp(0.2, 0.7), "metalness": ramp(0, 1), **normal}


def flat(*values: float) -> list[np.ndarray]:
    """Images of almost one value each: within half a step."""
    return [np.full((N, N), v, np.float32) + ramp(-STEP / 8, STEP / 8) for v in values]


def written(maps: dict) -> Material:
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    corners = np.arange(3)
    mesh = LatentMesh(positions, faces, corners, faces, positions[:, :2].copy())
    return to_asset(mesh, positions, replace_constant(maps, EVERYWHERE), "x").meshes[0].material


def test_what_varies_stays() -> None:
    maps = varied()
    out = replace_constant(maps, EVERYWHERE)
    assert all(out[n] is maps[n] for n in maps)


def test_a_constant_base_colour_is_a_factor() -> None:
    m = written({**varied(), **dict(zip(COLORS, flat(0.5, 0.25, 0.125), strict=True))})
    assert m.base_color_texture is None
    np.testing.assert_allclose(m.base_color, (0.5, 0.25, 0.125), atol=1e-5)
    assert m.orm_texture is not None and m.normal_texture is not None


def test_one_channel_of_a_colour_that_varies_keeps_the_map() -> None:
    m = written({**varied(), **dict(zip(COLORS[1:], flat(0.25, 0.125), strict=True))})
    assert m.base_color_texture is not None and m.base_color == (1, 1, 1)


def test_constant_roughness_and_metalness_are_factors() -> None:
    rough, metal = flat(0.6, 0.25)
    m = written({**varied(), "roughness": rough, "metalness": metal})
    assert m.orm_texture is None
    assert (m.roughness, m.metalness) == pytest.approx((0.6, 0.25), abs=1e-5)


@pytest.mark.parametrize(("name", "channel"), [("roughness", 1), ("metalness", 2)])
def test_one_of_both_is_a_constant_channel_of_their_map(name: str, channel: int) -> None:
    maps = {**varied(), name: flat(0.6)[0]}
    m = written(maps)
    assert (m.roughness, m.metalness) == (1, 1)
    np.testing.assert_array_equal(m.orm_texture.pixels[..., channel], round(0.6 * 255))
    other = {1: "metalness", 2: "roughness"}[channel]
    np.testing.assert_allclose(
        m.orm_texture.linear()[..., 3 - channel], maps[other], atol=0.51 * STEP
    )


def test_a_flat_normal_map_is_none() -> None:
    x, y, z = flat(0.0, 0.0, 1.0)
    m = written({**varied(), "normal_x": x, "normal_y": y, "normal_z": z})
    assert m.normal_texture is None
    leaning = {
        "normal_x": np.full((N, N), 0.6, np.float32),
        "normal_y": y,
        "normal_z": np.full((N, N), 0.8, np.float32),
    }
    assert written({**varied(), **leaning}).normal_texture is not None  # constant, but not flat


def test_a_constant_emission_is_a_factor() -> None:
    m = written({**varied(), **dict(zip(EMISSION, flat(4.0, 2.0, 0.0), strict=True))})
    assert m.emission_texture is None
    np.testing.assert_allclose(m.emission, (4, 2, 0), atol=1e-5)
    bright = {**varied(), **dict(zip(EMISSION, (ramp(1, 4), *flat(2.0, 0.0)), strict=True))}
    assert written(bright).emission_texture is not None


def test_everything_constant_leaves_no_map() -> None:
    maps = dict(
        zip((*COLORS, "roughness", "metalness"), flat(0.5, 0.5, 0.5, 0.7, 0.0), strict=True)
    )
    m = written(maps)
    assert (m.base_color_texture, m.orm_texture, m.normal_texture) == (None, None, None)


def test_steps_are_those_of_the_stored_values() -> None:
    """In the dark, where sRGB has more steps, less is visible in linear values."""
    for encoded, constant in ((0.1, True), (0.8, True)):
        for steps, expected in ((0.9, constant), (1.1, False)):
            image = np.full((N, N), encoded, np.float32)
            image[: N // 2] += 2 * steps * STEP
            image = srgb_to_linear(image)
            out = replace_constant({**dict.fromkeys(COLORS, image)}, EVERYWHERE)
            assert (not np.ndim(out["red"])) is expected, (encoded, steps)


def test_texels_of_no_triangle_do_not_count() -> None:
    rough, known = flat(0.6)[0], EVERYWHERE.copy()
    rough[0, 0], known[0, 0] = 0.0, False
    assert np.ndim(replace_constant({"roughness": rough}, EVERYWHERE)["roughness"]) == 2
    assert replace_constant({"roughness": rough}, known)["roughness"] == pytest.approx(
        0.6, abs=1e-5
    )


@dataclass
class Told:
    """A judge that answers what it was told to."""

    changes: float
    loses: float
    channels: tuple[str, ...] = ("roughness",)
    asked: list = field(default_factory=list)

    def change(self, maps: dict) -> float:
        self.asked.append(maps)
        return self.changes

    def loss(self, maps: dict) -> float:
        return self.loses


@pytest.mark.parametrize(
    ("spread", "changes", "loses", "start", "constant"),
    [
        (6, 0.9 * STEP, 1.0, None, True),  # nobody sees it
        (6, 1.1 * STEP, 0.0, None, False),
        (6, 3 * STEP, 0.5 * LOSS, 0.6, True),  # noise around what was constant
        (6, 3 * STEP, 0.5 * LOSS, ramp(0.2, 0.7), False),  # the original has something to show
        (6, 3 * STEP, 2 * LOSS, 0.6, False),  # it makes up for something
        (20, 0.0, 0.0, 0.6, False),  # no noise varies so much: not asked
    ],
)
def test_pictures_decide_on_noise(
    spread: float, changes: float, loses: float, start: object, constant: bool
) -> None:
    rough = 0.6 + ramp(-spread * STEP, spread * STEP)
    judge = Told(changes, loses)
    out = replace_constant(
        {"roughness": rough}, EVERYWHERE, judge, None if start is None else {"roughness": start}
    )
    assert (not np.ndim(out["roughness"])) is constant
    assert len(judge.asked) == (spread * STEP < NOISE)
    other = Told(0.0, 0.0, channels=("red",))  # draws no other roughness
    assert np.ndim(replace_constant({"roughness": rough}, EVERYWHERE, other)["roughness"])


class OnlyRoughness(Told):
    """A judge to whom colours matter."""

    def change(self, maps: dict) -> float:
        self.asked.append(maps)
        return 0.0 if np.ndim(maps["red"]) else 1.0


def test_all_together_first_then_one_by_one() -> None:
    noise = ramp(-6 * STEP, 6 * STEP)
    maps = {
        **dict.fromkeys(COLORS, srgb_to_linear(0.5 + noise)),
        "roughness": 0.6 + noise,
        "metalness": 0.3 + noise,
    }
    everything = Told(0.0, 0.0, channels=tuple(maps))
    assert not any(np.ndim(v) for v in replace_constant(maps, EVERYWHERE, everything).values())
    assert len(everything.asked) == 1
    picky = OnlyRoughness(0.0, 0.0, channels=tuple(maps))
    out = replace_constant(maps, EVERYWHERE, picky)
    assert [np.ndim(out[n]) for n in maps] == [2, 2, 2, 0, 0]
    assert len(picky.asked) == 4


def grey_ball() -> Asset:
    p, faces, _ = grid_sphere(16, 24)
    lumps = 1 + 0.1 * np.sin(7 * p[:, :1]) * np.sin(6 * p[:, 1:2])
    material = Material(base_color=(0.5, 0.5, 0.5), roughness=0.6)
    return Asset((Mesh((p * lumps).astype(np.float32), faces, material=material),), "grey")


def test_a_fit_of_a_grey_thing_writes_no_colour_maps(tmp_path: Path) -> None:
    options = appearance_opt.simplify_options(
        triangles=200, steps=8, texture_size=64, resolution=48, views=2, pool=2
    )
    result = appearance_opt.simplify(grey_ball(), tmp_path / "x.glb", options)
    m = result.asset.meshes[0].material
    assert m.base_color_texture is None and m.orm_texture is None and m.normal_texture is not None
    np.testing.assert_allclose(
        [*m.base_color, m.roughness, m.metalness], [0.5, 0.5, 0.5, 0.6, 0], atol=0.03
    )
    noise = np.random.default_rng(0).integers(186, 191, (64, 64, 3)).astype(np.uint8)
    map_of_it = replace(m.normal_texture, pixels=noise, color_space="srgb")
    save(
        Asset(
            (replace(result.asset.meshes[0], material=replace(m, base_color_texture=map_of_it)),)
        ),
        tmp_path / "y.glb",
    )
    assert (tmp_path / "x.glb").stat().st_size < (tmp_path / "y.glb").stat().st_size - 3000


def test_pictures_measure_what_changes() -> None:
    """A step more of roughness changes little, black instead of grey a lot, and is a loss; the
    truth is a gain."""
    asset = grey_ball()
    reference = MeshReference(asset)
    mesh = asset.meshes[0]
    used, corners = np.unique(mesh.faces, return_inverse=True)
    faces = corners.reshape(-1, 3).astype(np.int32)
    uvs = np.zeros((len(used), 2), np.float32)
    latent = LatentMesh(mesh.positions[used], faces, np.arange(len(used)), faces, uvs)
    grey = {**dict.fromkeys(COLORS, 0.4), "roughness": 0.6, "metalness": 0.0}
    maps = {n: np.full((16, 16), v, np.float32) for n, v in grey.items()}
    model = latent_of(latent, maps, frozenset({"material"}), Rates())
    judge = Pictures(model, reference, views_around(mesh.positions, 0), 32)
    assert judge.change(maps) == 0 and judge.loss(maps) == 0
    assert 0 < judge.change({**maps, "roughness": 0.6 + STEP / 4}) < STEP
    assert judge.change({**maps, **dict.fromkeys(COLORS, 0.1)}) > 20 * STEP
    assert judge.loss({**maps, **dict.fromkeys(COLORS, 0.1)}) > 3
    assert judge.loss({**maps, **dict.fromkeys(COLORS, 0.5)}) < -3
