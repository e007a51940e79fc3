"""Factors that are no numbers never reach a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from appearance_opt.asset import load
from appearance_opt.asset.types import Asset, Material, Volume
from appearance_opt.asset.validate import repair
from appearance_opt.errors import InputError


@pytest.mark.parametrize(
    "change",
    [
        {"emission": (0.0, float("nan"), 0.0)},
        {"opacity": float("inf")},
        {"alpha_cutoff": float("nan")},
        {"transmission": float("nan")},
        {"ior": float("inf")},
        {"volume": Volume(float("nan"))},
        {"volume": Volume(0.1, float("nan"))},
    ],
)
def test_factors_that_are_no_numbers_are_refused(ball: Asset, change: dict) -> None:
    bad = replace(ball.meshes[0], material=replace(Material("m"), **change))
    with pytest.raises(InputError, match=r"x\.glb, material 'm': a factor is NaN or infinite"):
        repair(Asset((bad,)), "x.glb")


def test_emission_of_an_mtl_file_that_is_no_number(tmp_path: Path) -> None:
    (tmp_path / "x.mtl").write_text("newmtl m\nKe nan nan nan\n")
    (tmp_path / "x.obj").write_text("mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
    with pytest.raises(InputError, match="a factor is NaN"):
        load(tmp_path / "x.obj")


def test_negative_emission_is_mended_and_what_exceeds_one_stays(ball: Asset) -> None:
    bad = replace(ball.meshes[0], material=Material("m", emission=(-1.0, 3.0, 0.0)))
    out = repair(Asset((bad,)), "x.glb")
    assert out.meshes[0].material.emission == (0.0, 3.0, 0.0)
    assert "material 'm': negative emission set to 0" in out.notes
