"""Validators of others, where they are installed."""

from __future__ import annotations

import json
import shutil
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
_SCRIPT = """
const fs = require('fs'), path = require('path'), file = process.argv[1];
require('gltf-validator').validateBytes(new Uint8Array(fs.readFileSync(file)), {
  uri: path.basename(file),
  externalResourceFunction: uri => Promise.resolve(new Uint8Array(
    fs.readFileSync(path.join(path.dirname(file), decodeURIComponent(uri))))),
}).then(report => console.log(JSON.stringify(report.issues)));
"""

UNKNOWN_TO_IT = ("KHR_texture_basisu", "image/ktx2", "EXT_meshopt_compression")
"""What the Khronos validator does not know: it cannot judge it, and warns of that."""


@cache
def _node() -> str | None:
    node = shutil.which("node")
    if node is None:
        return None
    found = subprocess.run(
        [node, "-e", "require.resolve('gltf-validator')"], capture_output=True, cwd=ROOT
    )
    return None if found.returncode else node


def khronos_messages(path: Path) -> list[dict[str, Any]]:
    """Errors and warnings of the Khronos validator about a glTF file. Skips the test without it."""
    node = _node()
    if node is None:
        pytest.skip(
            "node with the package gltf-validator is not there (npm install gltf-validator)"
        )
    out = subprocess.run(
        [node, "-e", _SCRIPT, str(path)], capture_output=True, text=True, check=True, cwd=ROOT
    )
    return [m for m in json.loads(out.stdout)["messages"] if m["severity"] < 2]


def usd_messages(path: Path) -> list[str]:
    """What OpenUSD's validators say against a file; of versions before 25, its checker, with the
    rules of ARKit for packages."""
    from pxr import Usd, UsdUtils

    if hasattr(UsdUtils, "ComplianceChecker"):
        checker = UsdUtils.ComplianceChecker(arkit=path.suffix == ".usdz")
        checker.CheckCompliance(str(path))
        return [*checker.GetErrors(), *checker.GetFailedChecks(), *checker.GetWarnings()]
    from pxr import UsdValidation

    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    stage = Usd.Stage.Open(str(path))
    return [f"{e.GetName()}: {e.GetMessage()}" for e in context.Validate(stage)]
