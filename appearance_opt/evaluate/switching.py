"""At which size on screen a coarser level takes over, and how much that shows."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.evaluate.metrics import compare_images, halve

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from appearance_opt.evaluate.metrics import Metrics
    from appearance_opt.options.bound import Bound
    from appearance_opt.views import Views

SMALLEST = 16
"""Pixels of the smallest images that are compared; FLIP's filters are about as wide."""


@dataclass(frozen=True)
class ErrorAt:
    """How different two assets look at a size of so many ``pixels``: means over views."""

    pixels: int
    silhouette_shift: float
    flip: float
    psnr_covered: float
    noticed: float


def errors_by_size(
    reference: NDArray, candidate: NDArray, smallest: int = SMALLEST
) -> list[ErrorAt]:
    """Of (B, H, W, 4) images, the largest first, and of halves of their size down to
    ``smallest``."""
    out: list[ErrorAt] = []
    while True:
        out.append(_at(reference.shape[1], compare_images(reference, candidate)))
        if reference.shape[1] % 2 or reference.shape[1] < 2 * smallest:
            return out
        reference, candidate = halve(reference), halve(candidate)


def _at(pixels: int, m: Metrics) -> ErrorAt:
    return ErrorAt(pixels, m.silhouette_shift, m.flip, m.psnr_covered, m.noticed)


def switch_size(curve: Sequence[ErrorAt], bound: Bound) -> float | None:
    """The largest size up to which the error keeps within a bound, between two measured ones by
    linear interpolation of the error over the logarithm of the size. None if it does not even at
    the smallest.

    >>> from appearance_opt.options.bound import Bound
    >>> curve = [ErrorAt(64, 0.9, 0, 0, 0), ErrorAt(32, 0.3, 0, 0, 0), ErrorAt(16, 0.1, 0, 0, 0)]
    >>> switch_size(curve, Bound("silhouette_shift", 0.6))
    45.2548339959391
    """
    rising = sorted(curve, key=lambda e: e.pixels)
    errors = [bound.error(getattr(e, bound.metric)) for e in rising]
    if errors[0] > bound.limit:
        return None
    for k in range(1, len(rising)):
        if errors[k] > bound.limit:
            part = (bound.limit - errors[k - 1]) / (errors[k] - errors[k - 1])
            low, high = (math.log2(rising[i].pixels) for i in (k - 1, k))
            return float(2.0 ** (low + part * (high - low)))
    return float(rising[-1].pixels)


def value_at(curve: Sequence[ErrorAt], pixels: float, metric: str) -> float:
    """A metric at any size, interpolated over the logarithm of the size."""
    rising = sorted(curve, key=lambda e: e.pixels)
    sizes = [math.log2(e.pixels) for e in rising]
    values = [getattr(e, metric) for e in rising]
    return float(np.interp(math.log2(pixels), sizes, values))


@dataclass(frozen=True)
class Switch:
    """Where a level takes over from the finer one. ``pixels``: size on screen, the side of the
    square that just holds the object; ``met``: does its error keep within the bound there? If not,
    that is the size for which it was fitted. ``error``: of the bound's metric against the source;
    ``popping``: FLIP between the two levels there, and the share of pixels where an eye notices the
    switch (``noticed``)."""

    pixels: float
    met: bool
    error: float
    popping: float
    noticed: float


def find_switches(
    curves: Sequence[Sequence[ErrorAt]],
    between: Sequence[Sequence[ErrorAt]],
    sizes: Sequence[int],
    bound: Bound,
) -> list[Switch]:
    """Where each level but the finest takes over, none at a larger size than the one before it.
    ``curves``: of each level against the source; ``between``: of each but the finest against the
    one before it; ``sizes``: for which the levels were fitted."""
    out: list[Switch] = []
    most = math.inf
    for k in range(1, len(curves)):
        found = switch_size(curves[k], bound)
        most = min(most, float(sizes[k]) if found is None else found)
        error = value_at(curves[k], most, bound.metric)
        popping, noticed = (value_at(between[k - 1], most, name) for name in ("flip", "noticed"))
        out.append(Switch(most, found is not None, error, popping, noticed))
    return out


@dataclass(frozen=True)
class ScreenSize:
    """A size on screen in the forms that engines read. ``pixels``: side of the square that just
    holds the object; ``coverage``: area of its bounding sphere over that of the screen
    (MSFT_screencoverage); ``unreal``: diameter of that sphere over the height of the screen (Screen
    Size); ``unity``: its largest extent over that height (LODGroup, screen relative transition
    height); ``godot``: distance in metres from a camera of Godot's default field of view, 75
    degrees (visibility range)."""

    pixels: float
    coverage: float
    unreal: float
    unity: float
    godot: float

    def record(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


GODOT_FOV = 75.0
"""Degrees, vertical: Camera3D's default."""


def on_screen(
    pixels: float, sphere: float, diameter: float, extent: float, screen: int
) -> ScreenSize:
    """A size in all forms. ``sphere``: diameter of the bounding sphere in units of the square that
    holds the object; ``diameter`` of that sphere and ``extent``, the largest side of the box, both
    in metres; ``screen``: its height in pixels, 9/16 of its width."""
    height = pixels * sphere / screen
    return ScreenSize(
        pixels,
        math.pi / 4 * height**2 * 9 / 16,
        height,
        height * extent / diameter,
        diameter / (2 * height * math.tan(math.radians(GODOT_FOV) / 2)),
    )


def sphere_in_views(views: Views, radius: float = 1.0) -> float:
    """Mean diameter of the sphere around the origin in units of the width of framed images."""
    distance = np.linalg.norm(views.eye, axis=1)
    tangent = radius / np.sqrt(distance**2 - radius**2)
    return float(np.mean(tangent / np.linalg.norm(views.right, axis=1)))
