"""Who is told what a fit does, and may end it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.latent.latent import Latent
    from appearance_opt.optimize.schedule import Clock
    from appearance_opt.optimize.state import FitState
    from appearance_opt.progress import Progress


@dataclass(frozen=True)
class Running:
    """A fit that is under way."""

    latent: Latent
    state: FitState
    clock: Clock


class Observer:
    """Does nothing by itself: an observer overrides what it wants to know."""

    def begin(self, latent: Latent, state: FitState) -> None:
        """Called before the clock starts: may bring both to where an earlier fit was."""

    def ends(self, fit: Running) -> bool:
        """Asked before every step: shall the fit end here?"""
        return False

    def stepped(self, fit: Running) -> None:
        """Called after every step, and after the look that may follow it."""

    def looked(self, fit: Running) -> None:
        """Called after every look at the held-out views."""

    def ended(self, fit: Running) -> None:
        """Called after the last look, before the latent goes back to its best state."""


class Reporter(Observer):
    """Passes on how far a fit is."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def stepped(self, fit: Running) -> None:
        state, seconds = fit.state, fit.clock.time()
        fraction = fit.clock.progress(state.iteration)
        left = seconds * (1 - fraction) / fraction if fraction > 0 else None
        per_second = state.iteration / max(seconds, 1e-9)
        self._progress.update(state.iteration, fraction, state.loss, state.psnr, per_second, left)


class Stop(Observer):
    """Ends a fit when ``asked`` says so."""

    def __init__(self, asked: Callable[[], bool]) -> None:
        self._asked = asked

    def ends(self, fit: Running) -> bool:
        return self._asked()
