"""The command line, options, doctor."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest

import appearance_opt
from appearance_opt import backend, config
from appearance_opt.asset import save
from appearance_opt.asset.types import Asset
from appearance_opt.errors import InputError
from tests.inputs import unchanged
from tests.looks import COMMAND, ENVIRONMENT


def run(
    *arguments: str, cwd: Path | None = None, small: bool = False, **environment: str
) -> subprocess.CompletedProcess[str]:
    """``small``: with the small looks of ``tests.looks``. Files in ``cwd`` stay what they are, but
    for the result."""
    start = ["-c", COMMAND] if small else ["-m", "appearance_opt"]
    written = [
        Path(arguments[k + 1]).stem + "*" for k, a in enumerate(arguments[:-1]) if a == "--out"
    ]
    with nullcontext() if cwd is None else unchanged(cwd, *written):
        return subprocess.run(
            [sys.executable, *start, *arguments],
            capture_output=True, text=True, cwd=cwd, env={**ENVIRONMENT, **environment},
        )  # fmt: skip


def test_simplify_and_compare_as_a_user_would(ball: Asset, tmp_path: Path) -> None:
    save(ball, tmp_path / "ball.glb")
    (tmp_path / "job.toml").write_text(
        'texture-size = 64\nresolution = 48\npool = 8\nsteps = 4\nbudget = "2m"\n'
    )
    done = run(
        "simplify",
        "ball.glb",
        "--triangles",
        "150",
        "--out",
        "low.glb",
        "--config",
        "job.toml",
        cwd=tmp_path,
        small=True,
    )
    assert done.returncode == 0, done.stderr
    assert "of 2208 triangles" in done.stdout
    assert (tmp_path / "low.report" / "report.html").is_file()
    assert (
        json.loads((tmp_path / "low.report" / "report.json").read_text())["metrics"]["result"][
            "psnr_covered"
        ]
        > 20
    )
    done = run(
        "compare",
        "ball.glb",
        "low.glb",
        "--json",
        "--views",
        "2",
        "--resolution",
        "64",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["psnr"] > 20


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["simplify", "absent.glb", "--triangles", "10", "--out", "x.glb"],
            "absent.glb: no such file",
        ),
        (["simplify", "ball.glb", "--triangles", "0", "--out", "x.glb"], "at least 1"),
        (["simplify", "ball.glb", "--out", "x.glb"], "--triangles N or --ratio R"),
        (
            ["simplify", "ball.glb", "--triangles", "99999", "--out", "x.glb"],
            "has only 2208 triangles",
        ),
        (["simplify", "ball.glb", "--triangles", "10", "--out", "ball.glb"], "is the input itself"),
        (["simplify", "ball.glb", "--triangles", "10", "--out", "x.fbx"], "cannot write '.fbx'"),
        (["simplify", "ball.glb", "--triangles", "10", "--out", "ball.glb/x.glb"], "not a folder"),
        (["simplify", "ball.glb", "--triangles", "ten", "--out", "x.glb"], "valid integer"),
        (
            ["simplify", "ball.glb", "--triangles", "10", "--out", "x.glb", "--fit", "shap"],
            "did you mean 'shape'",
        ),
        (
            ["simplify", "ball.glb", "--triangles", "10", "--out", "x.glb", "--budget", "soon"],
            "not a time",
        ),
        (
            ["simplify", "ball.glb", "--triangles", "10", "--out", "x.glb", "--config", "bad.toml"],
            "did you mean",
        ),
        (
            ["simplify", "ball.glb", "--triangles", "10", "--out", "x.glb", "--resume"],
            "--checkpoint",
        ),
        (["compare", "ball.glb", "empty.glb"], "empty"),
        (
            ["bake", "ball.glb", "ball.glb", "--joint", "--subdivision", "2", "--out", "x.glb"],
            "write appearance-opt joint HIGH LOW --out OUT",
        ),
        (["nonsense"], "nonsense"),
    ],
)
def test_mistakes_end_in_one_line_and_code_2(
    ball: Asset, tmp_path: Path, arguments: list[str], words: str
) -> None:
    save(ball, tmp_path / "ball.glb")
    before = (tmp_path / "ball.glb").read_bytes()
    (tmp_path / "empty.glb").write_bytes(b"")
    (tmp_path / "bad.toml").write_text("triangel = 5\n")
    names = {p.name for p in tmp_path.iterdir()}
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    # a busy machine may have said before what it does
    *stages, error = done.stderr.splitlines()
    assert error.startswith("error: "), done.stderr
    assert all(re.match("reading|checking|preparing", line) for line in stages), done.stderr
    assert words in done.stderr
    assert {p.name for p in tmp_path.iterdir()} == names
    assert (tmp_path / "ball.glb").read_bytes() == before


def test_inspect_counts_what_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "x.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 5 5 5\nf 1 2 3\nf 1 1 2\n")
    done = run("inspect", "x.obj", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["triangles"], found["boundary_edges"], found["meshes_without_uvs"]) == (1, 3, 1)
    assert found["degenerate_faces"] == 1
    assert any("1 degenerate" in n for n in found["notes"])


def test_a_root_is_passed_on(ball: Asset, tmp_path: Path) -> None:
    for name in ("library", "shot"):
        (tmp_path / name).mkdir()
    save(ball, tmp_path / "library" / "ball.usda")
    (tmp_path / "shot" / "scene.usda").write_text(
        "#usda 1.0\n(subLayers = [@../library/ball.usda@])\n"
    )
    refused = run("inspect", "shot/scene.usda", cwd=tmp_path)
    assert refused.returncode == 2
    assert "--root" in refused.stderr
    assert run("inspect", "shot/scene.usda", "--root", ".", cwd=tmp_path).returncode == 0


def test_doctor_and_version() -> None:
    done = run("doctor", "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout)["problem"] == ""
    assert appearance_opt.__version__ in run("--version").stdout


def test_threads_are_limited_by_the_environment() -> None:
    done = run("doctor", "--json", APPEARANCE_OPT_THREADS="1")
    assert done.returncode == 0, done.stderr
    assert (json.loads(done.stdout)["threads"], json.loads(done.stdout)["thread_limit"]) == (1, "1")
    for nonsense in ("0", "many"):
        refused = run("doctor", APPEARANCE_OPT_THREADS=nonsense)
        assert refused.returncode == 2
        assert f"APPEARANCE_OPT_THREADS={nonsense}: must be a whole number" in refused.stderr


@pytest.mark.parametrize(
    ("content", "count"),
    [("200000 100000\n", 2), ("150000 100000\n", 2), ("5000 100000\n", 1), ("max 100000\n", None)],
)
def test_a_containers_quota_is_known(tmp_path: Path, content: str, count: int | None) -> None:
    (tmp_path / "cpu.max").write_text(content)
    assert backend._processor_quota(tmp_path / "cpu.max") == count
    assert backend._processor_quota(tmp_path / "absent") is None


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys, appearance_opt.cli;"
        "print([m for m in ('drjit', 'mitsuba', 'pxr', 'OpenImageIO', 'scipy', 'numpy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_public_names_exist() -> None:
    for name in appearance_opt.__all__:
        assert getattr(appearance_opt, name) is not None
    assert set(appearance_opt._HOMES) == set(appearance_opt.__all__)
    with pytest.raises(AttributeError):
        _ = appearance_opt.nonsense


def test_presets_files_and_overrides(tmp_path: Path) -> None:
    options = config.simplify_options("draft", ratio=0.1, budget="1.5m", fit="shape, normal")
    assert (options.fit.budget, options.fit.parts, options.views.resolution) == (
        90.0,
        ("shape", "normal"),
        192,
    )
    assert config.simplify_options("draft", ratio=0.1, steps=5).fit.budget is None
    (tmp_path / "a.toml").write_text("texture-size = 512\nrelative = false\n")
    assert config.read_toml(tmp_path / "a.toml") == {"texture_size": 512, "relative": False}
    with pytest.raises(InputError, match="did you mean 'texture-size'"):
        config.simplify_options(triangles=5, texture_sise=3)
    with pytest.raises(InputError, match="expected"):
        config.simplify_options(triangles="5")
    with pytest.raises(InputError, match="power of two"):
        config.simplify_options(triangles=5, texture_size=100)
