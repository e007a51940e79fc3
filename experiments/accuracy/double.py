"""A module of the renderer in double precision: its own source, with Dr.Jit's double arrays for
Mitsuba's types."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import mitsuba as mi


def double_arrays() -> Any:
    """Dr.Jit's array types of the device that Mitsuba's variant computes on."""
    return importlib.import_module(
        "drjit.cuda.ad" if mi.variant().startswith("cuda") else "drjit.llvm.ad"
    )


def in_double(module: ModuleType, **replaced: object) -> ModuleType:
    """The module's source executed once more, with double arrays where it says ``mi.Float`` and so
    on. ``replaced``: names of the module to set afterwards, e.g. functions it imports from
    another."""
    arrays = double_arrays()
    three, two = arrays.Array3f64, arrays.Array2f64
    types = SimpleNamespace(
        Float=arrays.Float64, Bool=arrays.Bool, UInt32=arrays.UInt, Int32=arrays.Int,
        Color3f=three, Vector3f=three, Point3f=three, Point2f=two, ArrayXf=arrays.ArrayXf64, ArrayXu=arrays.ArrayXu,
    )  # fmt: skip
    name = f"{module.__name__}_in_double"
    twin = ModuleType(name)
    sys.modules[name] = twin  # dataclasses look their module up there
    kept = sys.modules["mitsuba"]
    sys.modules["mitsuba"] = types  # type: ignore[assignment]
    try:
        exec(compile(Path(str(module.__file__)).read_text(), name, "exec"), twin.__dict__)
    finally:
        sys.modules["mitsuba"] = kept
    twin.__dict__.update(replaced)
    return twin
