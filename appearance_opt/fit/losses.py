"""Image losses: per-pixel values and their derivative by the rendered image.

All work on linear radiance composited over a background, and are averaged over pixels and channels by
the caller.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.errors import InputError
from appearance_opt.render.math import at_least, at_most

if TYPE_CHECKING:
    from collections.abc import Callable

    Loss = Callable[[mi.Color3f, mi.Color3f], mi.Color3f]


def srgb(x: mi.Color3f) -> mi.Color3f:
    """sRGB transfer function (IEC 61966-2-1), continued above 1."""
    return dr.select(x <= 0.0031308, 12.92 * x, 1.055 * dr.power(at_least_color(x, 0.0031308), 1 / 2.4) - 0.055)


def tone_map(x: mi.Color3f) -> mi.Color3f:
    """x' = srgb(log(x + 1)): Hasselgren et al. 2021, equation 4."""
    return srgb(log1p(at_least_color(x, 0)))


def log1p(x: mi.Color3f) -> mi.Color3f:
    """log(1 + x) of non-negative x with all digits of small ones: by its series below 0.1 (error 2e-8)."""
    small = at_most_color(x, 0.1)
    series = mi.Color3f(1 / 7)
    for k in range(6, 0, -1):
        series = 1 / k - small * series
    return dr.select(x < 0.1, small * series, dr.log(x + 1))


def at_least_color(x: mi.Color3f, low: float) -> mi.Color3f:
    """Per-channel lower bound."""
    return mi.Color3f(at_least(x.x, low), at_least(x.y, low), at_least(x.z, low))


def at_most_color(x: mi.Color3f, high: float) -> mi.Color3f:
    """Per-channel upper bound."""
    return mi.Color3f(at_most(x.x, high), at_most(x.y, high), at_most(x.z, high))


def log_srgb_l1(image: mi.Color3f, reference: mi.Color3f) -> mi.Color3f:
    """|T(image) - T(reference)| with the paper's tone map T: the default."""
    return dr.abs(tone_map(image) - tone_map(reference))


def log_srgb_l2(image: mi.Color3f, reference: mi.Color3f) -> mi.Color3f:
    """Squared difference of tone-mapped values."""
    return dr.square(tone_map(image) - tone_map(reference))


def l1(image: mi.Color3f, reference: mi.Color3f) -> mi.Color3f:
    """Absolute difference of linear radiance."""
    return dr.abs(image - reference)


def l2(image: mi.Color3f, reference: mi.Color3f) -> mi.Color3f:
    """Squared difference of linear radiance (the paper's choice for foliage)."""
    return dr.square(image - reference)


def smape(image: mi.Color3f, reference: mi.Color3f) -> mi.Color3f:
    """|a - b| / (|a| + |b| + 0.01): symmetric relative error."""
    return dr.abs(image - reference) / (dr.abs(image) + dr.abs(reference) + 0.01)


def relative_l2(image: mi.Color3f, reference: mi.Color3f) -> mi.Color3f:
    """(a - b)^2 / (a^2 + b^2 + 0.01): symmetric relative squared error."""
    return dr.square(image - reference) / (dr.square(image) + dr.square(reference) + 0.01)


LOSSES: dict[str, Loss] = {
    "log-srgb-l1": log_srgb_l1,
    "log-srgb-l2": log_srgb_l2,
    "l1": l1,
    "l2": l2,
    "smape": smape,
    "relative-l2": relative_l2,
}


def loss_of_name(name: str) -> Loss:
    """The loss of that name. Raises InputError for another."""
    if name not in LOSSES:
        raise InputError(f"unknown loss '{name}': choose one of {', '.join(LOSSES)}")
    return LOSSES[name]


def covered_loss(
    loss: Loss,
    color: mi.Color3f,
    pixel: mi.UInt32,
    reference: mi.Float,
    background: mi.Float,
    pixels_per_view: int | mi.UInt32,
) -> mi.Float:
    """Share of the mean loss of a batch that falls on fully covered pixels of radiance ``color``, one value per
    pixel, differentiable. The other arguments as for ``image_loss``."""
    count = dr.width(pixel)
    behind = dr.gather(mi.ArrayXf, background, pixel // pixels_per_view, shape=(4, count))
    target = dr.gather(mi.ArrayXf, reference, pixel, shape=(4, count))
    per_pixel = loss(color, _over(target, mi.Color3f(behind[0], behind[1], behind[2])))
    scale = dr.opaque(mi.Float, 4 / (3 * dr.width(reference)))
    return (per_pixel.x + per_pixel.y + per_pixel.z) * scale


def image_loss(
    loss: Loss,
    image: mi.Float,
    reference: mi.Float,
    background: mi.Float,
    pixels_per_view: int | mi.UInt32,
    complete: mi.Bool | None = None,
) -> tuple[mi.Float, mi.Float]:
    """Mean loss over a batch, and its derivative by the image.

    ``image``, ``reference``: (pixels * 4) premultiplied linear RGB and coverage. ``background``:
    (views * 4) linear RGB and padding, the colour behind each view. ``complete``: (pixels,) pixels to look at
    (all). Returns (width-1 loss, gradient as wide as ``image``).
    """
    total = dr.width(image) // 4
    i = dr.arange(mi.UInt32, total)
    # where neither image is covered both show the background: no loss, no gradient, no work
    either = (dr.gather(mi.Float, image, 4 * i + 3) > 0) | (dr.gather(mi.Float, reference, 4 * i + 3) > 0)
    i = dr.compress(either if complete is None else either & complete)
    count = dr.width(i)
    gradient = dr.zeros(mi.Float, total * 4)
    if count == 0:
        return mi.Float(0), gradient
    behind = dr.gather(mi.ArrayXf, background, i // pixels_per_view, shape=(4, count))
    target = dr.gather(mi.ArrayXf, reference, i, shape=(4, count))
    value = dr.gather(mi.ArrayXf, dr.detach(image), i, shape=(4, count))
    dr.enable_grad(value)
    b = mi.Color3f(behind[0], behind[1], behind[2])
    per_pixel = loss(_over(value, b), _over(target, b))
    mean = dr.sum(per_pixel.x + per_pixel.y + per_pixel.z) * dr.opaque(mi.Float, 1 / (3 * total))
    dr.backward(mean)
    dr.scatter(gradient, dr.grad(value), i, mode=dr.ReduceMode.Permute)
    return dr.detach(mean), gradient


def _over(premultiplied: mi.ArrayXf, background: mi.Color3f) -> mi.Color3f:
    color = mi.Color3f(premultiplied[0], premultiplied[1], premultiplied[2])
    return color + background * (1 - premultiplied[3])
