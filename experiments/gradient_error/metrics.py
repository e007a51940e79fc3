"""How far a gradient is from the reference, as numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Error:
    """``relative``: |g - t| / |t|, root mean square over repetitions; ``cosine``: mean over them;
    ``bias``: projection of the mean gradient on the truth, less one (0.02: 2 % too long)."""

    relative: float
    cosine: float
    bias: float


def error_of(repetitions: NDArray, truth: NDArray) -> Error:
    """``repetitions`` (R, N): independent estimates; ``truth`` (N,)."""
    g, t = (
        repetitions.reshape(len(repetitions), -1).astype(np.float64),
        truth.ravel().astype(np.float64),
    )
    norm = np.linalg.norm(t)
    relative = np.sqrt(np.mean(np.sum((g - t) ** 2, axis=1))) / norm
    cosine = np.mean(g @ t / (np.linalg.norm(g, axis=1) * norm + 1e-300))
    return Error(float(relative), float(cosine), float(g.mean(axis=0) @ t / norm**2 - 1))
