"""Gradients of the same problems by Mitsuba's projective integrators."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from appearance_opt.optimize.losses import LOSSES
from experiments import mitsuba_peer
from experiments.gradient_error.problems import BACKGROUND, Problem


class Peer:
    """One problem in Mitsuba. ``integrator``: "direct_projective" or "prb_projective" (of depth
    two, which is the same light). Shadow boundaries are not sampled: the light at the eye casts no
    visible shadow."""

    def __init__(self, problem: Problem, target: NDArray, loss: str, integrator: str) -> None:
        bsdf = {
            "type": mitsuba_peer.BSDF_NAME,
            "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
            "roughness": {"type": "uniform", "value": problem.roughness},
            "metalness": {"type": "uniform", "value": problem.metalness},
        }
        views = problem.views
        # both sides reflect: open meshes show their backs
        bsdf = {"type": "twosided", "nested": bsdf}
        mesh = mitsuba_peer.mesh(
            "mesh", problem.positions, problem.faces, bsdf, vertex_color=problem.colors
        )
        scene = {
            "type": "scene",
            "mesh": mesh,
            "light": mitsuba_peer.light(views, 0),
            "backdrop": mitsuba_peer.backdrop(views, 0, BACKGROUND),
        }
        self.scene = mi.load_dict(scene)
        self.sensor = mitsuba_peer.sensor(views, 0, problem.resolution)
        options = {"max_depth": 2} if integrator == "prb_projective" else {}
        self.integrator = mi.load_dict({"type": integrator, "sppi": 0, **options})
        self.parameters = mi.traverse(self.scene)
        self.start = mi.Float(problem.positions.ravel())
        self.loss = LOSSES[loss]
        self.target = [mi.Float(np.ascontiguousarray(c)) for c in target.T]
        self.scale = 1 / target.size

    def image(self, samples: int, seed: int = 0) -> NDArray[np.float32]:
        """The image alone (P, 3)."""
        image = mi.render(
            self.scene, sensor=self.sensor, integrator=self.integrator, spp=samples, seed=seed
        )
        return np.array(image).reshape(-1, 3)

    def device(self, samples: int, seed: int) -> mi.Float:
        """dLoss/dPositions (3 V), flat."""
        positions = mi.Float(self.start)
        dr.enable_grad(positions)
        self.parameters["mesh.vertex_positions"] = positions
        self.parameters.update()
        image = mi.render(
            self.scene,
            self.parameters,
            sensor=self.sensor,
            integrator=self.integrator,
            spp=samples,
            seed=seed,
        )
        color = dr.unravel(mi.Color3f, image.array)
        loss = self.loss(color, mi.Color3f(*self.target))
        dr.backward(dr.sum(loss.x + loss.y + loss.z) * self.scale)
        result = dr.grad(positions)
        dr.eval(result)
        return result

    def __call__(self, samples: int, seed: int) -> NDArray[np.float32]:
        """dLoss/dPositions (V, 3)."""
        return np.array(self.device(samples, seed)).reshape(-1, 3)
