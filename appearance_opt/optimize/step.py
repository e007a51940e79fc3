"""One step of the fit: images, loss, gradients, Adam."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.latent.parts import Pose
from appearance_opt.optimize import adam
from appearance_opt.optimize.losses import Target, compared_pixels, covered_loss, image_loss
from appearance_opt.render import gradient
from appearance_opt.render.drawn import Shown
from appearance_opt.render.freezing import Frozen, traced
from appearance_opt.render.pixels import Batch

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from appearance_opt.latent.laplacian import Laplacian
    from appearance_opt.latent.latent import Decoded, Latent, Values
    from appearance_opt.optimize.losses import Loss
    from appearance_opt.reference.pool import Targets
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.pixels import Grid
    from appearance_opt.render.quality import Quality
    from appearance_opt.render.surface import Surface
    from appearance_opt.views import Views


@dataclass(frozen=True)
class StepInputs:
    """What a step sees: ``views`` and their ``reference`` images (flat, on the device), the
    ``background`` behind each view (B, 3) linear, and the current weights and rate. ``want_loss``:
    the gradient does not need the value of the loss; evaluating it shades all samples once more."""

    views: Views
    reference: Targets
    background: np.ndarray
    laplacian_weight: float
    rate: float
    seed: int
    want_loss: bool = True


@dataclass(frozen=True)
class StepResult:
    """``loss``: mean image loss, or None when it was not wanted. ``bad``: name of the parameter
    whose gradient was not finite, or None. ``values`` and ``moments`` after the step, by parameter;
    both empty if one was bad."""

    loss: float | None
    bad: str | None
    values: dict[str, mi.Float]
    moments: dict[str, adam.Moments]


class Gradients:
    """The gradients of a latent, as a function of the views and images of a step.

    ``laplacians``: the regularizer of each tessellation level, if any. ``freeze``: record the
    kernels of the first steps and launch them again without tracing (see ``render.freezing``);
    results are the same to rounding.
    """

    def __init__(
        self,
        latent: Latent,
        grid: Grid,
        quality: Quality,
        loss: Loss,
        laplacians: Mapping[int, Laplacian] | None = None,
        freeze: bool = True,
    ) -> None:
        self.latent, self.grid, self.loss = latent, grid, loss
        quality = quality.peeling() if latent.seen_through else quality
        self.quality = replace(quality, defer=gradient.DEFERRED)
        self.laplacians = laplacians or {}
        self._edges = {p.level: latent.edges(p, quality.walks) for p in latent.poses}
        self._run: Run = (
            Frozen(latent.fixed(), self.laplacians, grid, self._edges) if freeze else traced
        )

    def __call__(self, inputs: StepInputs) -> tuple[mi.Float | None, Values]:
        """Mean image loss (width 1; None without ``want_loss``) and the gradient of every
        parameter."""
        latent, grid, run, pose = self.latent, self.grid, self._run, self.latent.pose
        target = Target.of(inputs.reference.average, inputs.background)
        stored = latent.values()
        with dr.suspend_grad():
            decoded = run(latent.decode, stored)
            surface = run(self._surface, pose, decoded)
        drawn = latent.drawn(decoded, surface, self.quality.walks)
        batch = Batch(inputs.views.records(), grid)
        rendered = gradient.render(drawn, batch, self.quality, inputs.seed, run)
        # Only averaged pixels have a gradient here. Of one ray per pixel these are the crossed
        # ones; of several rays also those that are covered in part without being crossed. The value
        # of the loss needs all pixels.
        some = rendered.seen.crossed
        if inputs.want_loss or rendered.seen.whole is None or self.quality.samples > 1:
            some = compared_pixels(rendered.image, target, rendered.complete())
        averaged, by_image = None, dr.zeros(mi.Float, 4 * grid.pixels)
        if some is not None and dr.width(some):
            averaged, by_image = run(
                image_loss, self.loss, target, rendered.image, some, grid.pixels
            )
        # what one ray saw is compared with one ray
        points = inputs.reference.points if self.quality.samples == 1 else None
        direct, out = run(
            self._pulled_back,
            pose,
            stored,
            decoded,
            rendered,
            by_image,
            target if points is None else replace(target, reference=points),
            dr.opaque(mi.Float, inputs.laplacian_weight),
            inputs.want_loss,
        )
        value = None
        if inputs.want_loss:
            value = sum((dr.sum(v) for v in (averaged, direct) if v is not None), mi.Float(0))
        dr.eval(value, out)
        return value, out

    def recordings(self) -> int:
        """Recordings made so far; 0 when nothing is frozen."""
        return self._run.recordings() if isinstance(self._run, Frozen) else 0

    def _surface(self, pose: Pose, decoded: Decoded) -> Surface:
        """The surface, without gradients."""
        return self.latent.surface(self.latent.vertices(decoded, pose), pose)

    def _pulled_back(
        self,
        pose: Pose,
        stored: Values,
        decoded: Decoded,
        rendered: gradient.RenderedBatch,
        by_image: mi.Float,
        target: Target,
        laplacian_weight: mi.Float,
        want_loss: bool,
    ) -> tuple[mi.Float | None, Values]:
        """(loss of the deferred pixels, gradient of every parameter)."""
        latent = self.latent
        tracked = latent.track(decoded)
        vertices = latent.vertices(tracked, pose)
        surface = latent.surface(vertices, pose)
        shown = Shown(surface, latent.maps(tracked), self._edges[pose.level])

        def pixel_loss(color: mi.Color3f, pixel: mi.UInt32) -> mi.Float:
            return covered_loss(self.loss, target, color, pixel)

        terms = gradient.surrogate(rendered, shown, by_image)
        direct = gradient.direct(rendered, shown, pixel_loss)
        if direct is not None:
            terms.append(direct)
        if dr.grad_enabled(vertices) and pose.level in self.laplacians:
            rest = vertices if pose.frame is None else latent.vertices(tracked, Pose(pose.level))
            terms.append(self.laplacians[pose.level].per_vertex(rest) * laplacian_weight)
        gradient.backward(terms)
        value = dr.detach(direct) if want_loss and direct is not None else None
        return value, latent.gradients(tracked, stored)


def step(
    gradients: Gradients,
    moments: dict[str, adam.Moments],
    inputs: StepInputs,
    check: Callable[[dict[str, mi.Float]], str | None],
) -> StepResult:
    """Where one step takes every parameter; nothing is moved here, so that an interruption leaves
    no half a step. ``check`` names a bad gradient."""
    value, grads = gradients(inputs)
    bad = check(grads)
    values, after = {}, {}
    if bad is None:
        for name, parameter in gradients.latent.parameters.items():
            values[name], after[name] = adam.update(
                parameter, grads[name], moments[name], inputs.rate
            )
    return StepResult(None if value is None else float(value[0]), bad, values, after)


def first_non_finite(grads: dict[str, mi.Float]) -> str | None:
    """Name of the first parameter with a NaN or infinite gradient, or None. A sum is finite only if
    all its terms are: one reduction instead of a test per element."""
    sums = {name: dr.sum(g) for name, g in grads.items()}
    dr.eval(sums)
    for name, total in sums.items():
        if not np.isfinite(float(total[0])):
            return name
    return None
