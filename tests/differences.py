"""Derivatives of the loss of whole images, by differences."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from experiments.gradient_error.problems import Problem
from experiments.gradient_error.reference import Supersampler, pixel_losses


def differences_along(
    problem: Problem, fields: NDArray, target_samples: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(target image (P, 3), mean log-sRGB L1 loss of box-filtered images differentiated along
    displacement ``fields`` (N, V, 3), one number each). ``target_samples``: rays per pixel of the
    target."""
    every = np.arange(problem.resolution**2)
    target = Supersampler(problem, problem.target_positions, problem.target_colors).image(
        every, target_samples, 1
    )
    view = Supersampler(problem, problem.positions, problem.colors)
    step = problem.step * problem.pixel_size
    truth = np.zeros(len(fields))
    for k, field in enumerate(fields):
        for sign in (1, -1):
            view.move(problem.positions + sign * step * field)
            truth[k] += (
                sign
                * pixel_losses("log-srgb-l1", view.image(every, 512, 0), target)
                / (2 * step * target.size)
            )
    return target, truth
