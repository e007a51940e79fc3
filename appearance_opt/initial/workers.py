"""Atlases of xatlas whose threads are asleep when they end.

xatlas ends its threads without the lock under which they wait for work (``TaskScheduler`` of
xatlas.cpp). A thread that is just about to fall asleep then misses the call, and the process waits
for it forever. It happens seldom, and more often on busy machines.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xatlas

TASKS = Path("/proc/self/task")

PAUSE, PATIENCE = 0.001, 2.0
"""Seconds between two looks at the threads, and after which they count as asleep: others may have
begun in the meantime, and have work to do."""


@contextmanager
def atlas_at_rest() -> Iterator[xatlas.Atlas]:
    """A new atlas, whose threads have fallen asleep at the end of the block. Drop it after that."""
    import xatlas

    before = threads()
    atlas = xatlas.Atlas()
    own = threads() - before
    yield atlas
    wait_for_sleep(own)


def threads() -> set[str]:
    """Numbers of the threads of this process; none where the system does not tell."""
    return {p.name for p in TASKS.iterdir()} if TASKS.is_dir() else set()


def wait_for_sleep(numbers: set[str]) -> bool:
    """Wait until all threads of these numbers are asleep or gone, ``PATIENCE`` seconds at most. Did
    they?"""
    time.sleep(PAUSE)
    end = time.monotonic() + PATIENCE
    while any(map(_awake, numbers)):
        if time.monotonic() > end:
            return False
        time.sleep(PAUSE)
    return True


def _awake(number: str) -> bool:
    try:
        told = (TASKS / number / "stat").read_text(encoding="utf-8", errors="replace")
        # the state comes after the name, which may hold anything
        return told.rpartition(")")[2].split()[0] != "S"
    except OSError:
        return False
