"""convert scene, images and command: whole jobs, small, what is kept of them, what they refuse."""

from __future__ import annotations

import json
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import appearance_opt as ao
from appearance_opt import backend
from appearance_opt.config import convert_options
from appearance_opt.errors import InputError, ReferenceRenderError
from appearance_opt.reference.album import Album, Numbered, averaging
from appearance_opt.reference.image_open import open_scene
from appearance_opt.reference.plugins import MINIMUM_LLVM
from appearance_opt.stages.fitting import FEWEST, paced
from appearance_opt.stages.run import Run
from appearance_opt.views import VALIDATION, ViewSampler
from scenes.shoot import shoot
from tests.test_cli import run
from tests.test_fit_to_references import RADIUS, Ball, radii

QUICK = {"texture_size": 32, "resolution": 32, "pool": 8, "views": 2, "triangles": 100, "steps": 6}
QUICK |= {"preset": "draft", "budget": None}
RAYCAST = Path(__file__).parents[1] / "scenes" / "raycast.py"


def extras(path: Path) -> dict:
    data = path.read_bytes()
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


class Counting(Ball):
    def __init__(self) -> None:
        self.drawn = 0

    def render(self, views, resolution, samples=16):  # type: ignore[no-untyped-def]
        self.drawn += len(views)
        return super().render(views, resolution, samples)


@pytest.mark.parametrize("light", ["static", "point"])
def test_pictures_become_a_mesh(tmp_path: Path, light: str) -> None:
    shoot(Ball(), tmp_path / "shots", 18, 40, light)
    out = tmp_path / "ball.glb"
    result = ao.convert("images", tmp_path / "shots", out, **QUICK)
    assert 0 < result.triangles <= 100
    assert np.median(radii(result.asset)) == pytest.approx(RADIUS, rel=0.1)  # from the hull
    (mesh,) = result.asset.meshes
    assert mesh.material.unlit == (light == "static")
    about = extras(out)["asset"]
    assert ("baked" in about.get("extras", {}).get("lighting", "")) == (light == "static")
    assert any("baked" in note for note in result.notes) == (light == "static")


def test_a_program_is_asked_and_its_images_are_kept(tmp_path: Path) -> None:
    words = [sys.executable, str(RAYCAST)]
    folder = tmp_path / "kept"
    quick = {**QUICK, "init": "sphere", "steps": 4}
    first = ao.convert("command", shlex.join(words), None, checkpoint=folder, unlit=True, **quick)
    assert first.asset.meshes[0].material.unlit and any("--unlit" in n for n in first.notes)
    there = {p.name: p.stat().st_mtime_ns for p in (folder / "images").iterdir()}
    assert there
    again = ao.convert(
        "command", shlex.join(words), None, checkpoint=folder, unlit=True, resume=True, **quick
    )
    assert {p.name: p.stat().st_mtime_ns for p in (folder / "images").iterdir()} == there
    np.testing.assert_array_equal(again.asset.points(), first.asset.points())
    with pytest.raises(InputError, match="resume needs"):
        ao.convert("command", "x", None, resume=True, **quick)


def test_a_scene_becomes_a_mesh(tmp_path: Path, variant: str) -> None:
    if variant == backend.CPU and dr.detail.llvm_version()[0] < MINIMUM_LLVM:
        pytest.skip("Mitsuba's plugins need a newer LLVM")
    scene = {"type": "scene", "i": {"type": "direct"}, "ball": {"type": "sphere"}}
    loaded = mi.load_dict({**scene, "sky": {"type": "constant"}})
    result = ao.convert("scene", loaded, None, paths=4, init="sphere", **QUICK)
    assert result.asset.meshes[0].material.unlit
    lit = convert_options(**QUICK, lighting="views")
    assert not open_scene(loaded, lit).subject.unlit
    assert open_scene(loaded, replace(lit, source=replace(lit.source, unlit=True))).subject.unlit


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["scene", "none.xml"], "no such file"),
        (["images", "none/transforms.json"], "no such file"),
        (["command", "no-such-program"], "cannot be started"),
        (["command", f"{sys.executable} -c pass"], "exit code 0"),
        (["film", "x"], "film"),
    ],
)
def test_what_is_refused_writes_nothing(tmp_path: Path, words: list[str], message: str) -> None:
    out = tmp_path / "out.glb"
    done = run("convert", *words, "--triangles", "100", "--out", str(out), "--no-report")
    assert done.returncode == 2
    error = done.stderr.strip().splitlines()[-1]
    assert error.startswith("error: ") and message in error
    assert not out.exists()


def test_what_breaks_in_the_middle_writes_nothing(tmp_path: Path) -> None:
    program = RAYCAST.read_text().replace(
        "    request = json.loads(line)",
        "    request = json.loads(line)\n    if request['views'][0]['id'] > 20: sys.exit('burnt out')",
    )
    (tmp_path / "broken.py").write_text(program)
    out = tmp_path / "out.glb"
    with pytest.raises(ReferenceRenderError, match=r"view 21: the program ended .*burnt out"):
        ao.convert("command", [sys.executable, str(tmp_path / "broken.py")], out, **QUICK)
    assert list(tmp_path.iterdir()) == [tmp_path / "broken.py"]


def test_an_album_renders_a_view_once(tmp_path: Path) -> None:
    ball = Counting()
    album = Album(ball, 24, tmp_path, "job")
    views = ViewSampler(tuple(Ball.bounds.mean(axis=0)), 0.5).draw(0, 3)
    large, small = album.render(views, 24, 4), album.render(views, 8, 4)
    assert ball.drawn == 3 and album.has(views) == 3
    np.testing.assert_allclose(small, large.reshape(3, 8, 3, 8, 3, 4).mean(axis=(2, 4)), atol=1e-3)
    assert album.render(views, 48).shape == (3, 48, 48, 4) and ball.drawn == 6  # finer ones anew
    later = Album(ball, 24, tmp_path, "job")
    np.testing.assert_array_equal(later.render(views, 24), large)
    assert ball.drawn == 6
    assert Album(ball, 24, tmp_path, "another job").has(views) == 0
    next(tmp_path.glob("*.npy")).write_bytes(b"cut short")
    assert Album(ball, 24, tmp_path, "job").render(views, 24).shape == (3, 24, 24, 4)
    assert ball.drawn == 7
    weights = averaging(5, 3)
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(weights.sum(axis=0), 3 / 5, rtol=1e-6)


def test_stages_that_draw_differently_see_the_same_views() -> None:
    numbered = Numbered(ViewSampler((0.0, 0.0, 0.0), 1.0, seed=4))
    by_three = np.concatenate([numbered.draw(k, 3).eye for k in range(8)])
    by_eight = np.concatenate([numbered.draw(k, 8).eye for k in range(3)])
    np.testing.assert_array_equal(by_three, by_eight)
    assert len(np.unique(by_three[:, 0])) == 24
    assert (numbered.held_out(VALIDATION).draw(0, 24).eye != by_eight).any()


def test_slow_images_are_seen_more_often_where_time_is_short() -> None:
    ball = Counting()
    album = Album(ball, 256)
    sampler = Numbered(replace(ViewSampler((0.0, 0.0, 0.0), 1.0), hull=None))
    album._seconds, album._rendered = 10.0, 10
    assert paced(album, sampler, 4, 4, 256, Run(budget=None)) == (4, 8)
    assert paced(album, sampler, 4, 4, 256, Run(budget=300.0)) == (40, FEWEST)
    album._seconds = 0.01
    assert paced(album, sampler, 4, 4, 256, Run(budget=300.0)) == (4, 8)
    assert paced(ball, sampler, 4, 4, 256, Run(budget=300.0)) == (4, 8)
