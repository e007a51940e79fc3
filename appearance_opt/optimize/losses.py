"""Image losses: per-pixel values and their derivative by the rendered image.

All work on linear radiance composited over a background, and are averaged over pixels and channels
by the caller.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.backend import to_device
from appearance_opt.errors import InputError
from appearance_opt.render.gradient import backward
from appearance_opt.render.math import at_least, at_most

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Loss = Callable[[mi.Color3f, mi.Color3f], mi.Color3f]


def srgb(x: mi.Color3f) -> mi.Color3f:
    """sRGB transfer function (IEC 61966-2-1), continued above 1."""
    return dr.select(
        x <= 0.0031308, 12.92 * x, 1.055 * dr.power(at_least_color(x, 0.0031308), 1 / 2.4) - 0.055
    )


def tone_map(x: mi.Color3f) -> mi.Color3f:
    """x' = srgb(log(x + 1)): Hasselgren et al. 2021, equation 4."""
    return srgb(log1p(at_least_color(x, 0)))


def log1p(x: mi.Color3f) -> mi.Color3f:
    """log(1 + x) of non-negative x with all digits of small ones: by its series below 0.1 (error
    2e-8)."""
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


@dataclass(frozen=True)
class Target:
    """What a batch of images is compared with: ``reference`` (pixels * 4) premultiplied linear RGB
    and coverage; ``background`` (views * 4) linear RGB and padding, the colour behind each view;
    ``pixels_per_view``; ``share``: of one channel of a pixel in the mean over all."""

    reference: mi.Float
    background: mi.Float
    pixels_per_view: mi.UInt32
    share: mi.Float

    @classmethod
    def of(cls, reference: mi.Float, background: NDArray) -> Target:
        """The target of reference images before a background (views, 3)."""
        pixels = dr.width(reference) // 4
        padded = np.concatenate([background, np.zeros((len(background), 1))], axis=1)
        per_view = dr.opaque(mi.UInt32, pixels // len(background))
        return cls(reference, to_device(padded), per_view, dr.opaque(mi.Float, 1 / (3 * pixels)))

    def colors(self, pixel: mi.UInt32) -> tuple[mi.Color3f, mi.Color3f]:
        """(reference composited over its background, background) of pixels."""
        count = dr.width(pixel)
        b = dr.gather(mi.ArrayXf, self.background, pixel // self.pixels_per_view, shape=(4, count))
        behind = mi.Color3f(b[0], b[1], b[2])
        return _over(dr.gather(mi.ArrayXf, self.reference, pixel, shape=(4, count)), behind), behind


def covered_loss(loss: Loss, target: Target, color: mi.Color3f, pixel: mi.UInt32) -> mi.Float:
    """Share of the mean loss of a batch that falls on fully covered pixels of radiance ``color``,
    one value per pixel, differentiable."""
    return _sum_channels(loss(color, target.colors(pixel)[0])) * target.share


def compared_pixels(image: mi.Float, target: Target, complete: mi.Bool | None = None) -> mi.UInt32:
    """Indices of the pixels of an image (pixels * 4) that can differ from the target: where neither
    is covered both show the background. ``complete``: (pixels,) pixels to look at (all)."""
    i = dr.arange(mi.UInt32, dr.width(image) // 4)
    either = (dr.gather(mi.Float, image, 4 * i + 3) > 0) | (
        dr.gather(mi.Float, target.reference, 4 * i + 3) > 0
    )
    return dr.compress(either if complete is None else either & complete)


def image_loss(
    loss: Loss, target: Target, image: mi.Float, pixels: mi.UInt32, total: int
) -> tuple[mi.Float, mi.Float]:
    """Loss of some ``pixels`` (indices, at least one) of an image of ``total`` pixels
    (premultiplied linear RGB and coverage), and its derivative by the image. Returns (values, one
    per entry of ``pixels``, whose sum is their share of the mean over all pixels; gradient as wide
    as ``image``)."""
    value = dr.gather(mi.ArrayXf, dr.detach(image), pixels, shape=(4, dr.width(pixels)))
    dr.enable_grad(value)
    reference, behind = target.colors(pixels)
    share = _sum_channels(loss(_over(value, behind), reference)) * target.share
    backward([share])
    gradient = dr.zeros(mi.Float, total * 4)
    dr.scatter(gradient, dr.grad(value), pixels, mode=dr.ReduceMode.Permute)
    return dr.detach(share), gradient


def _sum_channels(color: mi.Color3f) -> mi.Float:
    return color.x + color.y + color.z


def _over(premultiplied: mi.ArrayXf, background: mi.Color3f) -> mi.Color3f:
    color = mi.Color3f(premultiplied[0], premultiplied[1], premultiplied[2])
    return color + background * (1 - premultiplied[3])
