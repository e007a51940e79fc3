"""Looks at a running fit that cost it nothing: states are remembered, and measured when the fit is
over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from appearance_opt.optimize.observers import Observer

if TYPE_CHECKING:
    from collections.abc import Sequence

    import mitsuba as mi

    from appearance_opt.latent.latent import Latent
    from appearance_opt.optimize.observers import Running
    from appearance_opt.optimize.state import FitState


@dataclass(frozen=True)
class Snapshot:
    """Parameters after ``seconds`` of fitting: as they were, and their running means."""

    seconds: float
    step: int
    values: dict[str, mi.Float]
    means: dict[str, mi.Float]


class Recorder(Observer):
    """Keeps snapshots in memory at given ``times`` (seconds), and at the end. Arrays are never
    changed in place, so a snapshot copies nothing. ``stop``: seconds after which the fit is ended,
    to be gone on with by another fit with the same recorder (at another resolution)."""

    def __init__(self, times: Sequence[float]) -> None:
        self.snapshots: list[Snapshot] = []
        self.stop: float | None = None
        self._times = list(times)
        self._kept: FitState | None = None
        self._stopped = False

    def begin(self, latent: Latent, state: FitState) -> None:
        """Go on where the last fit was stopped, if there was one."""
        if self._kept is None:
            return
        kept = self._kept
        state.moments, state.iteration, state.seconds = kept.moments, kept.iteration, kept.seconds
        state.laplacian, state.loss = kept.laplacian, kept.loss
        self._stopped = False
        latent.restore(self.snapshots[-1].values)

    def ends(self, fit: Running) -> bool:
        return self._stopped

    def stepped(self, fit: Running) -> None:
        state = fit.state
        stop = self.stop is not None and state.seconds >= self.stop
        if stop or (self._times and state.seconds >= self._times[0]):
            self._remember(fit)
        if stop:
            self._kept, self._stopped, self.stop = state, True, None

    def ended(self, fit: Running) -> None:
        if not self._stopped:
            self._remember(fit)

    def _remember(self, fit: Running) -> None:
        state = fit.state
        means = {name: moments.mean for name, moments in state.moments.items()}
        values = fit.latent.values()
        self.snapshots.append(Snapshot(state.seconds, state.iteration, values, means))
        self._times = [t for t in self._times if t > state.seconds]


class Blind:
    """A judge without an opinion: the loop's own looks would cost time here, and are not
    needed."""

    def psnr(self, latent: Latent) -> float:
        """No opinion."""
        return 0.0
