"""Everything that a fit changes, but the parameters."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mitsuba as mi

    from appearance_opt.optimize.adam import Moments


@dataclass(frozen=True)
class CurvePoint:
    """A look at the held-out views: seconds of fitting, iteration, PSNR in dB, latest loss."""

    seconds: float
    step: int
    psnr: float
    loss: float


@dataclass
class FitState:
    """The state of a fit: with the values of the parameters, enough to go on with it.

    ``laplacian``: the regularizer's first weight, 0 before it is known; ``psnr``: of the latest
    look; ``best``: values of the best state so far, by held-out PSNR; ``unfolded``: what had to be
    put in order in it; ``skipped``: steps with a bad gradient."""

    moments: dict[str, Moments]
    iteration: int = 0
    loss: float = float("nan")
    laplacian: float = 0.0
    skipped: int = 0
    seconds: float = 0.0
    psnr: float = -np.inf
    best: dict[str, mi.Float] | None = None
    best_psnr: float = -np.inf
    best_iteration: int = 0
    unfolded: int = 0
    curve: list[CurvePoint] = field(default_factory=list)
