"""Jobs as values: stored, read again, and run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import appearance_opt
from appearance_opt.asset import load, save
from appearance_opt.asset.types import Asset
from appearance_opt.config import JOBS, make_options
from appearance_opt.errors import InputError
from appearance_opt.jobs.spec import JobSpec, run
from tests.test_cli import run as run_command

INPUTS = ("a high.glb", 'b "low" \u00e4\\.usda')


def spec(kind: str, preset: str = "draft", **values: object) -> JobSpec:
    job = JOBS[kind]
    given = {"triangles": 9, **values} if kind in ("simplify", "animate", "convert") else values
    return JobSpec(kind, INPUTS[: len(job.inputs)], "out.glb" if job.writes else None,
                   make_options(job.options, preset, given))  # fmt: skip


@pytest.mark.parametrize("kind", JOBS)
def test_a_job_is_read_as_it_was_written(kind: str, tmp_path: Path) -> None:
    values = {"variant": ("look=worn", "lod=1"), "crease_angle": 0.1, "root": "some\x7fwhere"}
    for given in (spec(kind, **values), spec(kind)):
        assert JobSpec.from_dict(given.as_dict()) == given
        (tmp_path / "job.json").write_text(json.dumps(given.as_dict()))
        (tmp_path / "job.toml").write_text(given.to_toml(), encoding="utf-8")
        assert JobSpec.read(tmp_path / "job.json") == given
        assert JobSpec.read(tmp_path / "job.toml") == given


def test_no_budget_is_written_down(tmp_path: Path) -> None:
    given = spec("simplify", budget=None)
    (tmp_path / "job.toml").write_text(given.to_toml())
    assert JobSpec.read(tmp_path / "job.toml") == given
    assert JobSpec.read(tmp_path / "job.toml").options.fit.budget is None  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('inputs = ["a.glb"]', "--job None: choose from simplify, bake"),
        ('job = "bak"\ninputs = ["a.glb"]', "did you mean 'bake'"),
        ('job = "simplify"\ntriangles = 5', "inputs: must be a list of files"),
        ('job = "bake"\ninputs = ["a.glb"]', "needs HIGH and LOW, not 1"),
        (
            'job = "bake"\ninputs = ["a.glb", "b.glb"]\njoint = true',
            "appearance-opt joint HIGH LOW",
        ),
        ('job = "joint"\ninputs = ["a.glb", "b.glb"]\nmaps = "ao"', "an option of bake"),
        ('job = "simplify"\ninputs = ["a.glb"]\ntriangels = 5', "did you mean 'triangles'"),
        ('job = "simplify"\ninputs = ["a.glb"]\nout = 3\ntriangles = 5', "out: must be"),
    ],
)
def test_nonsense_in_a_job_is_refused(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "job.toml").write_text(text)
    with pytest.raises(InputError, match=words) as refused:
        JobSpec.read(tmp_path / "job.toml")
    assert "job.toml" in str(refused.value)


def test_what_does_not_belong_together_is_refused(ball: Asset) -> None:
    options = make_options(JOBS["inspect"].options, "default", {})
    with pytest.raises(InputError, match="simplify: takes SimplifyOptions, not InspectOptions"):
        JobSpec("simplify", ("a.glb",), None, options)
    with pytest.raises(InputError, match="only jobs whose inputs are files"):
        JobSpec("inspect", (ball,), None, options).as_dict()


def test_a_job_is_run_as_by_its_function(ball: Asset, tmp_path: Path) -> None:
    quick = {"triangles": 200, "texture_size": 64, "resolution": 32, "pool": 4, "steps": 0}
    options = make_options(JOBS["simplify"].options, "draft", quick)
    result = run(JobSpec("simplify", (ball,), str(tmp_path / "low.glb"), options))
    direct = appearance_opt.simplify(ball, None, preset="draft", **quick)
    assert result.triangles == direct.triangles
    assert json.loads(json.dumps(result.record()))["held_out_psnr"][1] > 20
    assert result.lines()[0].startswith(f"{result.triangles} of 2208 triangles, ")
    assert load(tmp_path / "low.glb").triangle_count == result.triangles


def test_a_command_runs_a_job_from_a_file(ball: Asset, tmp_path: Path) -> None:
    save(ball, tmp_path / "ball.glb")
    (tmp_path / "job.toml").write_text('job = "inspect"\ninputs = ["ball.glb"]\n')
    done = run_command("run", "job.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == run_command("inspect", "ball.glb", cwd=tmp_path).stdout
    (tmp_path / "job.toml").write_text('job = "simplify"\ninputs = ["ball.glb"]\nratio = 0.5\n')
    refused = run_command("run", "job.toml", cwd=tmp_path)
    assert (refused.returncode, refused.stderr) == (
        2,
        "error: job.toml: out: must be the name of a file\n",
    )
