"""What it takes to draw with Mitsuba's own plugins: a compiler, and cameras."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.backend import CPU, install_hint
from appearance_opt.errors import BackendError

if TYPE_CHECKING:
    from appearance_opt.views import Views

MINIMUM_LLVM = 17
"""Oldest LLVM that compiles Mitsuba's own plugins."""


def check_compiler() -> None:
    """Kernels of Mitsuba's plugins hold instructions that LLVM before 17 aborts the process on.
    Raises BackendError."""
    found = dr.detail.llvm_version() if mi.variant() == CPU else (MINIMUM_LLVM,)
    if found[0] < MINIMUM_LLVM:
        raise BackendError(
            f"the path tracer needs libLLVM {MINIMUM_LLVM} or newer, and finds {found[0]}: "
            f"{install_hint()}"
        )


def sensor_of(views: Views, k: int, resolution: int) -> dict[str, Any]:
    """Description of a Mitsuba camera for view ``k``: colour and coverage, averaged over pixels."""
    eye, forward = (a[k].astype(np.float64) for a in (views.eye, views.forward))
    half = float(np.linalg.norm(views.right[k].astype(np.float64)))
    up = [float(x) for x in -views.down[k]]
    to_world = mi.ScalarTransform4f().look_at(
        origin=[float(x) for x in eye], target=[float(x) for x in eye + forward], up=up
    )
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(half))),
        "to_world": to_world,
        "near_clip": 1e-3,
        "far_clip": 1e4,
        "sampler": {"type": "multijitter"},
        "film": {
            "type": "hdrfilm",
            "width": resolution,
            "height": resolution,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }
