"""LLVM 15 and 16, which current long-term distributions ship, abort the process on instructions
that propagate NaNs (``render/math.py``): no kernel of any job may have one."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance_opt import sdf
from appearance_opt.asset.types import Asset
from appearance_opt.config import bake_options, joint_options, simplify_options
from appearance_opt.jobs.bake import bake
from appearance_opt.jobs.compare import compare
from appearance_opt.jobs.convert import convert
from appearance_opt.jobs.joint import joint
from appearance_opt.jobs.simplify import simplify
from scenes.analytic import bumpy_sphere

QUICK = {"texture_size": 64, "resolution": 48, "pool": 4, "views": 2, "steps": 2}
NAN_PROPAGATING = re.compile(r"llvm\.(?:minimum|maximum)\b")


def simplified(asset: Asset, out: Path, **values: object) -> Asset:
    report = out / "report" if values.pop("report", False) else None
    return simplify(
        asset,
        out / "x.glb",
        simplify_options(**{"triangles": 200, **QUICK, **values}),
        report=report,
    ).asset


def baked(asset: Asset, out: Path, **values: object) -> None:
    low = simplified(asset, out, steps=0)
    bake(asset, low, out / "y.glb", bake_options(**{**QUICK, **values}))


def joined(asset: Asset, out: Path) -> None:
    low = simplified(asset, out, steps=0)
    joint(asset, low, out / "y.glb", joint_options(**QUICK, subdivision=(1,)))


def converted(interpolation: str, out: Path) -> None:
    """A shape of all kinds of functions, or a ball on a grid."""
    quick = {"triangles": 200, "reallocate": 0, **QUICK}
    if interpolation == "cubic":
        at = np.stack(np.meshgrid(*[np.linspace(-1, 1, 12)] * 3, indexing="ij"), -1)
        held = {"distance": np.linalg.norm(at, axis=-1) - 0.7, "color": at * 0.3 + 0.5}
        np.savez(out / "a.npz", **held, spacing=2 / 11, origin=[-1.0] * 3, interpolation="cubic")
        convert("sdf", out / "a.npz", None, **quick)
        return

    def distance(p: mi.Point3f) -> mi.Float:
        q = sdf.repeat(
            sdf.twist(sdf.rotate(sdf.mirror(p), (0, 1, 0), 30.0), 0.5), (0.9, 0, 0), (1,) * 3
        )
        parts = (sdf.box(q, (0.3, 0.2, 0.1)), sdf.torus(q, 0.3, 0.1), sdf.cone(q, 0.2, 0.1, 0.3),
                 sdf.capsule(q, (0, 0, 0), (0.2, 0.3, 0.1), 0.1, 0.05), sdf.cylinder(q, 0.1, 0.3),
                 sdf.ellipsoid(q, (0.1, 0.2, 0.3)))  # fmt: skip
        whole = sdf.smooth_union(
            sdf.union(*parts), sdf.sphere(sdf.elongate(q, (0.1, 0, 0)), 0.2), 0.1
        )
        carved = sdf.smooth_difference(whole, sdf.gyroid(q, 0.5, 0.05), 0.02)
        return sdf.intersection(carved, sdf.sphere(p, 0.95))

    def material(p: mi.Point3f) -> sdf.Material:
        paint = sdf.mix(
            (0.8, 0.2, 0.1), (0.1, 0.2, 0.8), sdf.step(0.0, sdf.fractal_noise(p * 3), 0.2)
        )
        return sdf.Material(paint, 0.4)

    convert("sdf", sdf.Shape(distance, ((-1,) * 3, (1,) * 3), material), None, **quick)


def veiled(asset: Asset) -> Asset:
    """All of it half transparent."""
    meshes = (
        replace(m, material=replace(m.material, alpha_mode="blend", opacity=0.5))
        for m in asset.meshes
    )
    return replace(asset, meshes=tuple(meshes))


JOBS: dict[str, Callable[[Asset, Path], object]] = {
    "decimated, with a report": lambda asset, out: simplified(asset, out, report=True),
    "a sphere": lambda asset, out: simplified(asset, out, init="sphere", steps=8),
    "displaced": lambda asset, out: simplified(asset, out, displacement=True, subdivision=(1, 2)),
    "every map": lambda asset, out: baked(
        asset,
        out,
        maps=("normal", "object-normal", "material", "displacement", "ao", "curvature"),
        ao_rays=4,
    ),
    "a joint bake": joined,
    "a distance field": lambda asset, out: converted("linear", out),
    "a grid": lambda asset, out: converted("cubic", out),
    "compared": lambda asset, out: compare(asset, asset, views=1, resolution=64),
    "compared, transparent": lambda asset, out: compare(veiled(asset), asset, resolution=64),
}


@pytest.mark.parametrize("job", JOBS)
def test_no_kernel_propagates_nans(job: str, tmp_path: Path) -> None:
    asset = bumpy_sphere(2000, 64)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        JOBS[job](asset, tmp_path)
        kernels = [
            k["ir"].getvalue() for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT
        ]
    assert len(kernels) > 5
    assert not {call for kernel in kernels for call in NAN_PROPAGATING.findall(kernel)}
