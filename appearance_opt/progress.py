"""Progress on a terminal: a bar where there is one, a line now and then where not."""

from __future__ import annotations

import sys
import threading
import time
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from types import TracebackType

    from rich.progress import Progress as Bar


EVERY = 5.0
"""Seconds between lines where there is no terminal for a bar, and before the first: what is over
sooner, or refused, prints none."""


class Progress(Protocol):
    """Told of what a job does: ``stage`` when it begins with something that may take long, in a few
    words, and ``update`` after every step of a fit and every look at the held-out views."""

    def stage(self, text: str) -> None: ...

    def update(
        self,
        step: int,
        fraction: float,
        loss: float,
        psnr: float,
        steps_per_second: float,
        seconds_left: float | None,
    ) -> None: ...


class TerminalProgress:
    """Shows what is being done, and during a fit step, loss, held-out PSNR, steps per second and
    time left. A context manager."""

    def __init__(self) -> None:
        self._bar: Bar | None = None
        self._last = time.monotonic()
        self._next: threading.Timer | None = None

    def __enter__(self) -> TerminalProgress:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn
            from rich.progress import Progress as Bar

            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[info]}"),
            )
            self._bar = Bar(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
            self._task = self._bar.add_task("preparing", total=1.0, info="")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._forget()
        if self._bar is not None:
            self._bar.stop()

    def stage(self, text: str) -> None:
        """See ``Progress``."""
        if self._bar is not None:
            self._bar.update(self._task, description=text, info="")
            return
        self._forget()
        left = self._last + EVERY - time.monotonic()
        if left <= 0:
            self._print(text)
        else:  # if it lasts
            self._next = threading.Timer(left, self._print, (text,))
            self._next.daemon = True
            self._next.start()

    def update(
        self,
        step: int,
        fraction: float,
        loss: float,
        psnr: float,
        steps_per_second: float,
        seconds_left: float | None,
    ) -> None:
        """See ``Progress``."""
        left = "" if seconds_left is None else f"  {seconds_left:.0f} s left"
        info = f"step {step}  loss {loss:.5f}  held-out {psnr:.2f} dB  {steps_per_second:.1f} steps/s{left}"
        if self._bar is not None:
            self._bar.update(self._task, description="fitting", completed=fraction, info=info)
            return
        self._forget()
        if time.monotonic() - self._last >= EVERY:
            self._print(f"{100 * fraction:3.0f} %  {info}")

    def _print(self, line: str) -> None:
        self._last = time.monotonic()
        print(line, file=sys.stderr, flush=True)

    def _forget(self) -> None:
        """A line that waits for its time is not printed."""
        if self._next is not None:
            self._next.cancel()
            self._next = None
