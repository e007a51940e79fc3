"""convert sdf: the whole job, small, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import appearance_opt as ao
from appearance_opt import sdf
from appearance_opt.jobs.convert import convert
from appearance_opt.stages.unreached import describe, share_off
from tests.test_cli import run

QUICK = {"reallocate": 0, "texture_size": 64, "resolution": 48, "pool": 8, "views": 2, "steps": 4}
WORDS = [
    "--reallocate",
    "0",
    "--texture-size",
    "64",
    "--resolution",
    "48",
    "--pool",
    "8",
    "--views",
    "2",
    "--steps",
    "4",
]
RING = """
from appearance_opt import sdf

def distance(p):
    return sdf.torus(sdf.translate(p, (10, 0, 0)), 2.0, 0.7)

def material(p):
    return sdf.Material(sdf.mix((0.8, 0.2, 0.1), (0.1, 0.2, 0.8), sdf.step(10, p.x, 1)), 0.4)

scene = sdf.Shape(distance, ((7, -1, -3), (13, 1, 3)), material)

def make():
    return scene

number = 5
"""


@pytest.fixture
def ring(tmp_path: Path) -> Path:
    (tmp_path / "ring.py").write_text(RING)
    return tmp_path / "ring.py"


def off_ring(asset: ao.Asset) -> np.ndarray:
    p = np.concatenate([m.positions for m in asset.meshes]).astype(np.float64) + asset.origin
    return np.abs(np.hypot(np.hypot(p[:, 0] - 10, p[:, 2]) - 2.0, p[:, 1]) - 0.7)


def test_a_function_becomes_a_textured_mesh(ring: Path, tmp_path: Path) -> None:
    out = tmp_path / "ring.glb"
    done = run("convert", "sdf", f"{ring}:make", "--triangles", "600", "--out", str(out),
               "--no-report", *WORDS)  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = ao.load(out)
    assert 500 < result.triangle_count <= 600
    assert off_ring(result).mean() < 0.002 * np.linalg.norm((5.4, 1.4, 5.4))
    texture = result.meshes[0].material.base_color_texture
    assert texture is not None and texture.pixels.shape[:2] == (64, 64)
    red = texture.linear()[..., 0]
    assert red.min() < 0.2 and red.max() > 0.6


def test_a_shape_of_python_may_start_from_a_sphere() -> None:
    ball = sdf.Shape(lambda p: sdf.sphere(p, 1.5), ((-2,) * 3, (2,) * 3))
    result = convert("sdf", ball, None, triangles=200, init="sphere", **QUICK)
    assert result.triangles <= 200 and result.fit.steps > 0
    assert result.title.startswith("Shape: ")


def test_holes_that_a_sphere_does_not_get_to_are_told_of() -> None:
    ring = sdf.Shape(lambda p: sdf.torus(p, 0.7, 0.25), ((-1, -0.3, -1), (1, 0.3, 1)))
    notes = convert("sdf", ring, None, triangles=200, init="sphere", **QUICK).notes
    assert any("of the silhouette are off" in n and "--init marching-cubes" in n for n in notes)
    ball = np.hypot(*(np.mgrid[:64, :64] - 31.5)) < 20
    assert share_off(ball[None], ball[None]) == 0.0
    assert share_off(ball[None], np.roll(ball, 1, 0)[None]) == 0.0  # an outline a little off
    holed = ball & (np.hypot(*(np.mgrid[:64, :64] - 31.5)) > 6)
    assert 0.003 < share_off(ball[None], holed[None]) < 0.1
    assert describe(0.0, True) == [] and "from a mesh" in describe(0.1, False)[0]


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("nothing.py:scene", "there is no such file"),
        ("ring.glb", "is no distance field; give FILE.py:NAME or FILE.npz"),
        ("ring.py:other", "has no 'other'; it has sdf, distance, material, scene"),
        ("ring.py:number", "has no distance; make it"),
        ("ring.py:distance", "TypeError"),
        ("broken.py:scene", "broken.py:2: ZeroDivisionError: division by zero"),
        ("syntax.py:scene", "syntax.py:1: SyntaxError"),
        ("boundless.py:scene", "two points"),
    ],
)
def test_files_that_hold_no_shape_are_refused(
    source: str, words: str, ring: Path, tmp_path: Path
) -> None:
    (tmp_path / "broken.py").write_text("x = 0\nscene = 1 / x\n")
    (tmp_path / "syntax.py").write_text("scene = = 5\n")
    (tmp_path / "boundless.py").write_text(RING + "scene = sdf.Shape(distance, (1, 2))\n")
    with pytest.raises(ao.AppearanceError, match=words) as refused:
        convert("sdf", str(tmp_path / source), tmp_path / "out.glb", triangles=100)
    assert "\n" not in str(refused.value) and not (tmp_path / "out.glb").exists()


def test_the_command_line_refuses_in_one_line(ring: Path, tmp_path: Path) -> None:
    out = str(tmp_path / "out.glb")
    for arguments, words in (
        (("mesh", str(ring), "--triangles", "100"), "choose from sdf"),
        (("sdf", f"{ring}:other", "--triangles", "100"), "has no 'other'"),
        (("sdf", str(ring)), "give --triangles N"),
        (
            ("sdf", str(ring), "--triangles", "100", "--init", "decimate"),
            "marching-cubes, hull, sphere",
        ),
    ):
        done = run("convert", *arguments, "--out", out)
        assert done.returncode == 2 and words in done.stderr, done.stderr
        assert done.stderr.strip().splitlines()[-1].startswith("error: ")
        assert "Traceback" not in done.stderr
