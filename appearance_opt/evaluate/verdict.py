"""What a report says in a sentence: how much smaller, and from which size on differences are
seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from appearance_opt.evaluate.metrics import compare_images, halve

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.evaluate.metrics import Metrics

SMALLEST = 48
"""Pixels: what is smaller is an icon."""

INVISIBLE, HARDLY = 0.01, 0.05
"""Shares of the pixels that a viewer notices, up to which differences are called invisible, and
hardly visible."""


@dataclass(frozen=True)
class AtSize:
    """Means over the same views at a resolution of so many ``pixels`` per side: share of the
    covered pixels where a difference is noticed, PSNR over covered pixels, FLIP."""

    pixels: int
    noticed: float
    psnr_covered: float
    flip: float


def at_sizes(reference: NDArray, candidate: NDArray, known: Metrics | None = None) -> list[AtSize]:
    """How different (B, H, W, 4) images are, the largest first, and at halves of their size, as
    long as they can be halved. ``known``: their metrics, where they are measured already."""
    out: list[AtSize] = []
    while True:
        m = compare_images(reference, candidate) if known is None or out else known
        out.append(AtSize(reference.shape[1], m.noticed, m.psnr_covered, m.flip))
        if reference.shape[1] % 2 or reference.shape[1] < 2 * SMALLEST:
            return out
        reference, candidate = halve(reference), halve(candidate)


def describe_visibility(sizes: list[AtSize]) -> str:
    """One sentence on the sizes, which come the largest first. It says no more than was measured.

    >>> describe_visibility([AtSize(96, 0.2, 30, 0.1), AtSize(48, 0.004, 40, 0.01)])
    'Differences are invisible at 48 pixels; at 96, an eye that flips between the two notices 20 % of the pixels.'
    """
    largest, smallest = sizes[0], sizes[-1]
    eye, share = "an eye that flips between the two notices", percent(largest.noticed)
    unseen = _largest(sizes, INVISIBLE)
    if unseen is largest:
        return f"Differences are invisible at {largest.pixels} pixels, the largest size measured."
    for found, how in ((unseen, "invisible"), (_largest(sizes, HARDLY), "hardly visible")):
        if found is None:
            continue
        said = f"Differences are {how} at {found.pixels} pixels"
        if found is largest:
            return f"{said}: {eye} {share} of the pixels."
        return f"{said}; at {largest.pixels}, {eye} {share} of the pixels."
    said = f"{eye[0].upper()}{eye[1:]} {share} of the pixels at {largest.pixels} pixels"
    if smallest is largest:
        return f"{said}."
    return f"{said}, and {percent(smallest.noticed)} at {smallest.pixels}."


def _largest(sizes: list[AtSize], share: float) -> AtSize | None:
    """The largest size up to which, from the smallest on, no more than ``share`` is noticed."""
    found = None
    for size in reversed(sizes):
        if size.noticed > share:
            break
        found = size
    return found


def percent(share: float) -> str:
    """A share in words: two digits, and none that is not there."""
    value = 100 * share
    if value == 0 or value >= 9.95:
        return f"{value:.0f} %"
    return f"{value:.1f} %" if value >= 0.095 else f"{value:.1g} %"
