"""A job under way: its time, who is told of it, who may end it early, and where its state lies."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from appearance_opt.interrupts import Interrupts
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.optimize.observers import Observer, Reporter, Stop
from appearance_opt.stages.start import Start

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.optimize.checkpoint import Checkpointer
    from appearance_opt.progress import Progress

EXPORT_SECONDS = 1.0
"""Time kept back from the budget for writing the result; the report has a reserve of its own."""

REPORT_SECONDS = 5.0


class Stopwatch:
    """Seconds by stage. ``began``: ``time.perf_counter()`` of the start, by default now."""

    def __init__(self, began: float | None = None) -> None:
        self.began = self._last = time.perf_counter() if began is None else began
        self.stages: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        """Everything since the last lap was ``stage``."""
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + now - self._last
        self._last = now

    @property
    def total(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self.began


@dataclass
class Run:
    """``budget``: seconds for all of the job, None without a limit; ``with_report``: will a report
    be made in that time, too, which takes ``report_seconds``? ``checkpointer``:
    None if the state of the fit is not kept."""

    watch: Stopwatch = field(default_factory=Stopwatch)
    budget: float | None = None
    progress: Progress | None = None
    interrupts: Interrupts = field(default_factory=Interrupts)
    checkpointer: Checkpointer | None = None
    with_report: bool = False
    report_seconds: float = REPORT_SECONDS

    def begin(self, text: str) -> None:
        """Say what begins, in a few words."""
        if self.progress is not None:
            self.progress.stage(text)

    def lap(self, stage: str) -> None:
        """Everything since the last lap was ``stage``."""
        self.watch.lap(stage)

    def seconds_left(self) -> float | None:
        """Seconds of the budget that are left for start and fit; None without a budget."""
        if self.budget is None:
            return None
        reserve = EXPORT_SECONDS + (self.report_seconds if self.with_report else 0.0)
        return max(self.budget - self.watch.total - reserve, 0.0)

    def observers(self, *, resumable: bool = True) -> list[Observer]:
        """Who watches a fit: Ctrl-C, progress, and the checkpoint, if its state is ``resumable``."""
        out: list[Observer] = [Stop(self.interrupts.asked)]
        if self.progress is not None:
            out.append(Reporter(self.progress))
        if resumable and self.checkpointer is not None:
            out.append(self.checkpointer)
        return out

    def make_or_resume(self, make: Callable[[], tuple[Start, bool]]) -> tuple[Start, bool]:
        """(start, interrupted) as ``make`` makes it; a resumed run takes it from beside its
        checkpoint."""
        if self.checkpointer is None:
            return make()
        return self.checkpointer.start(make, Start, LatentMesh)
