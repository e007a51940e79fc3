"""appearance-opt: a heavy 3D asset in, a light one that looks the same out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from appearance_opt.asset import load, save
    from appearance_opt.config import (
        BakeOptions,
        JointOptions,
        SimplifyOptions,
        bake_options,
        joint_options,
        simplify_options,
    )
    from appearance_opt.errors import (
        AppearanceError,
        BackendError,
        DivergedError,
        InputError,
        ReferenceRenderError,
    )
    from appearance_opt.jobs.bake import bake
    from appearance_opt.jobs.compare import compare
    from appearance_opt.jobs.inspect import inspect
    from appearance_opt.jobs.joint import joint
    from appearance_opt.jobs.simplify import simplify

__version__ = "0.1.0"

_HOMES = {
    "AppearanceError": "appearance_opt.errors",
    "BackendError": "appearance_opt.errors",
    "BakeOptions": "appearance_opt.config",
    "DivergedError": "appearance_opt.errors",
    "InputError": "appearance_opt.errors",
    "JointOptions": "appearance_opt.config",
    "ReferenceRenderError": "appearance_opt.errors",
    "SimplifyOptions": "appearance_opt.config",
    "bake": "appearance_opt.jobs.bake",
    "bake_options": "appearance_opt.config",
    "compare": "appearance_opt.jobs.compare",
    "inspect": "appearance_opt.jobs.inspect",
    "joint": "appearance_opt.jobs.joint",
    "joint_options": "appearance_opt.config",
    "load": "appearance_opt.asset",
    "save": "appearance_opt.asset",
    "simplify": "appearance_opt.jobs.simplify",
    "simplify_options": "appearance_opt.config",
}

__all__ = [
    "AppearanceError",
    "BackendError",
    "BakeOptions",
    "DivergedError",
    "InputError",
    "JointOptions",
    "ReferenceRenderError",
    "SimplifyOptions",
    "bake",
    "bake_options",
    "compare",
    "inspect",
    "joint",
    "joint_options",
    "load",
    "save",
    "simplify",
    "simplify_options",
]


def __getattr__(name: str) -> Any:
    # imported when first used: `import appearance_opt` and --help stay fast
    if name not in _HOMES:
        raise AttributeError(f"module 'appearance_opt' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
