"""How many rays the pixels of a batch get, and how wide they are."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sampling:
    """``samples``: rays in all pixels; estimators may trace more where boundaries pass.
    ``sample_width``, ``point_width``: texture filter in pixels of a pixel that is averaged, and of
    one that is a single point. ``defer``: pixels of up to so many samples, all of them covered,
    that no boundary crosses are left out of the image (for ``gradient.direct``); 0: none."""

    samples: int = 1
    sample_width: float = 1.0
    point_width: float = 0.4
    defer: int = 0
