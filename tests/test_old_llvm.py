"""LLVM 15 and 16, which current long-term distributions ship, abort the process on instructions
that propagate NaNs (``render/math.py``): no kernel of any job may have one."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import drjit as dr
import pytest

from appearance_opt.asset.types import Asset
from appearance_opt.config import bake_options, joint_options, simplify_options
from appearance_opt.jobs.bake import bake
from appearance_opt.jobs.compare import compare
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
