"""Jobs look at the mesh in many large views: where texels are missing, where triangles should go,
for the report.

What they decide by these views is tested on its own; tests of whole jobs need few and small ones.
"""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import Any

from appearance_opt.evaluate.showing import Looks

SMALL: dict[str, dict[str, Any]] = {
    "appearance_opt.initial.density": {"BATCHES": 1, "RESOLUTION": 64},
    "appearance_opt.initial.reallocate": {"RESOLUTION": 64},
    "appearance_opt.jobs.report": {"LOOKS": Looks(views=2, resolution=64, pictured=64)},
    "appearance_opt.initial.decimation": {"VISIBILITY_VIEWS": 64},
    "appearance_opt.stages.growth": {"RESOLUTION": 64, "POOL": 64},
}
"""Values of module constants."""


def make_small() -> dict[str, dict[str, Any]]:
    """Set ``SMALL``, in this process; returns what was there."""
    before: dict[str, dict[str, Any]] = {}
    for name, values in SMALL.items():
        module = import_module(name)
        before[name] = {constant: getattr(module, constant) for constant in values}
        for constant, value in values.items():
            setattr(module, constant, value)
    return before


def restore(before: dict[str, dict[str, Any]]) -> None:
    """Undo ``make_small``."""
    for name, values in before.items():
        for constant, value in values.items():
            setattr(import_module(name), constant, value)


# `python -m` ends by the signal itself, whatever the exit code, when an interrupt came while a C
# extension ran Python code
COMMAND = """
import sys
from tests.looks import make_small
make_small()
from appearance_opt.cli import main
sys.exit(main())
"""
"""Python code of the installed command with small looks, for ``python -c`` with this checkout in
PYTHONPATH."""

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1])}
"""Of processes: the package beside these tests, whatever is installed."""
