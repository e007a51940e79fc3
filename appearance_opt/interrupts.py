"""What Ctrl-C does to a job: before there is anything to lose it ends the job, then it ends the fit
alone."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType, TracebackType

LAST = 3
"""The interrupt that throws a result away."""


class Interrupts:
    """A context in which interrupts (Ctrl-C; SIGTERM where it is handled alike) are taken by a job.

    At first they raise KeyboardInterrupt, as ever. Between ``protect`` and ``release`` the first
    one only asks the fit to end (``asked``), the second one warns, and the third one raises
    KeyboardInterrupt. In threads other than the main one, and where a program has a handler of its
    own, nothing changes.
    """

    def __init__(self) -> None:
        self.count = 0
        self._protected = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) is signal.default_int_handler:
                    self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def asked(self) -> bool:
        """Shall the fit end?"""
        return self.count > 0

    def protect(self) -> None:
        """From now on there is a result that could be lost."""
        self._protected = True

    def release(self) -> None:
        """It is written."""
        self._protected = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if not self._protected:
            raise KeyboardInterrupt
        self.count += 1
        if self.count >= LAST:
            _say("interrupted a third time: the result is given up")
            raise KeyboardInterrupt
        if self.count == 1:
            _say("interrupted: the fit ends here, and its best state will be written")
        else:
            _say("still at it; a third interrupt gives the result up")


def _say(text: str) -> None:
    """To standard error, without its buffer, in the middle of whose use the handler may be
    called."""
    with suppress(OSError):  # nobody listens
        os.write(2, f"WARNING: {text}\n".encode())
