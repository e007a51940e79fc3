"""Meshes made of distance fields, and how far they are from them."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt import backend, convert_options, sdf
from appearance_opt.asset import Asset, Mesh, load, save
from appearance_opt.asset.images import encode_png
from appearance_opt.asset.types import Material
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.jobs.convert import convert
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.opened import Opened
from appearance_opt.reference.sdf_open import open_source
from appearance_opt.render.display import display
from appearance_opt.sdf.sampling import Lattice, march, sample
from appearance_opt.views import MEASURED

SCENE = "scenes/beetle.py:scene"
VIEWS, RESOLUTION, SAMPLES, PICTURED = 12, 256, 8, 5

SHAPES = {
    "sphere": lambda p: sdf.sphere(p, 0.8),
    "torus": lambda p: sdf.torus(p, 0.6, 0.25),
    "box": lambda p: sdf.box(sdf.rotate(p, (1, 2, 3), 30.0), (0.5, 0.4, 0.3)),
    "gyroid": lambda p: sdf.intersection(sdf.gyroid(p, 0.9, 0.15), sdf.sphere(p, 0.8)),
}


def look(opened: Opened, asset: Asset) -> dict[str, float]:
    """How an asset looks beside what was opened, in views that nothing was chosen by."""
    subject = opened.subject
    views = subject.sampler.held_out(MEASURED).draw(0, VIEWS)
    candidate = MeshReference(subject.placement.local(asset))
    one, two = (r.render(views, RESOLUTION, SAMPLES) for r in (subject.reference, candidate))
    found = compare_images(one, two)
    names = ("psnr", "psnr_covered", "flip")
    return {n: round(float(getattr(found, n)), 4) for n in names}


def picture(assets: list[Path], out: Path) -> None:
    """The scene and meshes of it in one view, side by side."""
    source = opened(1)
    subject, size = source.subject, 400
    views = subject.sampler.held_out(MEASURED).draw(0, VIEWS)[[PICTURED]]
    drawn = [subject.reference.render(views, size, 16)[0]]
    for path in assets:
        local = subject.placement.local(load(path))
        drawn.append(MeshReference(local).render(views, size, 16)[0])
    out.write_bytes(encode_png(np.round(255 * display(np.concatenate(drawn, 1))).astype(np.uint8)))


def opened(triangles: int, source: Any = SCENE) -> Opened:
    """The source, as ``convert`` opens it."""
    backend.select("auto")
    return open_source(source, convert_options(triangles=triangles))


def converted(init: str, options: dict[str, Any], out: Path) -> dict[str, Any]:
    """The scene by ``convert sdf``: after the fit, and before it."""
    began, worked = time.perf_counter(), time.process_time()
    result = convert("sdf", SCENE, out, init=init, **options)
    seconds = {"seconds": time.perf_counter() - began, "cpu": time.process_time() - worked}
    source = opened(options["triangles"])
    return {
        **look(source, result.asset),
        "before": look(source, result.columns["start"]),
        "steps": result.fit.steps,
        "notes": result.notes,
        **{k: round(v) for k, v in seconds.items()},
    }


def marched(triangles: int, out: Path) -> dict[str, Any]:
    """Marching cubes of about so many triangles, colours at its vertices."""
    source = opened(triangles)
    field = source.subject.reference.field  # type: ignore[attr-defined]
    bounds, cells = np.asarray(field.bounds), 40.0
    for _ in range(3):
        lattice = Lattice.within(bounds, cells, 1.5)
        p, faces = march(sample(field.distance, lattice))
        if triangles * 0.97 < len(faces) <= triangles:
            break
        cells *= (0.985 * triangles / len(faces)) ** 0.5
    p = (p * lattice.cell + np.array(lattice.low)).astype(np.float32)
    at = mi.Point3f(np.ascontiguousarray(p.T))
    made, width = field.material(at), len(p)
    colors = np.array(made.base_color + dr.zeros(mi.Color3f, width)).T
    rest = [float(dr.mean(x + dr.zeros(mi.Float, width))[0]) for x in made[1:]]
    material = Material("m", roughness=rest[0], metalness=rest[1], double_sided=False)
    world = source.subject.placement.to_world(p).astype(np.float32)
    mesh = Mesh(world, faces, colors=np.ascontiguousarray(colors, np.float32), material=material)
    asset = Asset((mesh,))
    save(asset, out)
    return {"faces": len(faces), **look(source, asset)}


def shapes_off(options: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Mean and largest distance of the vertices of fitted shapes from the true surface, before and
    after the fit, in per cent of the diagonal."""
    out = {}
    limits = {**options, "triangles": 2000, "resolution": 128, "texture_size": 256, "pool": 32}
    for name, distance in SHAPES.items():
        result = convert("sdf", sdf.Shape(distance, ((-1,) * 3, (1,) * 3)), None, **limits)
        row = {}
        for when, asset in (("start", result.columns["start"]), ("fitted", result.asset)):
            p = np.concatenate([m.positions for m in asset.meshes])
            off = np.abs(np.array(distance(mi.Point3f(np.ascontiguousarray(p.T)))))
            diagonal = float(np.linalg.norm(np.ptp(p, axis=0)))
            row[f"{when} mean"] = round(100 * float(off.mean()) / diagonal, 4)
            row[f"{when} largest"] = round(100 * float(off.max()) / diagonal, 4)
        out[name] = row
    return out
