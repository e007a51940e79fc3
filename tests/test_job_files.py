"""What jobs write: never over what they read, and what a resumed run goes on from."""

from __future__ import annotations

import json
import shutil
import stat
from pathlib import Path

import numpy as np
import pytest

import appearance_opt
from appearance_opt.asset import load, save
from appearance_opt.asset.types import Asset
from appearance_opt.config import (
    BakeOptions,
    SimplifyOptions,
    bake_options,
    joint_options,
    read_toml,
    simplify_options,
)
from appearance_opt.errors import InputError
from appearance_opt.stages import decimated
from scenes.analytic import two_materials

QUICK = {"texture_size": 64, "resolution": 32, "pool": 8, "views": 2, "budget": None}


def quick(**values: object) -> SimplifyOptions:
    return simplify_options(**{"triangles": 200, "steps": 2, **QUICK, **values})


def contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


@pytest.mark.parametrize("suffix", [".obj", ".gltf"])
def test_files_that_the_input_refers_to_are_not_replaced(
    ball: Asset, suffix: str, tmp_path: Path
) -> None:
    """Saved under another name, so that its material file, buffer and pictures have the name of the
    result."""
    save(ball, tmp_path / f"chair{suffix}")
    source = tmp_path / f"heavy{suffix}"
    shutil.move(tmp_path / f"chair{suffix}", source)
    before = contents(tmp_path)
    assert len(before) > 2
    with pytest.raises(InputError, match=r"could replace '.*chair.*', which the input refers to"):
        appearance_opt.simplify(source, tmp_path / f"chair{suffix}", quick())
    assert contents(tmp_path) == before
    appearance_opt.simplify(source, tmp_path / "chair.glb", quick(steps=0))
    assert contents(tmp_path).items() >= before.items()


def test_the_start_is_not_replaced(ball: Asset, tmp_path: Path) -> None:
    save(two_materials(100), tmp_path / "low.glb")
    with pytest.raises(InputError, match="is the input itself"):
        appearance_opt.simplify(
            ball, tmp_path / "low.glb", quick(triangles=None, init=str(tmp_path / "low.glb"))
        )


def test_loose_maps_do_not_replace_those_of_low(ball: Asset, tmp_path: Path) -> None:
    save(ball, tmp_path / "low.obj")
    picture = tmp_path / "low_0_painted_base_color.png"
    options = bake_options(closed_form=True, unwrap=True, texture_size=64)
    with pytest.raises(InputError, match=f"could replace '.*{picture.name}'"):
        appearance_opt.bake(
            ball, tmp_path / "low.obj", tmp_path / "new" / "low.glb", options, loose=tmp_path
        )
    with pytest.raises(InputError):
        appearance_opt.bake(ball, tmp_path / "low.obj", tmp_path / "b.glb", options, loose=picture)


def test_a_resumed_run_goes_on_from_the_same_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """How often triangles are moved follows from the time that is left: a resumed run may have less
    of it."""
    heavy, rounds = two_materials(2000), iter([1, 0])
    monkeypatch.setattr(decimated, "affordable", lambda *_: next(rounds))
    monkeypatch.setattr(decimated, "WORTHWHILE", 0.0)
    first = appearance_opt.simplify(heavy, None, quick(), checkpoint=tmp_path)
    again = appearance_opt.simplify(heavy, None, quick(), checkpoint=tmp_path, resume=True)
    assert next(rounds) == 0  # the start was not made again
    for a, b in zip(first.asset.meshes, again.asset.meshes, strict=True):
        np.testing.assert_array_equal(a.faces, b.faces)
        np.testing.assert_array_equal(a.positions, b.positions)


def test_a_state_of_another_start_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same job, whose start came out otherwise, as it may where time is short: as many
    vertices, elsewhere."""
    heavy, rounds = two_materials(2000), iter([1, 0])
    monkeypatch.setattr(decimated, "affordable", lambda *_: next(rounds))
    monkeypatch.setattr(decimated, "WORTHWHILE", 10.0)
    for folder in ("a", "b"):
        appearance_opt.simplify(heavy, None, quick(), checkpoint=tmp_path / folder)
    shutil.copy(tmp_path / "b" / "start.npz", tmp_path / "a" / "start.npz")
    with pytest.raises(InputError, match=r"fit\.npz: this checkpoint belongs to another start"):
        appearance_opt.simplify(heavy, None, quick(), checkpoint=tmp_path / "a", resume=True)


def test_reports_are_json_in_a_folder_that_keeps_its_permissions(
    ball: Asset, tmp_path: Path
) -> None:
    folder = tmp_path / "report"
    folder.mkdir(mode=0o700)
    appearance_opt.simplify(ball, None, quick(), report=folder)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700

    def no_constant(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    curve = json.loads((folder / "report.json").read_text(), parse_constant=no_constant)["curve"]
    assert curve[0]["loss"] is None and curve[-1]["loss"] > 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("fit = 3", "--fit 3: write names"),
        ("fit = [1]", "--fit .1.: write names"),
        ("fit = ''", "--fit : must be some of"),
        ("fit = 'gamma'", "--fit gamma: choose from shape, normal, material"),
        ("preset = 5", "--preset 5: choose from draft"),
        ("budget = true", "is not a time"),
        ("budget = [1]", "is not a time"),
        ("seed = -1", "--seed -1: must be 0 or more"),
        ("background = 'nan,0,0'", "--background nan,0,0"),
        ("laplacian = inf", "--laplacian inf: is not a number"),
        (
            "displacement_rate = 0.1",
            "--displacement-rate 0.1: must be given together with --displacement",
        ),
    ],
)
def test_nonsense_in_a_job_file_is_refused(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "job.toml").write_text(text + "\n")
    values = {"triangles": 100, **read_toml(tmp_path / "job.toml")}
    preset = values.pop("preset", "default")
    with pytest.raises(InputError, match=words):
        simplify_options(preset, **values)


@pytest.mark.parametrize(
    "values",
    [
        {"hit": "outermost"},
        {"bits": 16},
        {"maps": "normal"},
        {"maps": "normal,material,ao"},
        {"green": "directx"},
    ],
)
def test_what_a_joint_bake_ignores_is_refused(values: dict) -> None:
    with pytest.raises(InputError):
        joint_options(**values)
    assert isinstance(bake_options(**values), BakeOptions)


def test_a_joint_bake_has_its_own_function() -> None:
    with pytest.raises(InputError, match=r"appearance_opt\.joint"):
        bake_options(joint=True)
    assert appearance_opt.joint.__module__ == "appearance_opt.jobs.joint"


def test_comparisons_name_devices_that_do_not_exist(ball: Asset) -> None:
    with pytest.raises(InputError, match="--device gpu: choose from auto, cpu, cuda"):
        appearance_opt.compare(ball, ball, device="gpu")


def test_files_of_an_asset_are_known(tmp_path: Path) -> None:
    save(two_materials(100), tmp_path / "a.gltf")
    names = {p.name for p in load(tmp_path / "a.gltf").files}
    assert {"a.gltf", "a.bin"} <= names
