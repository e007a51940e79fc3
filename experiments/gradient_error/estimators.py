"""Gradients of one problem by our renderer: what a step of a fit computes, at a given quality."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from appearance_opt.fit.losses import LOSSES, image_loss
from appearance_opt.render import gradient, upload
from appearance_opt.render.deferred import Grid
from appearance_opt.render.gradient import Quality
from experiments.gradient_error.problems import BACKGROUND, Problem
from experiments.gradient_error.reference import Truth


@dataclass(frozen=True)
class Setting:
    """One row of a table."""

    name: str
    quality: Quality


class Ours:
    """One problem, ready to be differentiated again and again."""

    def __init__(self, problem: Problem, truth: Truth, loss: str) -> None:
        self.problem = problem
        self.loss = LOSSES[loss]
        self.topology = problem.topology()
        self.grid = Grid(1, problem.resolution)
        self.scene = upload.scene_of(problem.positions, problem.faces)
        self.parameters = mi.traverse(self.scene)
        self.start = mi.Float(problem.positions.ravel())
        rgba = np.ones((len(truth.target), 4), np.float32)
        rgba[:, :3] = truth.target
        self.target = mi.Float(rgba.ravel())
        self.background = mi.Float([*BACKGROUND, 0.0])
        self.colors = problem.surface(self.topology, self.start, problem.colors).colors

    def __call__(self, quality: Quality, seed: int) -> NDArray[np.float32]:
        """dLoss/dPositions (V, 3)."""
        return np.array(self.device(quality, seed)).reshape(-1, 3)

    def device(self, quality: Quality, seed: int) -> mi.Float:
        """The same on the device: the acceleration structure, normals, image, loss and backward pass of one step."""
        from dataclasses import replace

        positions = self.start + dr.opaque(mi.Float, 0.0)
        self.parameters["mesh.vertex_positions"] = positions
        self.parameters.update()
        positions = mi.Float(positions)
        dr.enable_grad(positions)
        surface = replace(self.topology.surface(positions), frames=None, corners=None, colors=self.colors)
        edges = self.topology.edges
        records = self.problem.views.records()
        maps = self.problem.maps
        frame = gradient.render(self.scene, surface, maps, edges, records, self.grid, quality, seed)
        _, by_image = image_loss(self.loss, frame.image, self.target, self.background, self.grid.pixels)
        dr.backward(gradient.surrogate(frame, surface, maps, edges, by_image, quality))
        result = dr.grad(positions)
        dr.eval(result)
        return result
