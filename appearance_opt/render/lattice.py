"""Well-spread positions in the unit square: a rank-1 lattice."""

from __future__ import annotations

from functools import cache

import numpy as np


@cache
def sub_pixel_offsets(count: int) -> np.ndarray:
    """Return (count, 2) well-spread positions in the unit square: the rank-1 lattice (i, g i) /
    count whose points lie farthest apart (on the torus), placed so that it is symmetric about the
    middle of the pixel.

    Without the symmetry the image is shifted by the distance of the points' mean from the middle
    (docs/trials.md: images).
    """
    odd = 2 * np.arange(count) + 1
    points = (np.stack([odd, odd * generator(count) % (2 * count)], 1) / (2 * count)).astype(
        np.float32
    )
    points.setflags(write=False)
    return points


@cache
def generator(count: int) -> int:
    """Return g of the lattice."""
    i = np.arange(count)
    best, found = -1.0, 1
    for g in range(1, max(count, 2)):
        # at most two points in a row, and none on the border
        if np.gcd(g, count) > 2 or not np.all((2 * i + 1) * g % (2 * count)):
            continue
        step = np.stack([i, i * g], 1)[1:] / count
        step -= np.round(step)
        apart = np.min(np.sum(step**2, 1), initial=1.0)
        if apart > best:
            best, found = apart, g
    return found
