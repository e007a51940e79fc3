"""What a shape that grew does not get to: holes, handles and separate parts, which a sphere has
not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import binary_erosion

from appearance_opt.views import START

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.reference.base import Reference
    from appearance_opt.views import Sampler

VIEWS, RESOLUTION, SAMPLES = 12, 128, 4

DEPTH = 2
"""Pixels that a wrong silhouette is eroded by: less is an outline that lies a little off."""

NOTED = 3e-3
"""Share of the object's pixels from which it is said."""


def silhouettes_off(reference: Reference, result: Reference, sampler: Sampler) -> float:
    """Share of the pixels that a reference covers where a result covers others, in patches that
    reach further than ``DEPTH`` pixels from all that is right."""
    views = sampler.held_out(START).draw(1, VIEWS)
    one, two = (r.render(views, RESOLUTION, SAMPLES)[..., 3] > 0.5 for r in (reference, result))
    return share_off(one, two)


def share_off(one: NDArray[np.bool_], two: NDArray[np.bool_]) -> float:
    """The same of silhouettes (B, H, W): pixels of wrong patches that erosion leaves something
    of, counted as what is left, over those of ``one``."""
    square = np.ones((1, 2 * DEPTH + 1, 2 * DEPTH + 1), bool)
    return float(binary_erosion(one != two, square).sum() / max(int(one.sum()), 1))


def describe(share: float, with_surface: bool) -> list[str]:
    """What to tell of it; ``with_surface``: can the reference be asked for an isosurface?"""
    if share < NOTED:
        return []
    instead = "--init marching-cubes finds them" if with_surface else "start from a mesh of them"
    return [
        f"{100 * share:.1f} % of the silhouette are off in patches that a sphere does not get to "
        f"(holes, handles, separate or thin parts): {instead}"
    ]
