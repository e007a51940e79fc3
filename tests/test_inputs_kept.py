"""Inputs are never replaced, whatever they consist of; what cannot be written is refused before any
work."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import appearance_opt
from appearance_opt.asset import load, save
from appearance_opt.asset.types import Asset
from appearance_opt.config import SimplifyOptions, bake_options, simplify_options
from appearance_opt.errors import InputError
from appearance_opt.jobs import paths
from appearance_opt.jobs.paths import Outputs
from appearance_opt.lock import locked
from tests.conftest import make_asset

MESH = """
 def Mesh "m"
 {
  int[] faceVertexCounts = [3, 3]
  int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
  point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 1)]
 }
"""

SCENE = """#usda 1.0
( defaultPrim = "S" )
def Xform "S" (
 variants = { string look = "near" }
 prepend variantSets = "look"
)
{
 asset extra = @extra.png@
 def "shape" ( references = @geo.usda@ ) {}
 variantSet "look" = {
  "near" {
  }
  "far" ( references = @far.usda@ ) {
  }
 }
}
"""


def quick(**values: object) -> SimplifyOptions:
    base = {
        "triangles": 2,
        "steps": 0,
        "texture_size": 32,
        "resolution": 32,
        "pool": 4,
        "views": 2,
        "budget": None,
    }
    return simplify_options(**{**base, **values})


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A stage of layers: one that it shows, one of a variant that is not chosen, and a picture that
    nothing shows."""
    for name in ("geo", "far"):
        (tmp_path / f"{name}.usda").write_text(
            f'#usda 1.0\n( defaultPrim = "G" )\ndef Xform "G"\n{{\n{MESH}}}\n'
        )
    (tmp_path / "scene.usda").write_text(SCENE)
    (tmp_path / "extra.png").write_bytes(b"no picture")
    return tmp_path


def test_files_of_a_stage_are_known(scene: Path) -> None:
    assert {p.name for p in load(scene / "scene.usda").files} == {
        "scene.usda",
        "geo.usda",
        "far.usda",
        "extra.png",
    }


@pytest.mark.parametrize("name", ["geo.usda", "far.usda"])
def test_layers_are_not_replaced(scene: Path, name: str) -> None:
    before = contents(scene)
    with pytest.raises(InputError, match=f"could replace '.*{name}'"):
        appearance_opt.simplify(scene / "scene.usda", scene / name, quick())
    assert contents(scene) == before


def test_packages_are_not_replaced(scene: Path) -> None:
    save(load(scene / "geo.usda"), scene / "geo.usdz")
    (scene / "scene.usda").write_text(SCENE.replace("geo.usda", "geo.usdz"))
    with pytest.raises(InputError, match=r"could replace '.*geo\.usdz'"):
        appearance_opt.simplify(scene / "scene.usda", scene / "geo.usdz", quick())


def test_files_that_nothing_shows_are_known(tmp_path: Path) -> None:
    save(make_asset(4, 8, 16), tmp_path / "a.gltf")
    for name in ("other one.png", "other.bin", "m.png", "n.png"):
        (tmp_path / name).write_bytes(b"x")
    text = json.loads((tmp_path / "a.gltf").read_text())
    text["images"].append({"uri": "other%20one.png"})
    text["buffers"].append({"uri": "other.bin", "byteLength": 1})
    (tmp_path / "a.gltf").write_text(json.dumps(text))
    assert {"other one.png", "other.bin"} <= {p.name for p in load(tmp_path / "a.gltf").files}
    (tmp_path / "a.mtl").write_text(
        "newmtl a\nKd 1 1 1\nnewmtl b\nrefl -type sphere m.png\ndisp -mm 0 1 n.png\n"
    )
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n")
    assert {"a.obj", "a.mtl", "m.png", "n.png"} <= {p.name for p in load(tmp_path / "a.obj").files}


def test_tessellated_levels_do_not_replace_an_input(tmp_path: Path) -> None:
    source = tmp_path / "ball_level1.obj"
    save(make_asset(6, 12, 16), source)
    before = contents(tmp_path)
    options = quick(triangles=8, displacement=True, subdivision=(1,), write_tessellated=True)
    with pytest.raises(InputError, match="is the input itself"):
        appearance_opt.simplify(source, tmp_path / "ball.obj", options)
    with pytest.raises(InputError, match=r"could replace '.*ball_level1\.mtl'"):
        shutil.copy(source, tmp_path / "other.obj")
        appearance_opt.simplify(tmp_path / "other.obj", tmp_path / "ball.obj", options)
    assert contents(tmp_path).items() >= before.items()


def test_reports_do_not_replace_pictures_of_an_input(ball: Asset, tmp_path: Path) -> None:
    save(ball, tmp_path / "a.gltf")
    (tmp_path / "a_0.png").rename(tmp_path / "view0_reference.png")
    (tmp_path / "a.gltf").write_text(
        (tmp_path / "a.gltf").read_text().replace("a_0.png", "view0_reference.png")
    )
    before = contents(tmp_path)
    with pytest.raises(InputError, match=r"could replace '.*view0_reference\.png'"):
        appearance_opt.simplify(
            tmp_path / "a.gltf", tmp_path / "new" / "b.glb", quick(), report=tmp_path
        )
    with pytest.raises(InputError, match=r"could replace '.*view0_reference\.png'"):
        appearance_opt.compare(tmp_path / "a.gltf", ball, out=tmp_path)
    assert contents(tmp_path) == before


def test_files_of_the_start_and_of_the_job_are_not_replaced(ball: Asset, tmp_path: Path) -> None:
    save(make_asset(4, 8, 16), tmp_path / "low.obj")
    shutil.move(tmp_path / "low.obj", tmp_path / "start.obj")
    options = quick(triangles=None, init=str(tmp_path / "start.obj"))
    with pytest.raises(InputError, match=r"could replace '.*low\.mtl'"):
        appearance_opt.simplify(ball, tmp_path / "low.obj", options)
    (tmp_path / "job.glb").write_text("triangles = 5")
    with pytest.raises(InputError, match="is the input itself"):
        appearance_opt.simplify(ball, tmp_path / "job.glb", quick(), inputs=[tmp_path / "job.glb"])


def test_a_link_to_an_input_is_not_replaced(ball: Asset, tmp_path: Path) -> None:
    (tmp_path / "inputs").mkdir()
    save(ball, tmp_path / "inputs" / "a.glb")
    (tmp_path / "out.glb").symlink_to(tmp_path / "inputs" / "a.glb")
    with pytest.raises(InputError, match="is the input itself"):
        appearance_opt.simplify(tmp_path / "inputs" / "a.glb", tmp_path / "out.glb", quick())


def test_names_that_are_too_long_are_refused_before_any_work(tmp_path: Path) -> None:
    for name in ("x" * 248 + ".usda", "x" * 200 + ".obj", "x" * 256):
        with pytest.raises(InputError, match="the name is too long by"):
            Outputs.of(tmp_path / name if "." in name else None, report=tmp_path / name).check()
    Outputs.of(tmp_path / ("x" * 240 + ".glb"), report=tmp_path / ("x" * 240 + ".report")).check()
    assert not list(tmp_path.iterdir())


def test_a_disk_without_room_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paths.shutil, "disk_usage", lambda _: SimpleNamespace(free=1 << 20))
    outputs = Outputs.of(tmp_path / "new" / "x.glb")
    outputs.check_room(100, quick())
    for triangles, options in ((100, quick(texture_size=1024)), (1_000_000, quick())):
        with pytest.raises(InputError, match="and 1 MiB are free on that disk"):
            outputs.check_room(triangles, options)
    levels = quick(displacement=True, subdivision=(3,), write_tessellated=True)
    with pytest.raises(InputError, match="are free"):
        Outputs.of(tmp_path / "x.glb", levels).check_room(200, levels)
    with pytest.raises(InputError, match="are free"):
        Outputs.of(None, report=tmp_path).check_room(0, None)


@pytest.mark.parametrize("shared", ["low.glb", "state", "report"])
def test_a_second_run_into_one_place_says_so(ball: Asset, tmp_path: Path, shared: str) -> None:
    given = {"report": tmp_path / "report", "checkpoint": tmp_path / "state"}
    held = locked(tmp_path / shared, folder=shared != "low.glb")
    with held, pytest.raises(InputError, match=f"{shared}: another run is writing it"):
        appearance_opt.simplify(ball, tmp_path / "low.glb", quick(), **given)
    assert not list(tmp_path.iterdir())


def test_loose_maps_and_result_appear_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from appearance_opt.jobs import bake

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", str(tmp_path / "maps" / "x.png"))

    heavy = make_asset(12, 24, 32)
    options = bake_options(closed_form=True, texture_size=32, unwrap=True)
    monkeypatch.setattr(bake, "_write_loose", full)
    with pytest.raises(OSError, match="No space"):
        appearance_opt.bake(heavy, heavy, tmp_path / "x.gltf", options, loose=tmp_path / "maps")
    assert not list(tmp_path.iterdir())


def test_jobs_that_change_an_input_would_be_noticed(
    ball: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The watch of every test, on a job with a planted fault."""
    from appearance_opt.jobs.result import Result

    save(ball, tmp_path / "a.glb")
    (tmp_path / "beside.txt").write_text("kept")
    write = Result.write
    for name in ("a.glb", "beside.txt"):

        def faulty(result: Result, *given: Any, name: str = name) -> None:
            write(result, *given)
            (tmp_path / name).write_bytes((tmp_path / name).read_bytes() + b"x")

        monkeypatch.setattr(Result, "write", faulty)
        with pytest.raises(AssertionError, match="has changed its input"):
            appearance_opt.simplify(tmp_path / "a.glb", tmp_path / "b.glb", quick(triangles=50))
        save(ball, tmp_path / "a.glb")
