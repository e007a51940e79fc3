"""Runs that are killed, interrupted or out of disk: whatever has its final name is whole.

Signals come at events of a run (a file that is about to get its name, a module that is loaded, a
line of progress), never at a time: how far a run is after some seconds depends on the machine and
on what else it does.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.asset import load, save
from appearance_opt.asset.types import Asset
from appearance_opt.errors import InputError
from appearance_opt.jobs.paths import Outputs
from appearance_opt.render.freezing import Frozen
from tests.conftest import make_asset
from tests.looks import COMMAND, ENVIRONMENT

JOB = [
    "simplify", "in.glb", "--triangles", "150", "--texture-size", "32", "--resolution", "32",
    "--pool", "4", "--views", "2", "--reallocate", "0", "--device", "cpu",
]  # fmt: skip

HANGS = 1200
"""Seconds after which a run counts as hanging, however busy the machine."""

# a line at every step, from the first one on
TALKATIVE = "from appearance_opt import progress; progress.EVERY = 0.0"

# sends itself a signal just before a file gets its final name, or just before a module is loaded
AT_EVENT = """
import os, sys
from pathlib import Path
event, name, number = sys.argv.pop(1), sys.argv.pop(1), int(sys.argv.pop(1))

def watch(what, arguments):
    global event
    subject = arguments[1] if what == "os.rename" else arguments[0] if what == "import" else None
    if what == event and isinstance(subject, (str, Path)) and Path(subject).name == name:
        event = None
        os.kill(os.getpid(), number)

sys.addaudithook(watch)
"""

# counts the calls of this package's functions, and sends itself a signal at one of them. The last
# count goes to a file
AT_CALL = """
import atexit, os, sys
from pathlib import Path
number, wanted = int(sys.argv.pop(1)), int(sys.argv.pop(1))
calls = 0

def count(frame, what, argument):
    global calls
    if what == "call" and "appearance_opt" in frame.f_code.co_filename:
        calls += 1
        if calls == wanted:
            os.kill(os.getpid(), number)

atexit.register(lambda: Path("calls.txt").write_text(str(calls)))
sys.setprofile(count)
"""


def start(folder: Path, code: str, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT,
    )  # fmt: skip


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """(exit code, standard error) of a run."""
    try:
        error = process.communicate(timeout=HANGS)[1]
    finally:
        process.kill()
    return process.returncode, error


def run(folder: Path, *more: str) -> tuple[int, str]:
    return ended(start(folder, COMMAND, *JOB, *more))


def run_to_event(
    folder: Path, event: str, name: str, how: signal.Signals, *more: str
) -> tuple[int, str]:
    return ended(start(folder, AT_EVENT + COMMAND, event, name, str(int(how)), *JOB, *more))


def run_to_call(folder: Path, number: int, how: signal.Signals, *more: str) -> tuple[int, str]:
    return ended(start(folder, AT_CALL + COMMAND, str(int(how)), str(number), *JOB, *more))


def check_whole(folder: Path) -> None:
    """Everything that does not carry a temporary name can be read."""
    for path in folder.rglob("*"):
        if (
            any(part.startswith(".") for part in path.relative_to(folder).parts)
            or path.suffix == ".tmp"
        ):
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


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with an input."""
    save(make_asset(12, 24, 32), tmp_path / "in.glb")
    return tmp_path


def check_killed(folder: Path, code: int, error: str, before: bytes) -> None:
    assert code in (0, -signal.SIGKILL), error
    assert "Traceback" not in error, error
    check_whole(folder)
    assert (folder / "in.glb").read_bytes() == before


def test_killed_runs_leave_no_broken_files(folder: Path) -> None:
    before = (folder / "in.glb").read_bytes()
    more = ("--steps", "2", "--out", "low.glb", "--checkpoint", "state")
    # one run after the other over what the last one left: nothing, a checkpoint, a result
    for name, there in (
        ("fit.npz", set()),
        ("low.glb", {"state/fit.npz"}),
        ("report.html", {"state/fit.npz", "low.glb"}),
    ):
        code, error = run_to_event(folder, "os.rename", name, signal.SIGKILL, *more)
        assert code == -signal.SIGKILL, error
        check_killed(folder, code, error, before)
        for path in ("state/fit.npz", "low.glb", "low.report/report.html"):
            assert (folder / path).exists() == (path in there), (name, path)
    code, error = run(folder, *more)
    assert code == 0, error
    check_whole(folder)
    assert (folder / "low.report" / "report.html").exists()


ENDED = "error: interrupted; what was written is complete"


def test_runs_interrupted_before_the_fit_write_nothing(folder: Path) -> None:
    code, error = run_to_event(
        folder, "import", "xatlas", signal.SIGINT, "--steps", "2", "--out", "low.glb"
    )
    assert (code, error.splitlines()[-1]) == (130, ENDED)
    assert "Traceback" not in error and "Exception ignored" not in error, error
    assert [p.name for p in folder.iterdir()] == ["in.glb"]


def test_interrupted_fits_write_the_best_state(folder: Path) -> None:
    # without the interrupt, the fit would go on for hours
    process = start(
        folder, TALKATIVE + COMMAND, *JOB, "--steps", "10000000", "--out", "low.glb", "--no-report"
    )
    assert process.stderr is not None
    for line in process.stderr:
        if "held-out" in line:
            break
    process.send_signal(signal.SIGINT)
    code, error = ended(process)
    assert code == 0, error
    assert "Traceback" not in error and "Exception ignored" not in error, error
    assert "interrupted after" in error and "this is the best state so far" in error
    assert load(folder / "low.glb").triangle_count <= 150


def test_an_interrupt_after_the_result_ends_the_report_alone(folder: Path) -> None:
    more = ("--steps", "2", "--out", "low.glb")
    code, error = run_to_event(folder, "os.rename", "report.html", signal.SIGINT, *more)
    assert code == 0, error
    assert "Traceback" not in error and "Exception ignored" not in error, error
    assert "interrupted while the report was made: the result is complete" in error
    check_whole(folder)
    assert (folder / "low.glb").exists() and not (folder / "low.report" / "report.html").exists()


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


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> int:
    """How many calls of our functions a whole run makes."""
    folder = tmp_path_factory.mktemp("calls")
    save(make_asset(12, 24, 32), folder / "in.glb")
    code, error = run_to_call(
        folder, 0, signal.SIGINT, "--steps", "4", "--out", "low.glb", "--checkpoint", "state"
    )
    assert code == 0, error
    return int((folder / "calls.txt").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_runs_killed_at_fifty_moments(folder: Path, calls: int, suffix: str) -> None:
    before = (folder / "in.glb").read_bytes()
    codes = []
    for number in np.random.default_rng(0).integers(1, calls, 50):
        more = ("--steps", "4", "--out", f"low{suffix}", "--checkpoint", "state")
        code, error = run_to_call(folder, number, signal.SIGKILL, *more)
        check_killed(folder, code, error, before)
        codes.append(code)
    assert -signal.SIGKILL in codes


@pytest.mark.slow
def test_runs_interrupted_at_fifty_moments(folder: Path, calls: int) -> None:
    cut = 0
    for k, number in enumerate(np.random.default_rng(1).integers(1, calls, 50)):
        code, error = run_to_call(
            folder, number, signal.SIGINT, "--steps", "4", "--out", f"low{k}.glb"
        )
        assert "Traceback" not in error and "Exception ignored" not in error, error
        assert code in (0, 130), error
        if code == 0:
            assert (folder / f"low{k}.glb").exists()
        else:  # before the fit, or in the instant after the result was renamed
            assert ENDED in error
        check_whole(folder)
        cut += (
            "interrupted" in error
        )  # in the line of an error, or in the note of a fit that ended early
    assert cut


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
    assert lines == [
        f"{s} refused clean []" for s in (".glb", ".gltf", ".obj", ".usda", ".usdc", ".usdz")
    ]


def test_outputs_that_cannot_be_written_are_refused_before_any_work(tmp_path: Path) -> None:
    if not Path("/proc/self").exists():
        pytest.skip("needs a folder that nobody can write to")
    with pytest.raises(InputError, match="nothing can be written there"):
        Outputs.of("/proc/x.glb").check()
    (tmp_path / "file").write_bytes(b"")
    for folder in (
        {"report": "file"},
        {"checkpoint": "file"},
        {"report": "file/x"},
        {"loose": "file"},
    ):
        with pytest.raises(InputError, match="not a folder"):
            Outputs.of(tmp_path / "x.glb", **{k: tmp_path / v for k, v in folder.items()}).check()
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
