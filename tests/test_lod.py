"""Chains of levels of detail: what is asked for, how they are fitted, where they switch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import load
from appearance_opt.config import lod_options
from appearance_opt.errors import InputError
from appearance_opt.evaluate.switching import (
    ErrorAt,
    find_switches,
    on_screen,
    switch_size,
    value_at,
)
from appearance_opt.jobs.lod import lod
from appearance_opt.options.bound import Bound, parse_bound
from appearance_opt.options.chain import ChainOptions
from appearance_opt.stages.levels import plan_shares
from tests.conftest import make_asset

SMALL = {
    "pixels": "64,32,16",
    "triangles": (200, 80, 30),
    "texture_size": 64,
    "steps": 3,
    "pool": 4,
    "reallocate": 0,
    "report": None,
}


def test_sizes_and_budgets_follow_from_the_finest() -> None:
    chain = ChainOptions(levels=3, pixels=(400,), triangles=(1000,))
    assert chain.sizes() == (400, 200, 100)
    assert chain.budgets(5000) == (1000, 500, 250)
    assert ChainOptions(pixels=(512, 128, 32), ratio=(0.1,)).budgets(10_000) == (1000, 250, 62)
    assert ChainOptions(triangles=(90, 40)).budgets(100) == (90, 40)
    assert ChainOptions().budgets(1_000_000) == (8192, 4096, 2048, 1024)
    assert ChainOptions().budgets(1000) == (500, 250, 125, 62)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"pixels": "2"}, "--pixels 2: must be from 4 to 8192"),
        ({"pixels": "9000,10"}, "from 4 to 8192"),
        ({"pixels": "64,64"}, "levels must shrink"),
        ({"triangles": "100,200"}, "levels must shrink"),
        ({"triangles": "100,50", "ratio": "0.5"}, "either --triangles or --ratio"),
        ({"triangles": "100,50", "pixels": "64,32,16"}, "contradict each other"),
        ({"triangles": "100,50", "levels": 3}, "is given for 2 levels"),
        ({"pixels": "16", "levels": 5}, "below 4 pixels"),
        ({"pixels": "a,b"}, "write one number or several"),
        ({"max_error": "1"}, "write a bound such as"),
        ({"max_error": "flip=2"}, "below 1"),
        ({"levels": 1}, "from 2 to 8"),
    ],
)
def test_chains_that_make_no_sense_are_refused(values: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        lod_options(**values)


def test_budgets_that_the_input_cannot_fill_are_refused() -> None:
    with pytest.raises(InputError, match="has only 100"):
        ChainOptions(triangles=(200, 100)).budgets(100)
    with pytest.raises(InputError, match="do not shrink"):
        ChainOptions().budgets(12)


def test_bounds() -> None:
    assert parse_bound("0.5px") == Bound("silhouette_shift", 0.5)
    assert parse_bound("flip=0.02") == Bound("flip", 0.02)
    psnr = parse_bound("psnr=40")
    assert psnr.limit == pytest.approx(0.01)
    assert psnr.value_of(psnr.limit) == pytest.approx(40)
    assert psnr.error(30) > psnr.limit > psnr.error(50)


def curve(*errors: tuple[int, float]) -> list[ErrorAt]:
    return [ErrorAt(p, e, e / 2, 0.0, e / 4) for p, e in errors]


BOUND = Bound("silhouette_shift", 0.5)


def test_a_level_takes_over_where_its_error_falls_under_the_bound() -> None:
    assert switch_size(curve((64, 1.0), (32, 0.5), (16, 0.2)), BOUND) == pytest.approx(32)
    assert switch_size(curve((64, 0.75), (32, 0.25), (16, 0.1)), BOUND) == pytest.approx(
        np.sqrt(64 * 32)
    )
    assert switch_size(curve((64, 0.4), (32, 0.2)), BOUND) == 64
    assert switch_size(curve((64, 0.9), (32, 0.6)), BOUND) is None
    # within the bound at a large size alone does not count
    assert switch_size(curve((64, 0.1), (32, 0.8), (16, 0.2)), BOUND) == pytest.approx(
        2 ** (4 + 0.5)
    )
    assert value_at(curve((64, 1.0), (16, 0.0)), 32, "silhouette_shift") == pytest.approx(0.5)


def test_switches_come_in_order_and_popping_is_that_between_neighbours() -> None:
    fine = curve((64, 0.1), (32, 0.1))
    middle = curve((64, 0.9), (32, 0.1))
    coarse = curve((64, 0.4), (32, 0.1))
    never = curve((64, 3.0), (32, 2.0))
    gap = curve((64, 0.8), (32, 0.4))
    first, second, third = find_switches(
        [fine, middle, coarse, never], [gap, gap, gap], [64, 48, 40, 32], BOUND
    )
    assert first.met
    assert 32 < first.pixels < 64
    assert second.pixels == first.pixels  # never at a larger size than the level before
    assert first.popping == pytest.approx(value_at(gap, first.pixels, "flip"))
    assert not third.met
    assert third.pixels == 32
    assert third.error == 2.0


def test_sizes_in_the_forms_of_engines() -> None:
    screen = on_screen(540.0, 1.0, 2.0, 1.0, 1080)
    assert screen.unreal == pytest.approx(0.5)
    assert screen.unity == pytest.approx(0.25)
    assert screen.coverage == pytest.approx(np.pi * 270**2 / (1080 * 1920))
    # a sphere of 2 m fills half of the height of a view of 75 degrees
    assert screen.godot == pytest.approx(2.0 / np.tan(np.radians(37.5)))


@pytest.mark.parametrize("count", range(2, 9))
def test_the_chain_takes_about_one_and_a_half_times_its_finest_level(count: int) -> None:
    shares = plan_shares(count)
    assert sum(shares) == pytest.approx(1.0)
    assert 1 / shares[0] < 1.65
    assert list(shares) == sorted(shares, reverse=True)


def test_a_chain_of_three(tmp_path: Path) -> None:
    out = tmp_path / "ball.glb"
    result = lod(make_asset(), out, separate_files=True, **SMALL)
    counts = [level.triangle_count for level in result.levels]
    assert counts[0] <= 200 and counts[1] <= 80 and counts[2] <= 30
    assert counts == sorted(counts, reverse=True)
    # maps are as large as what is seen of them
    sizes = [a.meshes[0].material.base_color_texture.pixels.shape[0] for a in result.levels]  # type: ignore[union-attr]
    assert sizes == [64, 32, 16]
    assert [len(c) for c in result.measured.curves] == [3, 3, 3]
    first, second = result.measured.switches
    assert first.pixels >= second.pixels
    for k, count in enumerate(counts):
        assert load(tmp_path / f"ball_lod{k}.glb").triangle_count == count
    assert load(out).triangle_count == counts[0]
    assert result.record()["levels"][1]["screen"]["unreal"] > 0


def test_a_chain_without_time_for_a_fit_is_its_starts() -> None:
    result = lod(make_asset(12, 16), None, **{**SMALL, "steps": None, "budget": 0.01})
    assert [level.fit.steps for level in result.fitted] == [0, 0, 0]
    assert 200 >= result.levels[0].triangle_count > result.levels[2].triangle_count


class Killed(Exception):
    pass


def test_a_killed_chain_goes_on_at_its_level(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from appearance_opt.stages import levels

    folder, made = tmp_path / "kept", []
    real = levels.choose_start

    def choose(*arguments):  # type: ignore[no-untyped-def]
        if len(made) == 1:
            raise Killed
        made.append(arguments)
        return real(*arguments)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(levels, "choose_start", choose)
        lod(make_asset(), None, checkpoint=folder, **SMALL)
    assert (folder / "level0" / "fit.npz").is_file()
    started: list[int] = []
    real_fit = levels.fit_start

    def fit(subject, start, options, run):  # type: ignore[no-untyped-def]
        started.append(options.fit.steps)
        return real_fit(subject, start, options, run)

    monkeypatch.setattr(levels, "fit_start", fit)
    result = lod(make_asset(), None, checkpoint=folder, resume=True, **SMALL)
    assert started[0] == 0 and started[1] > 0  # the finest was complete
    assert result.fitted[0].fit.steps == 3
    with pytest.raises(InputError, match="another input or other options"):
        lod(make_asset(), None, checkpoint=folder, resume=True, **{**SMALL, "seed": 5})
