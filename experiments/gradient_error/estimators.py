"""Gradients of one problem by our renderer: what a step of a fit computes, at a given quality."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from appearance_opt.latent.latent import Latent
from appearance_opt.latent.parts import Pose
from appearance_opt.latent.positions import POSITIONS, Positions
from appearance_opt.optimize.losses import LOSSES
from appearance_opt.optimize.step import Gradients, StepInputs
from appearance_opt.reference.pool import Targets
from appearance_opt.render.pixels import Grid
from appearance_opt.render.quality import Quality
from appearance_opt.render.surface import Surface
from experiments.gradient_error.problems import BACKGROUND, Problem


class ColoredModel(Latent):
    """A model of a problem's mesh with its vertex colours: Mitsuba splits a mesh at the seams of a
    texture."""

    def __init__(self, problem: Problem) -> None:
        constants = {"red": 1.0, "green": 1.0, "blue": 1.0}
        constants |= {"roughness": problem.roughness, "metalness": problem.metalness}
        super().__init__(problem.mesh, (Positions(problem.mesh, True),), constants, (Pose(),))
        self.colors = problem.surface(self.topology, self.vertices(), problem.colors).colors

    def fixed(self) -> tuple:
        return (*super().fixed(), self.colors)

    def surface(self, vertices: mi.Float, pose: Pose | None = None) -> Surface:
        whole = super().surface(vertices, pose)
        return replace(whole, frames=None, corners=None, colors=self.colors)


class Ours:
    """One problem, ready to be differentiated again and again. ``target`` (P, 3): over the
    background."""

    def __init__(self, problem: Problem, target: NDArray, loss: str) -> None:
        self.loss = LOSSES[loss]
        self.model = ColoredModel(problem)
        self.grid = Grid(1, problem.resolution)
        rgba = np.ones((len(target), 4), np.float32)
        rgba[:, :3] = target
        reference = Targets(mi.Float(rgba.ravel()))
        background = np.array([BACKGROUND], np.float32)
        self.inputs = StepInputs(problem.views, reference, background, 0.0, 0.0, 0, want_loss=False)
        self._gradients: dict[Quality, Gradients] = {}

    def __call__(self, quality: Quality, seed: int) -> NDArray[np.float32]:
        """dLoss/dPositions (V, 3)."""
        return np.array(self.device(quality, seed)).reshape(-1, 3)

    def device(self, quality: Quality, seed: int) -> mi.Float:
        """The same on the device, as a step of a fit computes it, acceleration structure
        included."""
        # a new array: Mitsuba skips parameters that are the same as before
        self.model.parameters[POSITIONS].value = self.model.vertices() + dr.opaque(mi.Float, 0.0)
        self.model.update_scene()
        inputs = replace(self.inputs, seed=seed)
        if quality not in self._gradients:
            self._gradients[quality] = Gradients(self.model, self.grid, quality, self.loss)
        _, grads = self._gradients[quality](inputs)
        return grads[POSITIONS]
