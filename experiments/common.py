"""What experiments share: their assets, the neutral renderer, frames, and results that are kept row
by row."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.asset.types import Asset

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ROOT.parent / "shared" / "assets"
"""Models as they are published (docs/reproduce.md)."""

JUDGE = ROOT.parent / "shared" / "judge"
"""A renderer that is not ours, and the same models as heavy GLBs."""

OUT = ROOT / "out"

EMBEDDED = ("relic", "creature")
"""Scenes of this repository, which are built when they are first asked for."""


class Missing(SystemExit):
    """A file that an experiment needs is not there: ends the program with one line, unless it is
    caught."""


def asset(name: str) -> Path:
    """A published model, by its path in ``ASSETS``. Raises Missing."""
    return _there(ASSETS / name)


def source_of(name: str) -> Path:
    """The heavy GLB of that name; the embedded scene is built when it is first asked for. Raises
    Missing."""
    if name not in EMBEDDED:
        return _there(JUDGE / "references" / f"{name}.glb")
    path = OUT / "scenes" / f"{name}.glb"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run(
            [sys.executable, "-m", "scenes.build", name, str(path)], check=True, cwd=ROOT
        )
    return path


def needs_judge() -> None:
    """Raises Missing if the neutral renderer is not there."""
    _there(JUDGE / "evaluate.py")


def _there(path: Path) -> Path:
    if not path.is_file():
        raise Missing(f"{path} is not there: docs/reproduce.md says what experiments need")
    return path


def judge(
    source: Path,
    candidates: dict[str, str],
    stem: Path,
    views: int,
    *,
    seed: int = 1234,
    pictures: Path | None = None,
) -> dict[str, dict]:
    """Scores of the neutral renderer by candidate (a GLB by name), also written to
    ``<stem>.judge.json``. ``seed``: of the views. ``pictures``: a folder for what was seen."""
    scores = Path(f"{stem}.judge.json")
    options = ["--views", str(views), "--spp", "36", "--seed", str(seed), "--json", str(scores)]
    options += [] if pictures is None else ["--dump", str(pictures)]
    command = [
        sys.executable,
        str(JUDGE / "evaluate.py"),
        str(source),
        *candidates.values(),
        *options,
    ]
    _output_of(command, JUDGE)
    return dict(zip(candidates, json.loads(scores.read_text())["candidates"], strict=True))


class Placed:
    """An asset placed for a fit, as a job sees it: ``asset`` in local coordinates, the
    ``subject`` with its ``placement``, its ``reference`` and the ``sampler`` of its views."""

    def __init__(self, asset: Asset, seed: int = 0) -> None:
        from appearance_opt.reference.subject import Subject
        from appearance_opt.stages.parts import split

        asset = split(asset, asset.name, "fit").fitted
        self.subject = Subject.of_asset(asset, seed)
        self.placement, self.sampler = self.subject.placement, self.subject.sampler
        self.asset, self.reference = self.placement.local(asset), self.subject.reference


class Kept:
    """Rows of a JSON file: one that is there with the same key is not run again, each new one is
    written at once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict] = json.loads(path.read_text()) if path.exists() else []

    def of(self, key: dict) -> list[dict]:
        """The rows that have all of these values."""
        return [r for r in self.rows if all(r.get(k) == v for k, v in key.items())]

    def row(self, key: dict, run: Callable[[], dict]) -> dict:
        """The row of ``key`` (its values must survive JSON), made by ``run`` if it is not there."""
        for r in self.of(key):
            return r
        row = {**key, **run()}
        self.rows.append(row)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps(self.rows, indent=1))
        return row


def isolated(code: str, *arguments: str) -> dict:
    """Run a snippet in a fresh process (its time and memory are its own); its last line is JSON."""
    return json.loads(_output_of([sys.executable, "-c", code, *arguments], ROOT).splitlines()[-1])


def _output_of(command: list[str], folder: Path) -> str:
    """What a program prints. Raises RuntimeError with its last words if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return done.stdout
