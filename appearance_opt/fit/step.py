"""One step of the fit: images, loss, gradients, Adam."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.backend import to_device
from appearance_opt.fit import adam
from appearance_opt.fit.losses import covered_loss, image_loss
from appearance_opt.fit.model import TEXELS, Model
from appearance_opt.render import gradient

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.fit.laplacian import Laplacian
    from appearance_opt.fit.losses import Loss
    from appearance_opt.reference.pool import Targets
    from appearance_opt.render.deferred import Grid
    from appearance_opt.render.gradient import Quality
    from appearance_opt.views import Views


@dataclass(frozen=True)
class StepInputs:
    """What a step sees: ``views`` and their ``reference`` images (flat, on the device), the
    ``background`` behind each view (B, 3) linear, and the current weights and rate. ``want_loss``: the gradient
    does not need the value of the loss; evaluating it shades all samples once more."""

    views: Views
    reference: Targets
    background: np.ndarray
    laplacian_weight: float
    rate: float
    seed: int
    want_loss: bool = True


@dataclass(frozen=True)
class StepResult:
    """``loss``: mean image loss, or None when it was not wanted. ``bad``: name of the parameter whose gradient
    was not finite (nothing was changed then), or None."""

    loss: float | None
    bad: str | None


def gradients(
    model: Model, grid: Grid, quality: Quality, loss: Loss, laplacian: Laplacian | None, inputs: StepInputs
) -> tuple[mi.Float, dict[str, mi.Float]]:
    """Mean image loss (width 1; only part of it without ``want_loss``) and the gradient of every parameter."""
    records = inputs.views.records()
    layer = model.fitted_layer()
    shape = model.track(model.shape())
    posed = model.drawn.pose(shape)
    moving = dr.grad_enabled(posed)
    surface = model.surface(posed)
    if layer is not None:
        dr.enable_grad(layer.pyramid.texels)
    maps = model.maps(layer)
    edges = model.topology.edges
    frame = gradient.render(model.scene, surface, maps, edges, records, grid, quality, inputs.seed, defer=True)
    behind = np.concatenate([inputs.background, np.zeros((len(inputs.background), 1))], axis=1)
    background = to_device(behind)
    per_view = dr.opaque(mi.UInt32, grid.resolution**2)

    average = inputs.reference.average
    points = average if inputs.reference.points is None else inputs.reference.points

    def pixel_loss(color: mi.Color3f, pixel: mi.UInt32) -> mi.Float:
        return covered_loss(loss, color, pixel, points, background, per_view)

    value, by_image = image_loss(loss, frame.image, average, background, per_view, frame.complete())
    terms = gradient.surrogate(frame, surface, maps, edges, by_image)
    direct = gradient.direct(frame, surface, maps, pixel_loss)
    if direct is not None:
        terms.append(direct)
    if moving and laplacian is not None:
        terms.append(laplacian.per_vertex(posed) * dr.opaque(mi.Float, inputs.laplacian_weight))
    gradient.backward(terms)
    if direct is not None and inputs.want_loss:
        value += dr.sum(dr.detach(direct))
    out = model.shape_gradients(shape)
    if layer is not None and model.codec is not None:
        out[TEXELS] = model.codec.pull_back(dr.grad(layer.pyramid.texels), model.parameters[TEXELS].value)
    dr.eval(value, out)
    return value, out


def step(
    model: Model,
    moments: dict[str, adam.Moments],
    grid: Grid,
    quality: Quality,
    loss: Loss,
    laplacian: Laplacian | None,
    inputs: StepInputs,
    check: Callable[[dict[str, mi.Float]], str | None],
) -> StepResult:
    """Advance every parameter once. Nothing moves when ``check`` names a bad gradient."""
    value, grads = gradients(model, grid, quality, loss, laplacian, inputs)
    bad = check(grads)
    if bad is None:
        for name, parameter in model.parameters.items():
            parameter.value, moments[name] = adam.update(parameter, grads[name], moments[name], inputs.rate)
        model.update_scene()
    return StepResult(float(value[0]) if inputs.want_loss else None, bad)


def first_non_finite(grads: dict[str, mi.Float]) -> str | None:
    """Name of the first parameter with a NaN or infinite gradient, or None. A sum is finite only if all
    its terms are: one reduction instead of a test per element."""
    sums = {name: dr.sum(g) for name, g in grads.items()}
    dr.eval(sums)
    for name, total in sums.items():
        if not np.isfinite(float(total[0])):
            return name
    return None
