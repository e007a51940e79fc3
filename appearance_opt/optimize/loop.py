"""The loop: step as planned, look at held-out views now and then, keep the best state."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

from appearance_opt.errors import DivergedError
from appearance_opt.optimize import adam
from appearance_opt.optimize.losses import loss_of_name
from appearance_opt.optimize.observers import Running
from appearance_opt.optimize.plan import Plan
from appearance_opt.optimize.schedule import Clock
from appearance_opt.optimize.state import CurvePoint, FitState
from appearance_opt.optimize.step import Gradients, StepInputs, StepResult, first_non_finite, step
from appearance_opt.render.pixels import Grid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from appearance_opt.latent.latent import Latent
    from appearance_opt.optimize.observers import Observer
    from appearance_opt.optimize.plan import FitOptions
    from appearance_opt.reference.pool import ReferencePool

log = logging.getLogger(__name__)

MAX_BAD_STEPS = 10
"""Consecutive steps with non-finite gradients after which a fit gives up."""

LOOKING = 0.1
"""Largest part of a time budget that is spent on looking at the held-out views: short fits look
less often."""

DEVIATION = 0.01
"""What a deviation of a tenth of an edge length costs in the regularizer, before it is weighed."""


class Judge(Protocol):
    """How good a latent is: ``Validation``."""

    def psnr(self, latent: Latent) -> float:
        """In dB."""
        ...


@dataclass
class FitResult:
    """What a fit did. The latent is left at its best state by held-out PSNR, the start included.
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


def fit(
    latent: Latent,
    pool: ReferencePool,
    judge: Judge,
    options: FitOptions,
    observers: Sequence[Observer] = (),
    plan: Plan | None = None,
) -> FitResult:
    """Fit the latent to the pool's reference, by default as ``options`` plan it. Observers may end
    it before any step; so does a KeyboardInterrupt. Raises DivergedError (the latent then holds the
    best state)."""
    run = FitRun(latent, pool, judge, options, observers, plan)
    interrupted = False
    try:
        if run.state.best is None:
            run.look()
        while not run.clock.done(run.state.iteration):
            if run.wanted_to_end():
                raise KeyboardInterrupt
            run.advance()
    except KeyboardInterrupt:
        log.warning("interrupted at step %d: the best state so far is kept", run.state.iteration)
        interrupted = True
        # the step that was interrupted may have moved the parameters, but not yet the mesh
        latent.update_scene()
    except DivergedError:
        run.finish()
        raise
    run.look()
    return replace(run.finish(), interrupted=interrupted)


class FitRun:
    """A fit, step by step: its ``state`` and the latent are all that it changes."""

    def __init__(
        self,
        latent: Latent,
        pool: ReferencePool,
        judge: Judge,
        options: FitOptions,
        observers: Sequence[Observer] = (),
        plan: Plan | None = None,
    ) -> None:
        self.latent, self.pool, self.judge, self.options = latent, pool, judge, options
        self.plan = plan or Plan.of(options, latent.poses, pool.batch)
        self.state = FitState({n: adam.moments_of(p) for n, p in latent.parameters.items()})
        laplacians = latent.laplacians(options.relative) if options.laplacian > 0 else {}
        self._guards = latent.guards() if options.relative else {}
        for observer in observers:
            observer.begin(latent, self.state)
        # points can only be compared if both sides filter alike
        quality = replace(options.quality, point_width=pool.point_width)
        grid, loss = Grid(pool.batch, pool.resolution), loss_of_name(options.loss)
        self.gradients = Gradients(latent, grid, quality, loss, laplacians)
        self.clock = Clock(options.steps, options.seconds, self.state.seconds)
        self._observers, self._running = observers, Running(latent, self.state, self.clock)
        self._bad_steps = 0
        # looks happen at the same iterations whether a run was resumed or not
        looks = math.floor(self.clock.progress(self.state.iteration) / options.validate_every)
        self._next_look = (looks + 1) * options.validate_every

    def wanted_to_end(self) -> bool:
        """Does an observer want the fit to end?"""
        return any(observer.ends(self._running) for observer in self._observers)

    def advance(self) -> None:
        """Take one step, and look if it is time to."""
        state, laplacians = self.state, self.gradients.laplacians
        views, reference = self.pool.draw(state.iteration)
        plan = self.plan.at(state.iteration, self.clock.progress(state.iteration))
        shown = reference.frame  # of an animation the images say which
        self.latent.select(plan.pose if shown is None else self.latent.poses[shown])
        inputs = StepInputs(
            views=views,
            reference=reference,
            background=plan.background,
            laplacian_weight=plan.laplacian * state.laplacian,
            rate=plan.rate,
            seed=plan.seed,
            want_loss=plan.want_loss or (bool(laplacians) and state.laplacian == 0),
        )
        done = step(self.gradients, state.moments, inputs, first_non_finite)
        self._count(done.bad)
        if done.bad is None and done.loss is not None:
            state.loss = done.loss
            if laplacians and state.laplacian == 0:
                state.laplacian = self.options.laplacian * done.loss / DEVIATION
        self._commit(done)
        done_part = self.clock.progress(state.iteration)
        if done_part >= self._next_look and not self.clock.done(state.iteration):
            self._look_and_pause()
        state.seconds = self.clock.time()
        for observer in self._observers:
            observer.stepped(self._running)

    def look(self) -> None:
        """Render the held-out views; remember the state if it is the best so far."""
        state = self.state
        unfolded = self._keep_in_order()
        current = self.latent.values()
        means = {name: moments.mean for name, moments in state.moments.items()}
        try:
            self.latent.restore(means)
            state.psnr = self.judge.psnr(self.latent)
        finally:
            # an interrupted look must not leave the means where a checkpoint takes them for the
            # parameters
            self.latent.restore(current)
        state.seconds = self.clock.time()
        if not state.curve or state.curve[-1].step != state.iteration:
            point = CurvePoint(state.seconds, state.iteration, state.psnr, state.loss)
            state.curve.append(point)
        if state.best is None or state.psnr > state.best_psnr:
            state.best, state.best_psnr, state.best_iteration = means, state.psnr, state.iteration
            state.unfolded = unfolded
        for observer in self._observers:
            observer.looked(self._running)

    def finish(self) -> FitResult:
        """Go back to the best state; what the fit did."""
        state = self.state
        state.seconds = self.clock.time()
        for observer in self._observers:
            observer.ended(self._running)
        if state.best is not None:
            self.latent.restore(state.best)
        return FitResult(
            state.curve,
            state.iteration,
            state.skipped,
            self.clock.time(),
            best_step=state.best_iteration,
            unfolded=state.unfolded,
        )

    def _look_and_pause(self) -> None:
        """A look, and when to look again."""
        began = self.clock.time()
        self.look()
        self._next_look += self.options.validate_every
        if self.options.seconds:
            pause = (self.clock.time() - began) / (LOOKING * self.options.seconds)
            progress = self.clock.progress(self.state.iteration)
            self._next_look = max(self._next_look, progress + pause)

    def _keep_in_order(self) -> int:
        """Undo what guards find wrong, in the means and where the next step starts. How much the
        means had of it."""
        best, total = self.state.best, 0
        if best is None:
            return 0
        for name, guard in self._guards.items():
            parameter, moments = self.latent.parameters[name], self.state.moments[name]
            moments.mean, count = guard.undo(moments.mean, best[name])
            parameter.value, _ = guard.undo(parameter.value, best[name])
            total += count
        return total

    def _commit(self, done: StepResult) -> None:
        """Take the step, or only count it if its gradient was bad. Values, moments and iteration
        change together, before anything slow."""
        self.latent.assign(done.values)
        self.state.moments.update(done.moments)
        self.state.iteration += 1
        if done.values:
            self.latent.update_scene()

    def _count(self, bad: str | None) -> None:
        """Count steps with a bad gradient; too many in a row raise DivergedError."""
        if bad is None:
            self._bad_steps = 0
            return
        self.state.skipped += 1
        self._bad_steps += 1
        iteration = self.state.iteration
        log.warning("step %d skipped: the gradient of '%s' is not finite", iteration, bad)
        if self._bad_steps >= MAX_BAD_STEPS:
            raise DivergedError(
                f"the gradient of '{bad}' was not finite for {self._bad_steps} steps up to "
                f"iteration {iteration}: lower its learning rate, or check the reference's images"
            )
