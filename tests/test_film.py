"""Films and charts of a report: files that players read, frames that follow the character."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import numpy as np
import pytest

from appearance_opt.asset.rig import Skin
from appearance_opt.evaluate.chart import Chart, chart_svg
from appearance_opt.evaluate.film import encode_film
from appearance_opt.evaluate.motion import Motion, bone_colors, show_motion
from appearance_opt.evaluate.report import ReportData, page
from scenes.creature import creature


def _stills(film: bytes) -> list:
    image = pytest.importorskip("PIL.Image").open(io.BytesIO(film))
    out = []
    for k in range(image.n_frames):
        image.seek(k)
        image.load()
        out.append((np.asarray(image.convert("RGB")).astype(int), image.info["duration"]))
    return out


def test_films_are_read_by_others() -> None:
    """Frames come back without loss, in order; their durations add up to the clip's."""
    frames = [np.full((17, 30, 3), (40 * k, 255 - 40 * k, 9), np.uint8) for k in range(5)]
    stills = _stills(encode_film(frames, 24.0, None))
    assert len(stills) == 5
    for (seen, _), frame in zip(stills, frames, strict=True):
        assert np.abs(seen - frame).max() == 0
    assert sum(duration for _, duration in stills) == round(5 * 1000 / 24)


def test_charts_have_a_line_for_each_name() -> None:
    lines = {"a<b": [(0.0, 1.0), (2.0, 3.0)], "c": [(0.0, 2.0), (2.0, 2.0)]}
    svg = chart_svg(Chart("", "", "x", "y", lines, ticks={0.0: "x&y"}, linear=True))
    assert svg.count("<polyline") == 2
    assert "a&lt;b" in svg and "x&amp;y" in svg
    places = [re.findall(r"[\d.]+,[\d.]+", p) for p in re.findall(r'points="([^"]*)"', svg)]
    first = [tuple(map(float, p.split(","))) for p in places[0]]
    assert first[0][0] < first[1][0] and first[0][1] > first[1][1]  # up is larger


def test_bones_next_to_each_other_have_colours_that_differ() -> None:
    colors = bone_colors(60)
    assert np.abs(np.diff(colors, axis=0)).max(axis=1).min() > 0.2
    assert colors.min() >= 0 and colors.max() <= 1


def test_a_film_shows_both_and_where_they_differ() -> None:
    """The same character twice: no difference. With the neck on another bone: some."""
    heavy = creature(800, 16)
    same = show_motion(heavy, heavy, "look", 0.25, ("look 6",), {"result": (40.0,)}, size=32)
    stills = _stills(same.film)
    assert len(stills) == 25  # keys at 24 frames per second, both ends
    assert all(seen.shape == (32, 96, 3) for seen, _ in stills)
    assert max(seen[:, 64:].max() for seen, _ in stills) < 24  # lossy black
    assert min(np.ptp(seen[:, :32]) for seen, _ in stills) > 60
    moved = np.abs(stills[0][0][:, :32] - stills[6][0][:, :32])
    assert moved.max() > 40
    spine = heavy.meshes[0]
    assert spine.skin is not None
    stiff = replace(spine, skin=Skin(spine.skin.bones * 0, spine.skin.weights))
    other = replace(heavy, meshes=(stiff, *heavy.meshes[1:]))
    differs = show_motion(heavy, other, "look", 0.25, ("look 6",), {"result": (9.0,)}, size=32)
    assert max(seen[:, 64:].max() for seen, _ in _stills(differs.film)) > 60
    weights = differs.stills["weights"].astype(int)
    assert np.abs(weights[:, :64] - weights[:, 64:]).max() > 60
    assert differs.worst == ("look 6", 9.0)


def test_pages_hold_the_film_and_the_error_by_frame() -> None:
    film = encode_film([np.zeros((8, 24, 3), np.uint8)] * 2, 24.0)
    motion = Motion("walk <1>", film, 24.0, ("walk 0", "walk 1"), {"result": (30.0, 28.5)})
    motion.stills["worst frame"] = np.zeros((8, 24, 3), np.uint8)
    text = page(ReportData("t", {}, {}, [], motion=motion))
    assert "In motion" in text and "walk &lt;1&gt;" in text and "walk 1: 28.50 dB" in text
    assert "PSNR (dB) against frame" in text
    assert "In motion" not in page(ReportData("t", {}, {}, []))
