"""Ctrl-C: once the fit has begun, one ends it, two lose nothing, and three give the result up."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import pytest

import appearance_opt
from appearance_opt.asset import load
from appearance_opt.asset.types import Asset
from appearance_opt.config import simplify_options
from appearance_opt.interrupts import Interrupts
from appearance_opt.jobs.result import Result
from appearance_opt.optimize.validation import Validation


def interrupt(number: int = signal.SIGINT) -> None:
    os.kill(os.getpid(), number)


def test_interrupts_count_from_where_there_is_something_to_lose(
    capfd: pytest.CaptureFixture[str],
) -> None:
    before = signal.getsignal(signal.SIGINT)
    with Interrupts() as interrupts:
        with pytest.raises(KeyboardInterrupt):
            interrupt()
        assert not interrupts.asked()
        interrupts.protect()
        interrupt()
        assert interrupts.asked()
        interrupt()
        assert "a third interrupt gives the result up" in capfd.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            interrupt()
        assert "the result is given up" in capfd.readouterr().err
        interrupts.release()
        with pytest.raises(KeyboardInterrupt):
            interrupt()
    assert signal.getsignal(signal.SIGINT) is before


def test_handlers_of_others_stay() -> None:
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with Interrupts():
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
        seen: list[object] = []

        def work() -> None:
            with Interrupts():
                seen.append(signal.getsignal(signal.SIGINT))

        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
        assert seen == [signal.default_int_handler]
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_result_survives_two_interrupts(
    ball: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """The first in a step, the others in the look that comes after it and while the result is
    written."""
    moments = iter([1, 2, 3])

    def when(moment: int) -> None:
        if moment <= count:
            interrupt()

    class Step:
        def stage(self, text: str) -> None:
            pass

        def update(self, step: int, *rest: object) -> None:
            if step == 2:
                when(next(moments))

    look, write = Validation.psnr, Result.write

    def looked(self: Validation, model: object) -> float:
        if count and moments.__length_hint__() == 2:
            when(next(moments))
        return look(self, model)

    def written(*given: object) -> None:
        when(next(moments))
        write(*given)

    monkeypatch.setattr(Validation, "psnr", looked)
    monkeypatch.setattr(Result, "write", written)
    options = simplify_options(
        triangles=150, steps=100_000, texture_size=32, resolution=32, pool=4, views=2, reallocate=0
    )
    given = (ball, tmp_path / "low.glb", options)
    if count < 3:
        result = appearance_opt.simplify(*given, progress=Step())
        assert result.fit.interrupted and result.fit.steps == 2
        assert load(tmp_path / "low.glb").triangle_count <= 150
    else:
        with pytest.raises(KeyboardInterrupt):
            appearance_opt.simplify(*given, progress=Step())
        assert not list(tmp_path.iterdir())
