"""Rows on disk: one line per point of a curve, and one per whole job. A row that is there is not
measured again."""

from __future__ import annotations

import csv
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterable

    from appearance_opt.evaluate.metrics import Metrics


@dataclass(frozen=True)
class CurveRow:
    """A fit of ``budget`` seconds after ``seconds``: covered and whole PSNR in dB, mean FLIP,
    silhouette shift in pixels, over the held-out views."""

    scene: str
    group: str
    lever: str
    budget: float
    seconds: float
    step: int
    psnr_covered: float
    psnr: float
    flip: float
    silhouette_shift: float


@dataclass(frozen=True)
class JobRow:
    """A whole job as a user runs it: ``seconds`` of wall-clock time from the command to its end."""

    scene: str
    job: str
    preset: str
    budget: float
    seconds: float
    psnr_covered: float
    psnr: float
    flip: float
    silhouette_shift: float


Row = TypeVar("Row", CurveRow, JobRow)
METRICS = ("psnr_covered", "psnr", "flip", "silhouette_shift")


def scores(metrics: Metrics) -> dict[str, float]:
    """The numbers that are kept."""
    return {n: round(getattr(metrics, n), 5) for n in METRICS}


def read(path: Path, kind: type[Row]) -> list[Row]:
    """The rows of a file, none where it is not there."""
    if not path.exists():
        return []
    convert = {"str": str, "float": float, "int": int}
    with path.open(newline="", encoding="utf-8") as file:
        return [
            kind(**{f.name: convert[str(f.type)](r[f.name]) for f in fields(kind)})
            for r in csv.DictReader(file)
        ]


def write(path: Path, rows: Iterable[Row], kind: type[Row]) -> None:
    """Write under a temporary name, then rename: an interrupted run keeps what it had."""
    path.parent.mkdir(parents=True, exist_ok=True)
    building = path.with_suffix(".tmp")
    with building.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(kind)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(r) for r in rows)
    building.replace(path)
