"""Views of different purposes share none."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import pytest

import appearance_opt
from appearance_opt.asset.types import Asset
from appearance_opt.config import simplify_options
from appearance_opt.views import FIT, MEASURED, START, VALIDATION, VISIBILITY, Views, ViewSampler


def test_results_are_measured_in_views_that_decided_nothing(
    ball: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job with moved triangles, and its report: the report's views chose neither the start nor
    the best state."""
    seen: dict[int, set[bytes]] = defaultdict(set)
    whole = ViewSampler.draw

    def draw(self: ViewSampler, iteration: int, count: int) -> Views:
        views = whole(self, iteration, count)
        seen[self.stream] |= {eye.tobytes() for eye in views.eye}
        return views

    monkeypatch.setattr(ViewSampler, "draw", draw)
    options = simplify_options(
        triangles=200,
        texture_size=64,
        resolution=48,
        pool=16,
        views=2,
        steps=4,
        budget=None,
        reallocate=1,
    )
    appearance_opt.simplify(ball, tmp_path / "low.glb", options, report=tmp_path / "report")
    assert set(seen) == {FIT, VALIDATION, VISIBILITY, START, MEASURED}
    assert all(len(views) > 1 for views in seen.values())
    assert sum(map(len, seen.values())) == len(set.union(*seen.values()))
