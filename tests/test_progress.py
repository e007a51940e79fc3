"""Long work says what it does from its first second."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import appearance_opt as ao
from appearance_opt import progress as terminal
from appearance_opt.asset import save
from appearance_opt.asset.types import Asset
from appearance_opt.initial.decimate import decimate_with_source
from appearance_opt.progress import TerminalProgress

if TYPE_CHECKING:
    from collections.abc import Callable


class Listener:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def stage(self, text: str) -> None:
        self.told.append(text)

    def update(self, step: int, *_: object) -> None:
        self.told.append(f"step {step}")


def test_a_job_tells_every_stage_before_it_begins(ball: Asset, tmp_path: Path) -> None:
    save(ball, tmp_path / "ball.glb")
    small = {
        "steps": 1,
        "resolution": 16,
        "texture_size": 16,
        "pool": 4,
        "views": 2,
        "reallocate": 0,
    }
    heard = Listener()
    options = ao.simplify_options(triangles=100, **small)
    ao.simplify(tmp_path / "ball.glb", tmp_path / "out.glb", options, progress=heard)
    stages = [re.sub(r"[0-9,]+", "N", t) for t in heard.told]
    assert list(dict.fromkeys(stages)) == [
        "reading ball.glb",
        "preparing N triangles",
        "looking for what can be seen",
        "decimating: N triangles left",
        "unwrapping N triangles",
        "packing the atlas and baking its maps",
        "step N",
        "writing the result",
    ]


def test_decimation_tells_how_far_it_is(ball: Asset) -> None:
    mesh = ball.meshes[0]
    left: list[int] = []
    decimate_with_source(mesh.positions, mesh.faces, 200, told=left.append)
    assert len(left) > 3
    assert left[0] > 1000 and left == sorted(left, reverse=True) and left[-1] == 200


def test_without_a_terminal_lines_come_now_and_then(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, waiting = [100.0], []

    class Timer:
        """What ``threading.Timer`` does, when the test says so."""

        def __init__(self, seconds: float, call: Callable, arguments: tuple) -> None:
            assert 0 < seconds <= terminal.EVERY
            self.due = partial(call, *arguments)

        def start(self) -> None:
            waiting.append(self)

        def cancel(self) -> None:
            if self in waiting:
                waiting.remove(self)

    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(terminal.threading, "Timer", Timer)
    with TerminalProgress() as shown:
        shown.stage("reading x.glb")
        assert not capsys.readouterr().err  # nothing, if it is refused now
        shown.stage("preparing")
        assert len(waiting) == 1
        now[0] += terminal.EVERY
        waiting.pop().due()  # it lasts
        shown.stage("decimating")
        now[0] += terminal.EVERY
        shown.update(3, 0.5, 0.1, 30.0, 2.0, None)
        shown.update(4, 0.5, 0.1, 30.0, 2.0, None)
        shown.stage("writing")
    assert not waiting
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "preparing"
    assert len(lines) == 2 and "step 3" in lines[1]
