"""An upright view of an asset, from where a photographer would stand."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.views import frame, look_at

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from appearance_opt.views import Views

FOV = 28.0
"""Degrees: a portrait lens, which bends little."""

AZIMUTHS = (35.0, -35.0, 145.0, -145.0)
"""Degrees from the front (+Z) to the right (+X), the preferred one first."""

ELEVATION, FLAT_ELEVATION, FLAT = 18.0, 42.0, 0.3
"""Degrees above the horizon; and of what is flat: less high than so many times its width."""

PREFERENCE = 0.15
"""An azimuth has to show so much more to take the place of an earlier one."""


def hero_view(points: NDArray, show: Callable[[Views], NDArray[np.float32]]) -> Views:
    """The one view that shows most of a few that are three-quarter, slightly from above, +Y up.
    ``points`` (N, 3): of the asset, of radius 1 around the origin; ``show`` draws views in small
    (B, H, W, 4). Its light is a key light."""
    extent = points.max(axis=0) - points.min(axis=0)
    flat = extent[1] < FLAT * max(extent[0], extent[2])
    elevation = FLAT_ELEVATION if flat else ELEVATION
    candidates = _upright(np.array(AZIMUTHS), elevation, points)
    best, most = 0, -1.0
    for k, image in enumerate(show(candidates)):
        detail = _detail(image)
        if detail > most * (1 + PREFERENCE):
            best, most = k, detail
    return candidates[best : best + 1]


def _upright(azimuth: NDArray, elevation: float, hull: NDArray) -> Views:
    a, e = np.radians(azimuth), np.full(len(azimuth), np.radians(elevation))
    direction = np.stack([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)], axis=1)
    distance = 1.0 / np.sin(np.radians(FOV) / 2)
    # the key light: from the upper left, as pictures are lit
    b, f = a - np.radians(35), np.full(len(a), np.radians(45))
    toward = np.stack([np.sin(b) * np.cos(f), np.sin(f), np.cos(b) * np.cos(f)], axis=1)
    views = look_at(direction * distance, np.zeros(3), FOV, toward * 4, np.pi * 0.85 * 16)
    return frame(views, hull)


def _detail(image: NDArray) -> float:
    """How much an image shows: brightness that changes from pixel to pixel, outlines included."""
    value = image[..., :3].mean(axis=-1) ** 0.45 + image[..., 3]
    return float(np.abs(np.diff(value, axis=0)).sum() + np.abs(np.diff(value, axis=1)).sum())
