"""Rays of a scene of ten primitives, and meshes of sharp edges by two libraries."""

from __future__ import annotations

import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt import backend, sdf
from appearance_opt.reference.sdf import SdfReference
from appearance_opt.render.camera import camera_of, direction
from appearance_opt.render.pixels import Grid
from appearance_opt.sdf.sampling import isosurface
from appearance_opt.sdf.shape import Placed
from appearance_opt.sdf.trace import TOLERANCE, Hit
from appearance_opt.views import ViewSampler

VIEWS, RESOLUTION, REPEATS, FIXED = 4, 512, 7, 256


def ten(p: mi.Point3f) -> mi.Float:
    """Ten primitives, one of each kind and some twice."""
    at = sdf.translate
    return sdf.union(
        sdf.sphere(at(p, (0.0, 0.0, 0.0)), 0.25),
        sdf.box(at(p, (0.5, 0.1, 0.1)), (0.15, 0.1, 0.2)),
        sdf.torus(at(p, (-0.5, 0.0, 0.1)), 0.2, 0.06),
        sdf.capsule(p, (-0.2, 0.4, -0.3), (0.3, 0.5, 0.2), 0.07),
        sdf.cylinder(at(p, (0.1, -0.5, 0.2)), 0.12, 0.15),
        sdf.cone(at(p, (-0.3, -0.4, -0.3)), 0.2, 0.05, 0.15),
        sdf.ellipsoid(at(p, (0.3, 0.1, -0.5)), (0.25, 0.12, 0.15)),
        sdf.sphere(at(p, (-0.4, 0.3, 0.5)), 0.15),
        sdf.box(at(p, (0.4, -0.4, -0.3)), (0.1, 0.15, 0.1)),
        sdf.torus(at(p, (0.1, 0.1, 0.6)), 0.15, 0.05),
    )


def rays() -> dict[str, Any]:
    """Million rays per second: of those that pass the bounds, too, and of others alone; steps and
    residuals of those that meet something. Marching by fixed steps sees the same to a step."""
    backend.select("auto")
    reference = SdfReference(
        Placed(sdf.Shape(ten, ((-0.8, -0.7, -0.7), (0.7, 0.6, 0.85))), (0.0, 0.0, 0.0), 1.0)
    )
    views = ViewSampler((0.0, 0.0, 0.0), 0.9).draw(0, VIEWS)
    grid, records = Grid(VIEWS, RESOLUTION), views.records()
    camera = camera_of(records, grid.view)
    way = dr.normalize(direction(camera, grid.column + 0.5, grid.row + 0.5, grid.size))
    origin = camera.eye
    dr.eval(origin, way)
    dr.sync_thread()
    start, end = reference.clip(origin, way)
    reaching = int(dr.count(start < end)[0])

    def traced() -> mi.Float:
        found = reference.trace(origin, way)
        dr.eval(found)
        return found

    def marched() -> mi.Float:
        step = (end - start) / FIXED

        def going(t, k, open_):  # type: ignore[no-untyped-def]
            return open_ & (k < FIXED)

        def march(t, k, open_):  # type: ignore[no-untyped-def]
            met = ten(dr.fma(way, t, origin)) < TOLERANCE
            return dr.select(met, t, t + step), k + 1, ~met

        state = (mi.Float(start), dr.zeros(mi.UInt32, dr.width(start)), mi.Bool(start < end))
        t = dr.while_loop(state, going, march, label="fixed steps")[0]
        dr.eval(t)
        return t

    seconds, worked = {}, {}
    for name, run in (("sphere tracing", traced), ("fixed steps", marched)):
        taken, before = [], time.process_time()
        for _ in range(REPEATS):
            began = time.perf_counter()
            run()
            dr.sync_thread()
            taken.append(time.perf_counter() - began)
        worked[name] = (time.process_time() - before) / REPEATS
        seconds[name] = float(np.median(taken[1:])), min(taken[1:])
    found: Hit = reference.trace(origin, way)
    hit = np.array(found.valid)
    steps, residual = np.array(found.steps), np.abs(np.array(found.residual))
    within = steps > 0
    count = VIEWS * RESOLUTION**2
    return {
        "rays": count,
        "within bounds": reaching,
        "Mrays/s": {n: round(count / m / 1e6, 2) for n, (m, _) in seconds.items()},
        "Mrays/s at best": {n: round(count / b / 1e6, 2) for n, (_, b) in seconds.items()},
        "Mrays per second of one core": {n: round(count / w / 1e6, 2) for n, w in worked.items()},
        "Mrays/s within bounds": {n: round(reaching / m / 1e6, 2) for n, (m, _) in seconds.items()},
        "steps of rays within bounds": round(float(steps[within].mean()), 2),
        "most steps": int(steps.max()),
        "residual of hits": float(residual[hit].mean()),
        "largest residual": float(residual[hit].max()),
    }


def libraries() -> dict[str, Any]:
    """A turned box as mesh of about equally many triangles: how far its true edges and faces are
    from the mesh, in units of a cell, and the seconds it takes."""
    backend.select("auto")
    half = np.array((0.5, 0.4, 0.3))

    def distance(p: mi.Point3f) -> mi.Float:
        return sdf.box(sdf.rotate(p, (1, 2, 3), 30.0), half.tolist())

    bounds = np.array([[-0.8] * 3, [0.8] * 3])
    out: dict[str, Any] = {}
    began = time.perf_counter()
    p, f = isosurface(distance, bounds, 30_000)
    out["scikit-image"] = _off(p, f, half) | {"seconds": round(time.perf_counter() - began, 2)}
    try:
        import isomesh
    except ImportError:
        return out

    def asked(points: np.ndarray) -> tuple[np.ndarray, None]:
        at = mi.Point3f(np.ascontiguousarray(points.T, np.float32))
        return np.array(distance(at)).astype(np.float64), None

    began = time.perf_counter()
    p, f = isomesh.extract(
        asked, bbox_min=tuple(bounds[0]), bbox_max=tuple(bounds[1]), min_depth=4, max_depth=6
    )
    out["isomesh"] = _off(p, f, half) | {"seconds": round(time.perf_counter() - began, 2)}
    return out


def _off(p: np.ndarray, f: np.ndarray, half: np.ndarray) -> dict[str, Any]:
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation
    from trimesh.triangles import closest_point

    axis = np.array((1.0, 2.0, 3.0))
    turn = Rotation.from_rotvec(np.radians(30) * axis / np.linalg.norm(axis))
    rng = np.random.default_rng(0)
    edge, face = rng.uniform(-1, 1, (300, 3)), rng.uniform(-1, 1, (300, 3))
    for k in range(3):
        edge[k::3, (k + 1) % 3], edge[k::3, (k + 2) % 3] = 1, -1
        face[k::3, k] = 1
    corners, tried = p[f].astype(np.float64), 40
    tree, found = cKDTree(corners.mean(axis=1)), {}
    for name, v in (("edges", edge), ("faces", face)):
        at = np.repeat(turn.apply(v * half), tried, axis=0)
        near = tree.query(at[::tried], tried)[1].ravel()
        away = np.linalg.norm(closest_point(corners[near], at) - at, axis=1)
        found[name] = away.reshape(-1, tried).min(axis=1)
    return {"triangles": len(f)} | {
        f"{n} {what}": float(f"{function(d):.2e}")
        for n, d in found.items()
        for what, function in (("mean", np.mean), ("largest", np.max))
    }
