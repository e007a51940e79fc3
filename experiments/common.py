"""What experiments share: their assets, results that are kept row by row, and welded geometry."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.asset.types import Asset

ROOT = Path(__file__).resolve().parents[1]
JUDGE = ROOT.parent / "shared" / "judge"
"""A renderer that is not ours, and reference GLBs."""

OUT = ROOT / "out"


def source_of(asset: str) -> Path:
    """The heavy asset; the procedural ones are built when they are first asked for."""
    if asset != "relic":
        return JUDGE / "references" / f"{asset}.glb"
    path = OUT / "scenes" / f"{asset}.glb"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run([sys.executable, "-m", "scenes.build", asset, str(path)], check=True, cwd=ROOT)
    return path


class Framed:
    """An asset in the frame of a fit, as a job sees it: ``asset`` moved there, ``frame`` (centre, scale), its
    ``reference`` and the ``sampler`` of its views."""

    def __init__(self, asset: Asset, seed: int = 0) -> None:
        from appearance_opt.jobs.simplify import in_frame, support
        from appearance_opt.reference.mesh import MeshReference
        from appearance_opt.views import ViewSampler, framing

        self.frame = framing(np.concatenate([m.positions for m in asset.meshes]))
        self.asset = in_frame(asset, *self.frame)
        self.reference = MeshReference(self.asset)
        self.sampler = ViewSampler((0.0, 0.0, 0.0), 1.0, seed, hull=support(self.reference.merged.positions))


class Kept:
    """Rows of a JSON file: one that is there with the same key is not run again, each new one is written at once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict] = json.loads(path.read_text()) if path.exists() else []

    def row(self, key: dict, run: Callable[[], dict]) -> dict:
        """The row of ``key`` (its values must survive JSON), made by ``run`` if it is not there."""
        for r in self.rows:
            if all(r.get(k) == v for k, v in key.items()):
                return r
        row = {**key, **run()}
        self.rows.append(row)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps(self.rows, indent=1))
        return row


def isolated(code: str, *arguments: str) -> dict:
    """Run a snippet in a fresh process (its time and memory are its own); its last line is JSON."""
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])
