"""Runs that are killed, interrupted or out of disk: whatever has its final name is whole."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.asset import load, save
from appearance_opt.asset.types import Asset
from appearance_opt.errors import InputError
from appearance_opt.jobs.paths import check_paths
from appearance_opt.render.freezing import Frozen

JOB = [
    "simplify", "in.glb", "--triangles", "150", "--texture-size", "32", "--resolution", "32",
    "--pool", "8", "--views", "2", "--steps", "40", "--device", "cpu",
]  # fmt: skip

# the package beside these tests, whatever is installed
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1])}


# what the installed command runs. `python -m` ends by the signal itself, whatever the exit code, when the interrupt
# came while a C extension ran Python code
COMMAND = "import sys; from appearance_opt.cli import main; sys.exit(main())"


def start(folder: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", COMMAND, *JOB, *more]
    return subprocess.Popen(
        command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT
    )


def processor_seconds(process: subprocess.Popen[str]) -> float:
    """Seconds of computing so far: how far a run is, however busy the machine."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / 100


def stopped_at(process: subprocess.Popen[str], seconds: float, how: signal.Signals) -> tuple[int, str]:
    """(exit code, standard error) of a run that gets a signal after so many seconds of computing."""
    while process.poll() is None and processor_seconds(process) < seconds:
        time.sleep(0.01)
    process.send_signal(how)
    error = process.communicate(timeout=120)[1]
    return process.returncode, error


def check_whole(folder: Path) -> None:
    """Everything that does not carry a temporary name can be read."""
    for path in folder.rglob("*"):
        if any(part.startswith(".") for part in path.relative_to(folder).parts) or path.suffix == ".tmp":
            continue
        if path.suffix in (".glb", ".gltf"):
            assert load(path).triangle_count > 0
        elif path.suffix == ".npz":
            with np.load(path) as arrays:
                assert all(arrays[n].size for n in arrays.files if n.startswith("value"))
        elif path.suffix == ".json":
            assert json.loads(path.read_text())
        elif path.suffix == ".html":
            assert path.read_text().rstrip().endswith("</html>")


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory, ball: Asset) -> tuple[Path, float]:
    """A folder with an input, and the seconds of computing that the job takes."""
    if not Path("/proc/self/stat").exists():
        pytest.skip("needs /proc to know how far a run is")
    folder = tmp_path_factory.mktemp("job")
    save(ball, folder / "in.glb")
    process = start(folder, "--out", "whole.glb")
    seconds = 0.0
    while process.poll() is None:
        try:
            seconds = processor_seconds(process)
        except (OSError, IndexError):
            break
        time.sleep(0.02)
    error = process.communicate(timeout=120)[1]
    assert process.returncode == 0, error
    check_whole(folder)
    return folder, seconds


def kill(job: tuple[Path, float], tmp_path: Path, moments: np.ndarray, suffix: str) -> None:
    folder, seconds = job
    (tmp_path / "in.glb").write_bytes((folder / "in.glb").read_bytes())
    before = (tmp_path / "in.glb").read_bytes()
    codes = []
    for share in moments:
        process = start(tmp_path, "--out", f"low{suffix}", "--checkpoint", "state")
        code, _ = stopped_at(process, share * seconds, signal.SIGKILL)
        assert code in (0, -signal.SIGKILL)
        check_whole(tmp_path)
        assert (tmp_path / "in.glb").read_bytes() == before
        codes.append(code)
    assert -signal.SIGKILL in codes


def interrupt(job: tuple[Path, float], tmp_path: Path, moments: np.ndarray) -> None:
    folder, seconds = job
    (tmp_path / "in.glb").write_bytes((folder / "in.glb").read_bytes())
    cut = 0
    for k, share in enumerate(moments):
        process = start(tmp_path, "--out", f"low{k}.glb")
        code, error = stopped_at(process, max(share * seconds, 0.5), signal.SIGINT)
        assert "Traceback" not in error and "Exception ignored" not in error, error
        assert code in (0, 130), error
        if code == 0:
            assert (tmp_path / f"low{k}.glb").exists()
        else:  # before the fit, or in the instant after the result was renamed
            assert "error: interrupted; what was written is complete" in error
        check_whole(tmp_path)
        cut += "interrupted" in error  # in the line of an error, or in the note of a fit that ended early
    assert cut


def test_killed_runs_leave_no_broken_files(job: tuple[Path, float], tmp_path: Path) -> None:
    kill(job, tmp_path, np.array([0.6, 0.8, 0.97]), ".glb")


def test_interrupted_runs_end_cleanly(job: tuple[Path, float], tmp_path: Path) -> None:
    interrupt(job, tmp_path, np.array([0.3, 0.6, 0.9]))


def test_an_interrupted_recording_is_an_interrupt() -> None:
    run = Frozen()

    def stopped(x: mi.Float) -> mi.Float:
        del x
        raise KeyboardInterrupt

    def squared(x: mi.Float) -> mi.Float:
        return x * x

    with pytest.raises(KeyboardInterrupt):
        run(stopped, mi.Float(1, 2))
    for _ in range(2):  # recorded, then replayed: nothing of the other one is left
        np.testing.assert_array_equal(run(squared, mi.Float(2, 3)), [4, 9])


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_runs_killed_at_fifty_moments(job: tuple[Path, float], tmp_path: Path, suffix: str) -> None:
    kill(job, tmp_path, np.random.default_rng(0).random(50), suffix)


@pytest.mark.slow
def test_runs_interrupted_at_fifty_moments(job: tuple[Path, float], tmp_path: Path) -> None:
    interrupt(job, tmp_path, np.random.default_rng(1).random(50))


FULL = """
import resource, sys
from pathlib import Path
from appearance_opt.asset import load, save

asset = load("in.glb")
# no file may grow beyond one block: what a full disk does to a program, without one
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
for suffix in (".glb", ".gltf", ".obj", ".usda", ".usdc", ".usdz"):
    folder = Path("full" + suffix)
    try:
        save(asset, folder / ("x" + suffix))
        print(suffix, "written")
    except OSError as error:
        root = (folder / ("x" + suffix)).exists()
        print(suffix, "refused", "broken" if root else "clean", sorted(p.name for p in folder.glob(".*")))
"""


def test_a_full_disk_is_an_error_and_leaves_nothing(ball: Asset, tmp_path: Path) -> None:
    pytest.importorskip("resource")
    save(ball, tmp_path / "in.glb")
    done = subprocess.run(
        [sys.executable, "-c", FULL], cwd=tmp_path, capture_output=True, text=True,
        env=ENVIRONMENT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines == [f"{s} refused clean []" for s in (".glb", ".gltf", ".obj", ".usda", ".usdc", ".usdz")]


def test_outputs_that_cannot_be_written_are_refused_before_any_work(tmp_path: Path) -> None:
    if not Path("/proc/self").exists():
        pytest.skip("needs a folder that nobody can write to")
    with pytest.raises(InputError, match="nothing can be written there"):
        check_paths(None, Path("/proc/x.glb"), None, None)
    (tmp_path / "file").write_bytes(b"")
    for report, checkpoint in (("file", None), (None, "file"), ("file/x", None)):
        with pytest.raises(InputError, match="not a folder"):
            check_paths(
                None,
                tmp_path / "x.glb",
                None if report is None else tmp_path / report,
                None if checkpoint is None else tmp_path / checkpoint,
            )
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
