"""Whole jobs as a user runs them: the command line, start of the program, set-up and report
included."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from appearance_opt.asset import load
from appearance_opt.config import PRESETS
from experiments.common import ROOT
from experiments.speed_vs_error.results import JobRow, scores
from experiments.speed_vs_error.subjects import OUT

if TYPE_CHECKING:
    from experiments.speed_vs_error.subjects import Bench


@dataclass(frozen=True)
class Job:
    """A preset with a ``budget`` in seconds: its own (None), another one, or 0 for its start
    without a fit."""

    preset: str
    budget: int | None = None

    @property
    def seconds(self) -> float:
        """The time asked for."""
        return PRESETS[self.preset]["budget"] if self.budget is None else self.budget

    @property
    def name(self) -> str:
        """Short, unique."""
        if self.budget is None:
            return self.preset
        return f"{self.preset}, {'no fit' if self.budget == 0 else f'{self.budget} s'}"

    @property
    def arguments(self) -> list[str]:
        """For the command line."""
        if self.budget is None:
            return ["--preset", self.preset]
        stop = ["--steps", "0"] if self.budget == 0 else ["--budget", f"{self.budget}s"]
        return ["--preset", self.preset, *stop]


SHORT = (Job("draft", 0), Job("draft"), Job("default", 17), Job("default", 30))
JOBS = {
    "flight_helmet": (
        *SHORT,
        Job("draft", 65),
        Job("default"),
        Job("final", 65),
        Job("final"),
        Job("default", 280),
    ),
    "demo scene": (*SHORT, Job("draft", 30), Job("default")),
}
"""By scene. What could keep a preset from the Pareto front is another one with the same time."""


def run_job(bench: Bench, job: Job) -> JobRow:
    """Run the command, measure what it wrote."""
    OUT.mkdir(parents=True, exist_ok=True)
    stem = f"{bench.subject.name}_{job.name}".replace(" ", "_").replace(",", "")
    result = OUT / "jobs" / f"{stem}.glb"
    result.parent.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "appearance_opt", "simplify", str(bench.subject.path())]
    command += [*bench.subject.arguments, *job.arguments, "--out", str(result)]
    began = time.perf_counter()
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    seconds = time.perf_counter() - began
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")
    metrics = bench.measure_asset(load(result))
    return JobRow(
        bench.subject.name, job.name, job.preset, job.seconds, round(seconds, 2), **scores(metrics)
    )
