"""A chain of levels: each fitted to the source at the size at which it is shown, and started from
the finer one's result."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from appearance_opt.errors import InputError
from appearance_opt.optimize import archive
from appearance_opt.optimize.checkpoint import Checkpointer
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.survey import MeshSurvey
from appearance_opt.stages.choice import choose_start
from appearance_opt.stages.export import Exporter, export
from appearance_opt.stages.fitting import fit_start

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from appearance_opt.asset.types import Asset
    from appearance_opt.config import LodOptions, SimplifyOptions
    from appearance_opt.errors import DivergedError
    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.optimize.loop import FitResult
    from appearance_opt.reference.subject import Subject
    from appearance_opt.stages.export import Exported
    from appearance_opt.stages.run import Run

log = logging.getLogger(__name__)

FINEST_SHARE = 0.62
"""Part of the time for starts and fits that the finest level takes: the whole chain takes about one
and a half times as long."""

COARSER_WEIGHT = 0.6
"""Time of each next level, of that of the one before: an image has a quarter of the pixels at half
the size, but compiling and set-up take what they take."""

RESOLUTIONS = (16, 4096)
"""Of images of a fit."""

LEAST_TEXTURE = 16

LEAST_SECONDS = 0.01
"""Budgets are positive."""


@dataclass(frozen=True)
class Level:
    """``pixels``: its size on screen; ``exported``: what was fitted; ``fit``: how; ``notes``: of
    its start; ``error``: set if the fit diverged; ``seconds`` that it took."""

    pixels: int
    exported: Exported
    fit: FitResult
    notes: tuple[str, ...]
    error: DivergedError | None
    seconds: float

    @property
    def asset(self) -> Asset:
        """The level."""
        return self.exported.asset

    @property
    def drawn(self) -> Asset:
        """It as it is seen: with a displacement map, the finest tessellated mesh."""
        levels = self.exported.levels
        return levels[max(levels)] if levels else self.asset


def plan_shares(count: int) -> tuple[float, ...]:
    """Part of the time that each level may take, the finest first; they add up to 1.

    >>> [round(share, 2) for share in plan_shares(3)]
    [0.62, 0.24, 0.14]
    """
    weights = [COARSER_WEIGHT**k for k in range(count - 1)]
    rest = 1.0 - FINEST_SHARE
    return (FINEST_SHARE, *(rest * w / sum(weights) for w in weights))


def level_options(
    options: LodOptions, pixels: int, triangles: int, seconds: float | None
) -> LodOptions:
    """Options of the fit of one level: images of its size, maps in proportion to it."""
    low, high = RESOLUTIONS
    if seconds is not None:  # no time left is a fit without steps
        seconds = max(seconds, LEAST_SECONDS)
    first = options.chain.sizes()[0]
    size = options.texture.size
    while size > LEAST_TEXTURE and size * first > options.texture.size * pixels:
        size //= 2
    return replace(
        options,
        start=replace(options.start, triangles=triangles, ratio=None),
        views=replace(options.views, resolution=min(max(pixels, low), high)),
        texture=replace(options.texture, size=size),
        fit=replace(options.fit, budget=seconds),
    )


def from_finer(subject: Subject, finer: Asset) -> Subject:
    """The same subject, whose surface is that of a lighter asset that looks like it: starts are made
    from this one, images and errors stay those of the source."""
    survey = MeshSurvey(MeshReference(subject.placement.local(finer)))
    return replace(subject, survey=survey)


def fit_level(
    made_from: Subject,
    source: Asset,
    options: SimplifyOptions,
    run: Run,
    pixels: int,
    given: LatentMesh | None = None,
) -> Level:
    """One mesh, by default of ``options.start.triangles``, started from ``made_from`` and fitted to
    its images. ``source``: what nodes, names and credits come from; ``given``: see
    ``choose_start``."""
    began = run.watch.total
    start, o = choose_start(made_from, given, options, run)
    run.lap("start")
    model, fitted, error = fit_start(made_from, start, o, run)
    name = f"{source.name}_{len(start.mesh.faces)}"
    exported = export(model, start, made_from, o, Exporter(made_from.placement, source, name))
    run.lap("export")
    took = run.watch.total - began
    return Level(pixels, exported, fitted, start.notes, error, took)


def fit_levels(
    subject: Subject,
    source: Asset,
    triangles: Sequence[int],
    options: LodOptions,
    run: Run,
    kept: KeptLevels | None = None,
    seconds: float | None = None,
) -> list[Level]:
    """The levels, the finest first, within ``seconds`` (None: no limit but the options' steps).
    ``source``: what nodes, names and credits come from. A level that diverged is at its best
    state, and the others are made, too."""
    sizes, shares = options.chain.sizes(), plan_shares(len(triangles))
    out: list[Level] = []
    left = seconds
    for k, (pixels, count) in enumerate(zip(sizes, triangles, strict=True)):
        began = run.watch.total
        share = None if left is None else left * shares[k] / sum(shares[k:])
        o = level_options(options, pixels, count, share)
        done = kept is not None and kept.done > k
        if o.fit.steps is not None:
            o = replace(o, fit=replace(o.fit, steps=round(o.fit.steps * shares[k] / shares[0])))
        if done:  # its state is taken as it is
            o = replace(o, fit=replace(o.fit, steps=0))
        run.begin(f"level {k}: {count:,} triangles for {pixels} pixels")
        level_run = replace(
            run,
            budget=None if share is None else began + share,
            checkpointer=None if kept is None else kept.checkpointer(k),
            with_report=False,
        )
        made_from = subject if not out else from_finer(subject, out[-1].asset)
        level = fit_level(made_from, source, o, level_run, pixels)
        out.append(level)
        if kept is not None and not level.fit.interrupted:
            kept.finish(k)
        left = None if left is None else max(left - (run.watch.total - began), 0.0)
    return out


CHAIN_FILE = "chain.npz"


@dataclass(frozen=True)
class Finished:
    """``count``: levels that are complete."""

    count: int


class KeptLevels:
    """Checkpoints of several fits in ``folder``: one folder for each of ``count``, called ``name``
    and its number, and a file that says how many are complete. ``fingerprint``, ``resume``,
    ``interval``: see ``Checkpointer``. Raises InputError for a folder that holds anything else."""

    def __init__(
        self,
        folder: Path,
        fingerprint: str,
        resume: bool,
        interval: float,
        count: int,
        name: str = "level",
    ) -> None:
        self.folder, self._fingerprint, self._resume = folder, fingerprint, resume
        self._interval, self._name, self.done = interval, name, 0
        folder.mkdir(parents=True, exist_ok=True)
        known = {CHAIN_FILE, *(f"{name}{k}" for k in range(count))}
        for path in folder.iterdir():
            if path.name not in known and not path.name.startswith("."):
                raise InputError(
                    f"{folder}: holds '{path.name}', which is no checkpoint of this job; choose "
                    "an empty folder or a new one"
                )
        path = folder / CHAIN_FILE
        if not resume:
            path.unlink(missing_ok=True)
        elif path.exists():
            try:
                self.done = archive.read(path, fingerprint, (Finished,)).count
            except archive.DamagedError as error:
                raise InputError(
                    f"{path}: not a usable checkpoint ({error}); empty the folder to begin anew"
                ) from error

    def checkpointer(self, level: int) -> Checkpointer:
        """Of one level. An unfinished level beyond the first unfinished one cannot exist."""
        folder = self.folder / f"{self._name}{level}"
        resume = self._resume and level <= self.done
        return Checkpointer(folder, f"{self._fingerprint}-{level}", resume, self._interval)

    def finish(self, level: int) -> None:
        """A level is complete."""
        if level + 1 > self.done:
            self.done = level + 1
            path = self.folder / CHAIN_FILE
            try:
                archive.write(path, self._fingerprint, Finished(self.done))
            except OSError as error:  # the chain is worth more than its checkpoint
                log.warning("%s: cannot be written (%s)", path, error.strerror)
