"""State of a fit on disk: enough to go on as if nothing had happened."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.errors import InputError
from appearance_opt.fit import archive
from appearance_opt.fit.adam import Moments

if TYPE_CHECKING:
    from appearance_opt.fit.model import Model

log = logging.getLogger(__name__)

FILE, START_FILE = "fit.npz", "start.npz"


@dataclass
class FitState:
    """Everything that a fit changes, but the model's parameters."""

    moments: dict[str, Moments]
    iteration: int = 0
    loss: float = float("nan")
    laplacian: float = 0.0
    skipped: int = 0
    seconds: float = 0.0
    best: dict[str, mi.Float] | None = None
    best_psnr: float = -np.inf
    best_iteration: int = 0
    unfolded: int = 0
    curve: list[tuple[float, int, float, float]] = field(default_factory=list)


_NUMBERS = ("iteration", "loss", "laplacian", "skipped", "seconds", "best_psnr", "best_iteration", "unfolded")


class Checkpointer:
    """Writes checkpoints of one job into a folder, at most every ``interval`` seconds.

    ``fingerprint`` identifies input and options: a checkpoint of another job is refused.
    """

    def __init__(self, folder: Path, fingerprint: str, resume: bool, interval: float = 10.0) -> None:
        self.path = Path(folder) / FILE
        self.fingerprint, self.resume, self.interval = fingerprint, resume, interval
        self._last = time.monotonic()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if not resume:
            self.start_path.unlink(missing_ok=True)

    @property
    def start_path(self) -> Path:
        """Where a start that cannot be made again is kept. Removed unless a job is resumed."""
        return self.path.with_name(START_FILE)

    def due(self) -> bool:
        """Is it time for another checkpoint?"""
        return time.monotonic() - self._last >= self.interval

    def save(self, model: Model, state: FitState) -> None:
        """Write the state; see ``archive.write``."""
        arrays: dict[str, np.ndarray] = {}
        arrays.update({name: np.array(getattr(state, name)) for name in _NUMBERS})
        arrays["curve"] = np.array(state.curve, np.float64).reshape(-1, 4)
        for name, parameter in model.parameters.items():
            moments = state.moments[name]
            arrays[f"value/{name}"] = np.array(parameter.value)
            arrays[f"first/{name}"] = np.array(moments.first)
            arrays[f"second/{name}"] = np.array(moments.second)
            arrays[f"mean/{name}"] = np.array(moments.mean)
            arrays[f"steps/{name}"] = np.array(moments.steps)
            if state.best is not None:
                arrays[f"best/{name}"] = np.array(state.best[name])
        archive.write(self.path, self.fingerprint, arrays)
        self._last = time.monotonic()

    def restore(self, model: Model, state: FitState) -> bool:
        """Bring model and state to the checkpoint, if one is to be resumed and exists. Raises InputError
        when it is broken or belongs to another job."""
        if not self.resume:
            return False
        if not self.path.exists():
            log.info("no checkpoint in %s: starting from the beginning", self.path.parent)
            return False
        try:
            arrays = archive.read(self.path, self.fingerprint)
            _fill(model, state, arrays)
        except archive.UNREADABLE as error:
            raise InputError(f"{self.path}: not a usable checkpoint ({error}); delete it to start anew") from error
        model.update_scene()
        return True


def _fill(model: Model, state: FitState, arrays: dict[str, np.ndarray]) -> None:
    best = {}
    for name, parameter in model.parameters.items():
        there, wanted = arrays[f"value/{name}"].size, dr.width(parameter.value)
        if there != wanted:
            raise ValueError(f"it holds {there} {name}, the start has {wanted}")
    for name, parameter in model.parameters.items():
        parameter.value = mi.Float(arrays[f"value/{name}"])
        first, second, mean = (mi.Float(arrays[f"{kind}/{name}"]) for kind in ("first", "second", "mean"))
        state.moments[name] = Moments(first, second, mean, int(arrays[f"steps/{name}"]))
        if f"best/{name}" in arrays:
            best[name] = mi.Float(arrays[f"best/{name}"])
    for name in _NUMBERS:
        setattr(state, name, type(getattr(state, name))(arrays[name]))
    state.curve = [(float(s), int(i), float(p), float(v)) for s, i, p, v in arrays["curve"]]
    state.best = best or None
