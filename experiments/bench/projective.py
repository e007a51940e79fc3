"""What a step's vertex gradient costs with Mitsuba's own integrator."""

from __future__ import annotations

import time

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.initial.sphere import sphere
from appearance_opt.views import ViewSampler
from experiments.mitsuba_peer import sensor


def projective(repeats: int = 5) -> dict:
    """Median and range in ms of ``direct_projective`` at 16 samples per pixel for the vertex
    gradient of a batch of four random views of 256 x 256, as the bench's step has them, of a
    diffuse mesh of the same size under one light: the gradient alone, without maps, regularizer or
    a step. Boundaries of indirect light are not sampled, as there is none."""
    mi.set_log_level(
        mi.LogLevel.Error
    )  # it warns in every call that silhouettes may leave the view
    low = sphere(3000, (0.0, 0.0, 0.0), 0.93, 64)
    mesh = mi.Mesh("m", len(low.positions), len(low.faces))
    p = mi.traverse(mesh)
    p["vertex_positions"], p["faces"] = (
        mi.Float(low.positions.ravel()),
        mi.UInt32(low.faces.astype(np.uint32).ravel()),
    )
    p.update()
    light = {"type": "point", "position": [2, 3, 5], "intensity": {"type": "rgb", "value": 40.0}}
    scene = mi.load_dict({"type": "scene", "mesh": mesh, "light": light})
    views = ViewSampler((0.0, 0.0, 0.0), 1.0).draw(0, 4)
    sensors = [sensor(views, k, 256) for k in range(4)]
    integrator = mi.load_dict({"type": "direct_projective", "sppi": 0})
    parameters = mi.traverse(scene)
    key = next(k for k in parameters.keys() if k.endswith("vertex_positions"))  # noqa: SIM118
    times = []
    for k in range(repeats):
        dr.enable_grad(parameters[key])
        parameters.update()
        dr.sync_thread()
        began = time.perf_counter()
        for view, camera in enumerate(sensors):
            image = mi.render(
                scene, parameters, sensor=camera, integrator=integrator, spp=16, seed=4 * k + view
            )
            dr.backward(dr.mean(dr.square(image), axis=None))
        dr.eval(dr.grad(parameters[key]))
        dr.sync_thread()
        times.append(1e3 * (time.perf_counter() - began))
    times = times[1:]
    return {"milliseconds": float(np.median(times)), "range": [min(times), max(times)]}
