"""Looks at a running fit that cost it nothing: states are remembered, and measured when the fit is
over."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    import mitsuba as mi

    from appearance_opt.latent.latent import Latent
    from appearance_opt.optimize.checkpoint import FitState


@dataclass(frozen=True)
class Snapshot:
    """Parameters after ``seconds`` of fitting: as they were, and their running means."""

    seconds: float
    step: int
    values: dict[str, mi.Float]
    means: dict[str, mi.Float]


class Recorder:
    """Stands where the loop expects a ``Checkpointer``, and keeps snapshots in memory at given
    ``times`` (seconds). Arrays are never changed in place, so a snapshot copies nothing. ``stop``:
    seconds after which the fit is ended as if by Ctrl-C, to be gone on with by another fit with the
    same recorder (at another resolution)."""

    def __init__(self, times: Sequence[float]) -> None:
        self.snapshots: list[Snapshot] = []
        self.stop: float | None = None
        self._times = list(times)
        self._began = 0.0
        self._kept: FitState | None = None
        self._stopped = False

    def restore(self, model: Latent, state: FitState) -> bool:
        """Called before the clock of a fit starts: go on where the last one was stopped, if there
        was one."""
        self._began = time.perf_counter()
        if self._kept is None:
            return False
        kept, last = self._kept, self.snapshots[-1]
        state.moments, state.iteration, state.seconds = kept.moments, kept.iteration, kept.seconds
        state.laplacian, state.loss = kept.laplacian, kept.loss
        self._began -= kept.seconds
        self._stopped = False
        model.restore(last.values)
        return True

    def due(self) -> bool:
        """Is it time for a snapshot?"""
        now = time.perf_counter() - self._began
        return (self.stop is not None and now >= self.stop) or bool(
            self._times and now >= self._times[0]
        )

    def save(self, model: Latent, state: FitState) -> None:
        """Remember the state. Raises KeyboardInterrupt when the fit is to be stopped here."""
        if self._stopped:
            return
        means = {name: moments.mean for name, moments in state.moments.items()}
        self.snapshots.append(Snapshot(state.seconds, state.iteration, model.values(), means))
        self._times = [t for t in self._times if t > state.seconds]
        if self.stop is not None and state.seconds >= self.stop:
            self._kept, self._stopped, self.stop = state, True, None
            raise KeyboardInterrupt


class Blind:
    """Stands where the loop expects a ``Validation``: the loop's own looks would cost time here,
    and are not needed."""

    def psnr(self, model: Latent) -> float:
        """No opinion."""
        return 0.0
