"""appearance-opt: a heavy 3D asset in, a light one that looks the same out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from appearance_opt.asset import Asset, load, save
    from appearance_opt.config import (
        AnimateOptions,
        BakeOptions,
        CompareOptions,
        ConvertOptions,
        InspectOptions,
        JointOptions,
        LodOptions,
        SimplifyOptions,
        animate_options,
        bake_options,
        convert_options,
        joint_options,
        lod_options,
        simplify_options,
    )
    from appearance_opt.errors import (
        AppearanceError,
        BackendError,
        DivergedError,
        InputError,
        ReferenceRenderError,
    )
    from appearance_opt.evaluate.comparison import Comparison
    from appearance_opt.jobs.animate import AnimateResult, animate
    from appearance_opt.jobs.bake import bake
    from appearance_opt.jobs.compare import compare
    from appearance_opt.jobs.convert import convert
    from appearance_opt.jobs.fit import fit
    from appearance_opt.jobs.inspect import Inspection, inspect
    from appearance_opt.jobs.joint import joint
    from appearance_opt.jobs.lod import LodResult, lod
    from appearance_opt.jobs.result import BakeResult, Result, SimplifyResult
    from appearance_opt.jobs.simplify import simplify
    from appearance_opt.jobs.spec import JobSpec, run
    from appearance_opt.options.animation import AnimationOptions
    from appearance_opt.options.baking import BakingOptions
    from appearance_opt.options.fitting import FittingOptions
    from appearance_opt.options.maps import DisplacementOptions, TextureOptions
    from appearance_opt.options.reading import AssetOptions
    from appearance_opt.options.start import StartOptions
    from appearance_opt.options.views import ViewOptions
    from appearance_opt.reference.base import Reference

__version__ = "0.1.0"

_HOMES = {
    "AnimateOptions": "appearance_opt.config",
    "AnimateResult": "appearance_opt.jobs.animate",
    "AnimationOptions": "appearance_opt.options.animation",
    "AppearanceError": "appearance_opt.errors",
    "Asset": "appearance_opt.asset",
    "AssetOptions": "appearance_opt.options.reading",
    "BackendError": "appearance_opt.errors",
    "BakeOptions": "appearance_opt.config",
    "BakeResult": "appearance_opt.jobs.result",
    "BakingOptions": "appearance_opt.options.baking",
    "CompareOptions": "appearance_opt.config",
    "ConvertOptions": "appearance_opt.config",
    "Comparison": "appearance_opt.evaluate.comparison",
    "DisplacementOptions": "appearance_opt.options.maps",
    "DivergedError": "appearance_opt.errors",
    "FittingOptions": "appearance_opt.options.fitting",
    "InputError": "appearance_opt.errors",
    "InspectOptions": "appearance_opt.config",
    "Inspection": "appearance_opt.jobs.inspect",
    "JobSpec": "appearance_opt.jobs.spec",
    "JointOptions": "appearance_opt.config",
    "LodOptions": "appearance_opt.config",
    "LodResult": "appearance_opt.jobs.lod",
    "Reference": "appearance_opt.reference.base",
    "ReferenceRenderError": "appearance_opt.errors",
    "Result": "appearance_opt.jobs.result",
    "SimplifyOptions": "appearance_opt.config",
    "SimplifyResult": "appearance_opt.jobs.result",
    "StartOptions": "appearance_opt.options.start",
    "TextureOptions": "appearance_opt.options.maps",
    "ViewOptions": "appearance_opt.options.views",
    "animate": "appearance_opt.jobs.animate",
    "animate_options": "appearance_opt.config",
    "bake": "appearance_opt.jobs.bake",
    "bake_options": "appearance_opt.config",
    "compare": "appearance_opt.jobs.compare",
    "convert": "appearance_opt.jobs.convert",
    "convert_options": "appearance_opt.config",
    "fit": "appearance_opt.jobs.fit",
    "inspect": "appearance_opt.jobs.inspect",
    "joint": "appearance_opt.jobs.joint",
    "joint_options": "appearance_opt.config",
    "load": "appearance_opt.asset",
    "lod": "appearance_opt.jobs.lod",
    "lod_options": "appearance_opt.config",
    "run": "appearance_opt.jobs.spec",
    "save": "appearance_opt.asset",
    "simplify": "appearance_opt.jobs.simplify",
    "simplify_options": "appearance_opt.config",
}

__all__ = [
    "AnimateOptions",
    "AnimateResult",
    "AnimationOptions",
    "AppearanceError",
    "Asset",
    "AssetOptions",
    "BackendError",
    "BakeOptions",
    "BakeResult",
    "BakingOptions",
    "CompareOptions",
    "Comparison",
    "ConvertOptions",
    "DisplacementOptions",
    "DivergedError",
    "FittingOptions",
    "InputError",
    "InspectOptions",
    "Inspection",
    "JobSpec",
    "JointOptions",
    "LodOptions",
    "LodResult",
    "Reference",
    "ReferenceRenderError",
    "Result",
    "SimplifyOptions",
    "SimplifyResult",
    "StartOptions",
    "TextureOptions",
    "ViewOptions",
    "animate",
    "animate_options",
    "bake",
    "bake_options",
    "compare",
    "convert",
    "convert_options",
    "fit",
    "inspect",
    "joint",
    "joint_options",
    "load",
    "lod",
    "lod_options",
    "run",
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
