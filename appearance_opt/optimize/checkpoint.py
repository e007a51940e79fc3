"""State of a fit on disk: enough to go on as if nothing had happened."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import drjit as dr
import mitsuba as mi

from appearance_opt.digest import digest
from appearance_opt.errors import InputError
from appearance_opt.lock import FOLDER_LOCK
from appearance_opt.optimize import archive
from appearance_opt.optimize.adam import Moments
from appearance_opt.optimize.observers import Observer
from appearance_opt.optimize.state import CurvePoint, FitState

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.latent.latent import Latent
    from appearance_opt.optimize.observers import Running

log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass
class Kept:
    """What is kept of a fit. ``start``: hash of the start that it began with; ``values``: of the
    parameters."""

    start: str
    values: dict[str, mi.Float]
    state: FitState


CLASSES = (Kept, FitState, Moments, CurvePoint)
"""What a checkpoint is made of."""


class Checkpointer(Observer):
    """Keeps start and state of one job in a folder, the state at most every ``interval`` seconds.

    ``fingerprint`` identifies input and options: a checkpoint of another job is refused. Without
    ``resume``, checkpoints that are there are removed. Raises InputError when the folder holds
    anything else.
    """

    def __init__(
        self, folder: Path, fingerprint: str, resume: bool, interval: float = 10.0
    ) -> None:
        self.folder, self.fingerprint, self.resume, self.interval = (
            Path(folder),
            fingerprint,
            resume,
            interval,
        )
        self.path, self.start_path = (
            self.folder / archive.STATE_FILE,
            self.folder / archive.START_FILE,
        )
        self.start_hash, self._failed = "", False
        self._last = time.monotonic()
        self.folder.mkdir(parents=True, exist_ok=True)
        self._check_folder()
        for path in filter(_temporary, list(self.folder.iterdir())):
            path.unlink()
        if not resume:
            self._clear()

    def _check_folder(self) -> None:
        for path in self.folder.iterdir():
            if path.name not in archive.FILES and not _temporary(path) and path.name != FOLDER_LOCK:
                raise InputError(
                    f"{self.folder}: holds '{path.name}', which is no checkpoint; choose an empty folder or a new one"
                )

    def _clear(self) -> None:
        """Remove what an earlier run has left; the state first, as it belongs to the start."""
        there = [path for path in (self.path, self.start_path) if path.exists()]
        for path in there:
            try:
                archive.fingerprint_of(path)
            except archive.DamagedError as error:
                raise InputError(
                    f"{path}: is no checkpoint, or a damaged one ({error}); delete it, or choose another folder"
                ) from error
        if self.path in there:
            log.warning(
                "%s: the checkpoint of an earlier run is removed (--resume goes on from it)",
                self.folder,
            )
        for path in there:
            path.unlink()

    def start(self, make: Callable[[], tuple[T, bool]], *classes: type) -> tuple[T, bool]:
        """(start, interrupted): the one that is kept, if the job is resumed, or one that is made
        and kept. Made again, it could be another one, as the time that is left decides how often
        triangles are moved. ``classes``: what it consists of. Raises InputError when the kept one
        is damaged or belongs to another job."""
        if self.start_path.exists():
            try:
                start, interrupted = archive.read(self.start_path, self.fingerprint, classes), False
            except archive.DamagedError as error:
                raise InputError(
                    f"{self.start_path}: not a usable start ({error}); empty the folder to begin anew"
                ) from error
        else:
            start, interrupted = make()
            archive.write(self.start_path, self.fingerprint, start)
        self.start_hash = digest(start)
        return start, interrupted

    def begin(self, latent: Latent, state: FitState) -> None:
        self.restore(latent, state)

    def stepped(self, fit: Running) -> None:
        if self.due():
            self.save(fit.latent, fit.state)

    def ended(self, fit: Running) -> None:
        self.save(fit.latent, fit.state)

    def due(self) -> bool:
        """Is it time for another checkpoint?"""
        return time.monotonic() - self._last >= self.interval

    def save(self, latent: Latent, state: FitState) -> None:
        """Write the state; see ``archive.write``. Where it cannot be written, the fit is worth more
        than its checkpoint: this is said once, and the one before stays."""
        try:
            archive.write(
                self.path, self.fingerprint, Kept(self.start_hash, latent.values(), state)
            )
        except OSError as error:
            if not self._failed:
                log.warning(
                    "%s: cannot be written (%s); the fit goes on without", self.path, error.strerror
                )
            self._failed = True
        self._last = time.monotonic()

    def restore(self, latent: Latent, state: FitState) -> bool:
        """Bring latent and state to the checkpoint, if one is to be resumed and exists. Raises
        InputError when it is damaged or belongs to another job or another start."""
        if not self.resume:
            return False
        if not self.path.exists():
            log.info("no checkpoint in %s: starting from the beginning", self.folder)
            return False
        try:
            kept = archive.read(self.path, self.fingerprint, CLASSES, mi.Float)
            _check(kept, latent)
        except archive.DamagedError as error:
            raise InputError(
                f"{self.path}: not a usable checkpoint ({error}); empty the folder to start anew"
            ) from error
        if kept.start != self.start_hash:
            raise InputError(
                f"{self.path}: this checkpoint belongs to another start than {self.start_path.name} beside it; "
                "empty the folder to start anew"
            )
        vars(state).update(vars(kept.state))
        latent.restore(kept.values)
        return True


def _temporary(path: Path) -> bool:
    """Did a killed run leave this file half written?"""
    return path.suffix == archive.TEMPORARY and path.name.startswith((".fit-", ".start-"))


def _check(kept: Kept, latent: Latent) -> None:
    """Raise DamagedError if there are not as many numbers as the latent has."""
    if not isinstance(kept, Kept) or not isinstance(kept.state, FitState):
        raise archive.DamagedError("it holds no state of a fit")
    for name, parameter in latent.parameters.items():
        wanted, moments = dr.width(parameter.value), kept.state.moments.get(name)
        if (
            name not in kept.values
            or moments is None
            or name not in (kept.state.best or latent.parameters)
        ):
            raise archive.DamagedError(f"it holds no {name}")
        rows = [kept.values[name], moments.first, moments.second, moments.mean]
        rows += [] if kept.state.best is None else [kept.state.best[name]]
        for row in rows:
            if dr.width(row) != wanted:
                raise archive.DamagedError(
                    f"it holds {dr.width(row)} {name}, the start has {wanted}"
                )
