"""The loop: draw views, step, look at held-out views now and then, keep the best state."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from appearance_opt.errors import DivergedError
from appearance_opt.optimize import adam
from appearance_opt.optimize.checkpoint import Checkpointer, FitState
from appearance_opt.optimize.losses import loss_of_name
from appearance_opt.optimize.schedule import Clock, laplacian_weight, learning_rate
from appearance_opt.optimize.step import Gradients, StepInputs, StepResult, first_non_finite, step
from appearance_opt.optimize.validation import Validation
from appearance_opt.render.display import BACKGROUND as GREY
from appearance_opt.render.pixels import Grid
from appearance_opt.render.quality import Quality

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from appearance_opt.latent.latent import Latent
    from appearance_opt.latent.parts import Guard
    from appearance_opt.reference.pool import ReferencePool

T = TypeVar("T")

log = logging.getLogger(__name__)

MAX_BAD_STEPS = 10
"""Consecutive steps with non-finite gradients after which a fit gives up."""

LOOKING = 0.1
"""Largest part of a time budget that is spent on looking at the held-out views: short fits look
less often."""

LOSS_EVERY = 8
"""Steps between two evaluations of the loss: it is only shown, the gradient does not need it."""

FIXED_BACKGROUNDS = {"black": (0.0,) * 3, "white": (1.0,) * 3, "grey": (GREY,) * 3}
"""Linear RGB."""

Background = str | tuple[float, float, float]
"""random, black, white, grey, or linear RGB."""


@dataclass(frozen=True)
class FitOptions:
    """How to fit. ``steps``/``seconds``: when to stop (at least one, or ValueError). ``loss``: a
    name of ``losses.LOSSES``. ``laplacian``: weight relative to the first image loss, at a
    deviation of a tenth of an edge length (0: none). ``relative``: the start is a likeness: hold
    its Laplacian rather than 0, and hand out no triangle that has turned over since (see
    ``latent.folds``). ``decay``: powers of ten by which the rates fall over the fit. ``background``:
    behind latent and reference. ``quality``: how the latent is sampled; its point width is the
    pool's. ``validate_every``: fraction of the fit between looks at the held-out views. ``seed``:
    of backgrounds, tessellation levels and silhouette points; views have the sampler's."""

    steps: int | None = None
    seconds: float | None = None
    loss: str = "log-srgb-l1"
    laplacian: float = 0.25
    relative: bool = True
    decay: float = 1.5
    background: Background = "random"
    quality: Quality = field(default_factory=Quality)
    validate_every: float = 0.125
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps is None and self.seconds is None:
            raise ValueError("a fit needs an end: steps, seconds, or both")


@dataclass(frozen=True)
class CurvePoint:
    """A look at the held-out views: seconds of fitting, iteration, PSNR in dB, latest loss."""

    seconds: float
    step: int
    psnr: float
    loss: float


@dataclass
class FitResult:
    """What a fit did. The model is left at its best state by held-out PSNR, the start included.
    ``unfolded``: triangles of that state that had turned over and were turned back."""

    curve: list[CurvePoint] = field(default_factory=list)
    steps: int = 0
    skipped: int = 0
    seconds: float = 0.0
    interrupted: bool = False
    best_step: int = 0
    unfolded: int = 0

    def notes(self) -> list[str]:
        """What the user should know about it, a line each."""
        out = []
        if self.skipped:
            out.append(f"{self.skipped} steps with non-finite gradients were skipped")
        if self.unfolded:
            out.append(f"{self.unfolded} triangles that the fit had turned over were turned back")
        if self.interrupted:
            out.append(f"interrupted after {self.steps} steps: this is the best state so far")
        return out


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


def fit(
    latent: Latent,
    pool: ReferencePool,
    validation: Validation,
    options: FitOptions,
    progress: Progress | None = None,
    checkpointer: Checkpointer | None = None,
    stop: Callable[[], bool] | None = None,
) -> FitResult:
    """Fit the model to the pool's reference. ``stop``: asked before every step whether the fit
    shall end early. A KeyboardInterrupt ends it in the same way. Raises DivergedError (the model
    then holds the best state)."""
    run = _Run(latent, pool, validation, options, progress, checkpointer)
    try:
        if run.state.best is None:
            run.look()
        while not run.clock.done(run.state.iteration):
            if stop is not None and stop():
                raise KeyboardInterrupt
            run.advance()
    except KeyboardInterrupt:
        log.warning("interrupted at step %d: the best state so far is kept", run.state.iteration)
        run.result.interrupted = True
        latent.update_scene()  # the step that was interrupted may have moved the parameters, but not yet the mesh
    except DivergedError:
        run.finish(look=False)
        raise
    run.finish(look=True)
    return run.result


class _Run:
    """The only mutable state of a fit."""

    def __init__(
        self,
        latent: Latent,
        pool: ReferencePool,
        validation: Validation,
        options: FitOptions,
        progress: Progress | None,
        checkpointer: Checkpointer | None,
    ) -> None:
        self.latent, self.pool, self.validation, self.options = latent, pool, validation, options
        self.progress, self.checkpointer = progress, checkpointer
        self.loss = loss_of_name(options.loss)
        self.grid = Grid(pool.batch, pool.resolution)
        # points can only be compared if both sides filter alike
        self.quality = replace(options.quality, point_width=pool.point_width)
        self.result = FitResult()
        self.state = FitState(moments={n: adam.moments_of(p) for n, p in latent.parameters.items()})
        self.laplacians = latent.laplacians(options.relative) if options.laplacian > 0 else {}
        self.guards: dict[str, Guard] = latent.guards() if options.relative else {}
        if checkpointer is not None and checkpointer.restore(latent, self.state):
            self.result.curve = [CurvePoint(*p) for p in self.state.curve]
        self.gradients = Gradients(latent, self.grid, self.quality, self.loss, self.laplacians)
        self.clock = Clock(options.steps, options.seconds, self.state.seconds)
        self.bad_steps = 0
        self.psnr = self.state.best_psnr
        # looks happen at the same iterations whether a run was resumed or not
        looks = math.floor(self.clock.progress(self.state.iteration) / options.validate_every)
        self.next_look = (looks + 1) * options.validate_every

    def advance(self) -> None:
        """One iteration."""
        state, options = self.state, self.options
        fraction = self.clock.progress(state.iteration)
        views, reference = self.pool.draw(state.iteration)
        self.latent.select(pose_of(self.latent.poses, options.seed, state.iteration))
        inputs = StepInputs(
            views=views,
            reference=reference,
            background=backgrounds(options.background, len(views), options.seed, state.iteration),
            laplacian_weight=laplacian_weight(state.laplacian, fraction),
            rate=learning_rate(fraction, options.decay),
            seed=seed_of(options.seed, state.iteration),
            want_loss=state.iteration % LOSS_EVERY == 0
            or (bool(self.laplacians) and state.laplacian == 0),
        )
        done = step(self.gradients, state.moments, inputs, first_non_finite)
        self._count(done.bad)
        if done.bad is None and done.loss is not None:
            state.loss = done.loss
            if state.laplacian == 0 and self.latent.pose.level in self.laplacians:
                # a deviation of a tenth of an edge length costs this fraction of the first image
                # loss
                state.laplacian = options.laplacian * done.loss / 0.01
        self._commit(done)
        if self.clock.progress(state.iteration) >= self.next_look and not self.clock.done(
            state.iteration
        ):
            self._look_and_pause()
        self._report()
        if self.checkpointer is not None and self.checkpointer.due():
            self.save()

    def _look_and_pause(self) -> None:
        """A look, and when to look again."""
        began = self.clock.time()
        self.look()
        self.next_look += self.options.validate_every
        if self.options.seconds:
            pause = (self.clock.time() - began) / (LOOKING * self.options.seconds)
            self.next_look = max(self.next_look, self.clock.progress(self.state.iteration) + pause)

    def look(self) -> None:
        """Render the held-out views; remember the state if it is the best so far."""
        state = self.state
        unfolded = self._unfold()
        current = self.latent.values()
        means = {name: moments.mean for name, moments in state.moments.items()}
        try:
            self.latent.restore(means)
            self.psnr = self.validation.psnr(self.latent)
        finally:  # an interrupted look must not leave the means where a checkpoint takes them for the parameters
            self.latent.restore(current)
        point = CurvePoint(self.clock.time(), state.iteration, self.psnr, state.loss)
        if not self.result.curve or self.result.curve[-1].step != state.iteration:
            self.result.curve.append(point)
        if state.best is None or self.psnr > state.best_psnr:
            state.best, state.best_psnr, state.best_iteration = means, self.psnr, state.iteration
            state.unfolded = unfolded

    def _unfold(self) -> int:
        """Turn folded triangles back, of the means and of where the next step starts. How many the
        means had."""
        total = 0
        for name, guard in self.guards.items() if self.state.best is not None else ():
            assert self.state.best is not None
            parameter, moments = self.latent.parameters[name], self.state.moments[name]
            safe = self.state.best[name]
            moments.mean, count = guard.undo(moments.mean, safe)
            parameter.value, _ = guard.undo(parameter.value, safe)
            total += count
        return total

    def finish(self, look: bool) -> None:
        """A last look, then back to the best state."""
        if look:
            self.look()
        if self.checkpointer is not None:
            self.save()
        if self.state.best is not None:
            self.latent.restore(self.state.best)
        self.result.steps = self.state.iteration
        self.result.best_step = self.state.best_iteration
        self.result.unfolded = self.state.unfolded
        self.result.skipped = self.state.skipped
        self.result.seconds = self.clock.time()

    def save(self) -> None:
        """Write a checkpoint."""
        self.state.seconds = self.clock.time()
        self.state.curve = [(p.seconds, p.step, p.psnr, p.loss) for p in self.result.curve]
        if self.checkpointer is not None:
            self.checkpointer.save(self.latent, self.state)

    def _commit(self, done: StepResult) -> None:
        """Take the step, or only count it if its gradient was bad. Values, moments and iteration
        change together, before anything slow."""
        self.latent.assign(done.values)
        self.state.moments.update(done.moments)
        self.state.iteration += 1
        if done.values:
            self.latent.update_scene()

    def _count(self, bad: str | None) -> None:
        if bad is None:
            self.bad_steps = 0
            return
        self.state.skipped += 1
        self.bad_steps += 1
        log.warning(
            "step %d skipped: the gradient of '%s' is not finite", self.state.iteration, bad
        )
        if self.bad_steps >= MAX_BAD_STEPS:
            raise DivergedError(
                f"the gradient of '{bad}' was not finite for {self.bad_steps} steps up to iteration "
                f"{self.state.iteration}: lower its learning rate, or check the reference's images"
            )

    def _report(self) -> None:
        if self.progress is None:
            return
        state = self.state
        seconds = self.clock.time()
        fraction = self.clock.progress(state.iteration)
        left = seconds * (1 - fraction) / fraction if fraction > 0 else None
        self.progress.update(
            state.iteration,
            fraction,
            state.loss,
            self.psnr,
            state.iteration / max(seconds, 1e-9),
            left,
        )


def seed_of(seed: int, iteration: int) -> int:
    """Seed of an iteration's silhouette points: 32 bits, the same whenever it is replayed."""
    return int(np.random.default_rng([seed, 17, iteration]).integers(2**32))


def pose_of(poses: Sequence[T], seed: int, iteration: int) -> T:
    """The pose of an iteration: drawn at random, the same whenever it is replayed."""
    if len(poses) == 1:
        return poses[0]
    return poses[int(np.random.default_rng([seed, 13, iteration]).integers(len(poses)))]


def backgrounds(
    background: Background, count: int, seed: int, iteration: int
) -> NDArray[np.float32]:
    """(count, 3) linear colours behind the views of an iteration. Random ones make every silhouette
    visible, whatever the colour of the object."""
    if background == "random":
        return np.random.default_rng([seed, 7, iteration]).random((count, 3)).astype(np.float32)
    color = FIXED_BACKGROUNDS[background] if isinstance(background, str) else background
    return np.tile(np.asarray(color, np.float32), (count, 1))
