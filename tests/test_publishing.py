"""Files that appear together, locks, and what a killed or failing process leaves."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from appearance_opt.errors import InputError
from appearance_opt.lock import lock_path, locked
from appearance_opt.publish import PREFIX, publication, publishing, recover

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1])}


def contents(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()
    }


def write_version(folder: Path, version: str) -> None:
    """A root file, two parts, and a part that only the new version has."""
    with publishing(folder / "root") as place:
        place.with_name("part").write_text(version)
        place.with_name("parts").mkdir()
        (place.with_name("parts") / "deep").write_text(version)
        if version == "new":
            place.with_name("more").write_text(version)
        place.write_text(version)


OLD = {"part": "old", "parts/deep": "old", "root": "old"}
NEW = {"part": "new", "parts/deep": "new", "root": "new", "more": "new"}


def test_files_appear_together(tmp_path: Path) -> None:
    write_version(tmp_path, "old")
    assert contents(tmp_path) == OLD
    write_version(tmp_path, "new")
    assert contents(tmp_path) == NEW


def test_nothing_appears_when_writing_fails(tmp_path: Path) -> None:
    write_version(tmp_path, "old")
    with pytest.raises(KeyboardInterrupt), publishing(tmp_path / "root") as place:
        place.with_name("part").write_text("new")
        raise KeyboardInterrupt
    assert contents(tmp_path) == OLD
    (tmp_path / "more").mkdir()
    with pytest.raises(InputError, match="more: is a folder"):
        write_version(tmp_path, "new")
    assert contents(tmp_path) == OLD
    with (
        pytest.raises(OSError, match=f"No such file.*{tmp_path}/x'"),
        publishing(tmp_path / "root") as place,
    ):
        place.with_name("x").read_text()


@pytest.mark.parametrize("failing", range(8))
def test_all_is_undone_when_a_rename_fails(
    tmp_path: Path, failing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_version(tmp_path, "old")
    count = iter(range(100))
    whole = Path.rename

    def rename(self: Path, target: Path) -> Path:
        if next(count) == failing:
            raise OSError(28, "no room", str(target))
        return whole(self, target)

    monkeypatch.setattr(Path, "rename", rename)
    if failing < 7:  # three old files aside, four new ones in
        with pytest.raises(OSError, match="no room"):
            write_version(tmp_path, "new")
        assert contents(tmp_path) == OLD
    else:
        write_version(tmp_path, "new")
        assert contents(tmp_path) == NEW


DYING = "import sys, pathlib; from tests.test_publishing import *; die_at_every_call(pathlib.Path(sys.argv[1]))"


def killed(calls: int, what: Callable[[], None]) -> bool:
    """Does a child that does this, and is killed at the call after so many that change the disk,
    die of it?"""
    child = os.fork()
    if child == 0:
        left = iter(range(calls))

        def dying(whole: Callable) -> Callable:
            def function(*arguments: object, **named: object) -> object:
                if next(left, None) is None:
                    os.kill(os.getpid(), signal.SIGKILL)
                return whole(*arguments, **named)

            return function

        for name in ("rename", "replace", "unlink", "write_text"):
            setattr(Path, name, dying(getattr(Path, name)))
        try:
            what()
        finally:
            os._exit(0)
    return os.waitpid(child, 0)[1] == signal.SIGKILL


def consistent(folder: Path) -> bool:
    """Is everything that the root file refers to of its version?"""
    there = {name: text for name, text in contents(folder).items() if not name.startswith(PREFIX)}
    return "root" not in there or there == {"old": OLD, "new": NEW}[there["root"]]


def die_at_every_call(within: Path) -> None:
    """What ``test_a_killed_process_mixes_nothing_and_is_undone`` runs in a process of one thread,
    which may fork."""
    for calls in range(100):
        folder = within / str(calls)
        folder.mkdir()
        write_version(folder, "old")
        dead = killed(calls, lambda: write_version(folder, "new"))  # noqa: B023
        assert consistent(folder), calls
        if not dead:
            break
        if calls % 2:  # the process that undoes it is killed as well
            killed(calls % 5, lambda: recover(folder))  # noqa: B023
            assert consistent(folder), calls
        recover(folder)
        assert contents(folder) in (OLD, NEW), calls
    assert calls > 10 and contents(folder) == NEW


def test_a_killed_process_mixes_nothing_and_is_undone(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", DYING, str(tmp_path)],
        cwd=Path(__file__).resolve().parents[1], env=ENVIRONMENT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_what_a_living_process_is_writing_is_left_alone(tmp_path: Path) -> None:
    with publication() as together:
        together.place(tmp_path / "root").write_text("new")
        recover(tmp_path)
    assert contents(tmp_path) == {"root": "new"}


def planted(folder: Path, names: list[str]) -> Path:
    """What looks like the remains of a killed run, as an archive of somebody else might bring
    along."""
    root = folder / f"{PREFIX}planted"
    for name in ("new", "old"):
        (root / name).mkdir(parents=True)
    (root / "lock").touch()
    (root / "journal.json").write_text(json.dumps([[name, 1, 2] for name in names]))
    return root


def test_remains_that_others_planted_change_nothing(tmp_path: Path) -> None:
    folder, outside = tmp_path / "folder", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()
    (folder / "in.glb").write_text("mine")
    (outside / "x").write_text("mine")
    before = contents(tmp_path)
    root = planted(folder, ["in.glb", "../outside/x", str(outside / "x"), "link/x", "../outside/y"])
    (folder / "link").symlink_to(outside)
    (root / "old" / "in.glb").write_text("theirs")
    (root / "old" / "link").mkdir()
    (root / "old" / "link" / "y").write_text("theirs")
    (root / "outside").mkdir()
    (root / "outside" / "y").write_text("theirs")
    recover(folder)
    (folder / "link").unlink()
    assert contents(tmp_path) == before
    root = planted(folder, ["x"])
    (root / "old").rmdir()
    (root / "old").symlink_to(outside)  # would take the file of somebody
    recover(folder)
    assert contents(tmp_path) == before
    for nonsense in ("[", "[1]", '{"a": 1}', '[["x"]]', "[[0, 1, 2]]"):
        (planted(folder, []) / "journal.json").write_text(nonsense)
        recover(folder)
        assert contents(tmp_path) == before


def test_one_process_holds_a_name(tmp_path: Path) -> None:
    target = tmp_path / "new" / "out.glb"
    with locked(target):
        assert (
            lock_path(target).read_text().startswith(f"appearance-opt: process {os.getpid()} on ")
        )
        with pytest.raises(
            InputError, match=rf"out\.glb: another run is writing it \(process {os.getpid()} on "
        ):
            locked(target).__enter__()
        with locked(tmp_path / "new" / "other.glb"):
            pass
    assert not target.parent.exists()


def test_locks_of_killed_processes_hold_nothing(tmp_path: Path) -> None:
    target = tmp_path / "out.glb"
    hold = "import sys, time; from pathlib import Path; from appearance_opt.lock import locked\n"
    hold += "with locked(Path(sys.argv[1])):\n print('held', flush=True)\n sys.stdin.read()"
    process = subprocess.Popen(
        [sys.executable, "-c", hold, str(target)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT,
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    with pytest.raises(InputError, match=f"process {process.pid} on"):
        locked(target).__enter__()
    process.kill()
    process.communicate()
    assert lock_path(target).exists()
    with locked(target):
        pass
    assert not list(tmp_path.iterdir())


def test_files_of_others_are_no_locks(tmp_path: Path) -> None:
    target = tmp_path / "out.glb"
    lock_path(target).write_text("mine")
    with pytest.raises(InputError, match="needed for a lock"):
        locked(target).__enter__()
    assert lock_path(target).read_text() == "mine"
