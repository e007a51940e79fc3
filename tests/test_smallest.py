"""The fewest triangles that keep within a bound: the search, its certificate, and refusals."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import load
from appearance_opt.config import simplify_options
from appearance_opt.errors import BoundError, InputError
from appearance_opt.jobs import smallest
from appearance_opt.jobs.simplify import for_size, simplify
from appearance_opt.jobs.smallest import TRIALS, certify, guess, most_of
from appearance_opt.options.bound import Bound, parse_bound
from appearance_opt.stages.search import SAFETY, SLOPE, Trial, bracket, next_count
from tests.conftest import make_asset

LIMIT = 0.5


@pytest.mark.parametrize("power", [-0.35, -0.6, -1.0, -1.4])
@pytest.mark.parametrize("answer", [60, 700, 9000])
def test_a_search_finds_the_fewest_within_a_quarter(power: float, answer: int) -> None:
    """Errors that go with any power of the triangles, whatever the search supposes of them."""
    trials: list[Trial] = []
    while len(trials) < TRIALS:
        count = next_count(trials, SAFETY * LIMIT, 100_000, 1000, -1.0)
        if count is None:
            break
        trials.append(Trial(count, SAFETY * LIMIT * (count / answer) ** power))
    enough, _ = bracket(trials, SAFETY * LIMIT)
    assert enough is not None
    assert enough.triangles <= 1.25 * answer


def test_a_search_ends_at_its_ends() -> None:
    never = next_count([Trial(100, 1.0)], LIMIT, 100, 50, -1.0)
    assert never is None  # no more triangles are there
    assert next_count([Trial(4, 0.1)], LIMIT, 100, 50, -1.0) is None
    assert next_count([Trial(110, 0.4), Trial(100, 0.6)], LIMIT, 1000, 50, -1.0) is None
    between = next_count([Trial(400, 0.4), Trial(100, 1.6)], LIMIT, 1000, 50, -1.0)
    assert between is not None
    assert 100 < between < 400


def test_a_search_never_tries_a_number_twice_however_errors_jump() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        trials: list[Trial] = []
        while len(trials) < 20:
            count = next_count(trials, LIMIT, 5000, 300, SLOPE["flip"])
            if count is None:
                break
            assert 4 <= count <= 5000
            assert count not in {t.triangles for t in trials}
            trials.append(Trial(count, float(rng.uniform(0.01, 2.0))))


def test_one_view_of_twenty_four_may_exceed_a_bound() -> None:
    errors = np.full(24, 0.4)
    errors[3] = 0.9
    assert most_of(errors) == 0.4
    met = certify(errors, Bound("silhouette_shift", 0.5), 256)
    assert met.met
    assert met.within == pytest.approx(23 / 24)
    assert met.value == pytest.approx(errors.mean())
    assert met.standard_error == pytest.approx(errors.std(ddof=1) / np.sqrt(24))
    errors[4] = 0.7
    short = certify(errors, Bound("silhouette_shift", 0.5), 256)
    assert not short.met
    assert short.short_by == pytest.approx(0.2)
    assert "short by" in short.describe()


def test_of_psnr_more_is_better() -> None:
    values = np.full(24, 36.0)
    values[:2] = 33.0
    found = certify(values, parse_bound("psnr=35"), 64)
    assert not found.met
    assert found.short_by == pytest.approx(2.0)
    assert certify(np.full(24, 36.0), parse_bound("psnr=35"), 64).met


def test_the_first_number_grows_with_the_size_and_the_bound() -> None:
    px = [guess(Bound("silhouette_shift", e), p, 10**6) for e, p in ((1, 256), (0.5, 256))]
    assert px[1] == 2 * px[0]
    assert guess(Bound("flip", 0.02), 128, 10**6) == guess(Bound("flip", 0.02), 256, 10**6) / 2
    assert guess(Bound("flip", 0.02), 256, 100) == 50


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"max_error": "0.5px", "triangles": 10}, "leave --triangles, --ratio out"),
        ({"max_error": "0.5px", "init": "sphere"}, "works with --init decimate"),
        ({"strict": True, "triangles": 10}, "--strict needs --max-error"),
        ({"max_error": "half"}, "write a bound such as"),
        ({"max_error": "psnr=0"}, "must be above 0"),
        ({"triangles": 10, "pixels": 2}, "--pixels 2: must be from 4 to 8192"),
        ({}, "--max-error BOUND"),
    ],
)
def test_what_contradicts_itself_is_refused(values: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        simplify_options(**values)


def test_a_size_is_that_of_the_views() -> None:
    assert for_size(simplify_options(triangles=10, pixels=64)).views.resolution == 64
    assert for_size(simplify_options(triangles=10, pixels=4)).views.resolution == 16
    assert for_size(simplify_options(triangles=10)).views.resolution == 256


SMALL = {"pixels": 32, "texture_size": 64, "steps": 1, "pool": 4, "reallocate": 0}


def certificate_in(path: Path) -> dict:
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length])["asset"]["extras"]["appearance_opt"]["certificate"]


def test_the_result_says_how_well_its_bound_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(smallest, "TRIALS", 2)
    out = tmp_path / "ball.glb"
    result = simplify(make_asset(12, 24), out, max_error="3px", **SMALL)
    told = result.facts["certificate"]
    assert told["met"]
    assert told["views"] == 24
    assert result.triangles < 200
    assert certificate_in(out) == told
    again = simplify(load(out), None, ratio=0.9, **SMALL)  # of which nothing is certified
    assert again.asset.credits.extras is None


def test_a_bound_that_cannot_be_met_is_an_error_with_strict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(smallest, "TRIALS", 2)
    out = tmp_path / "a.glb"
    with pytest.raises(BoundError, match="psnr=80 is not met"):
        simplify(make_asset(4, 6), out, max_error="psnr=80", strict=True, **SMALL)
    told = certificate_in(out)  # of the best that was reached
    assert not told["met"]
    assert told["short_by"] > 0


def test_a_search_without_time_hands_out_its_first_start() -> None:
    result = simplify(
        make_asset(12, 16), None, max_error="2px", **{**SMALL, "steps": None, "budget": 0.01}
    )
    assert result.fit.steps == 0
    assert result.facts["certificate"]["views"] == 24
