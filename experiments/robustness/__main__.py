"""Runs that are killed, interrupted and out of disk, by the hundreds (docs/reliability.md).

    python -m experiments.robustness [--kinds kills,interrupts,deaths,full] [--count 100] [--suffixes .glb,.gltf]

``kills``: SIGKILL at random moments of a run over an older result, then the same command with
--resume. ``interrupts``: SIGINT and SIGTERM, half of each. ``deaths``: killed at each call that
changes the disk. ``full``: no room left from each such call on. After each, no file under a final
name may be half written, or of another version than the file that refers to it, and inputs are as
they were. Rows go to ``out/robustness/results_*.json`` and are printed. Needs nothing but a C
compiler; kills are shared out among the suffixes.
"""

from __future__ import annotations

import argparse
import json
import signal
from dataclasses import asdict, dataclass, field

import numpy as np

from appearance_opt.publish import recover
from experiments.common import OUT
from experiments.robustness import runs
from experiments.robustness.runs import Case

FOLDER = OUT / "robustness"

STEPS = {"kills": 12, "interrupts": 12, "deaths": 2, "full": 2}
"""Of the fit, after each of which a checkpoint is written."""


@dataclass
class Row:
    """``runs``; of these ``cut``: were they really cut short? ``codes``: how they ended;
    ``faults``: what must not be; ``lost``: largest difference of a resumed run from the whole one
    (dB); ``equal``: resumed runs whose files are those of the whole one byte by byte; ``left``:
    temporary files that outlived the next run."""

    kind: str
    suffix: str
    runs: int = 0
    cut: int = 0
    codes: dict[str, int] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    lost: float = 0.0
    equal: int = 0
    left: int = 0

    def ended(self, ended: runs.Ended) -> None:
        self.runs += 1
        self.codes[str(ended.code)] = self.codes.get(str(ended.code), 0) + 1
        if "Traceback" in ended.text or "Exception ignored" in ended.text:
            self.faults.append("traceback: " + ended.text[-300:])

    def resumed(self, case: Case) -> None:
        """The same command with --resume ends as if nothing had happened."""
        ended = runs.run(case.folder, *case.command, "--resume")
        if ended.code != 0:
            self.faults.append(f"not resumed: {ended.text[-300:]}")
            return
        self.lost = max(self.lost, runs.psnr_lost(case, ended))
        self.equal += case.results() == case.new
        self.faults += case.faults_in(interrupted=True)
        self.left += len(case.left_over())


def kills(case: Case, count: int, seed: int) -> Row:
    row = Row("kills", case.suffix)
    for moment in np.random.default_rng(seed).random(count):
        case.reset()
        ended = runs.run(
            case.folder,
            *case.command,
            before=runs.after(moment * case.whole.seconds, signal.SIGKILL),
        )
        row.ended(ended)
        row.cut += ended.code < 0
        row.faults += case.faults_in()
        row.resumed(case)
    return row


def interrupts(case: Case, count: int, seed: int) -> Row:
    row = Row("interrupts", case.suffix)
    for k, moment in enumerate(np.random.default_rng(seed).random(count)):
        case.reset()
        how = (signal.SIGINT, signal.SIGTERM)[k % 2]
        ended = runs.run(
            case.folder, *case.command, before=runs.after(moment * case.whole.seconds, how)
        )
        row.ended(ended)
        row.cut += "interrupted" in ended.text
        if ended.code not in (0, 130):
            row.faults.append(f"exit code {ended.code}: {ended.text[-300:]}")
        row.faults += case.faults_in(interrupted=True)
        row.left += len(case.left_over())
    return row


def calls_of(case: Case) -> int:
    """How often a whole run changes the disk."""
    case.reset()
    return runs.run(case.folder, *case.command, before=runs.fault(case.folder, 0, kill=False)).calls


def deaths(case: Case) -> Row:
    row = Row("deaths", case.suffix)
    for call in range(1, calls_of(case) + 1):
        case.reset()
        ended = runs.run(
            case.folder, *case.command, before=runs.fault(case.folder, call, kill=True)
        )
        row.ended(ended)
        row.cut += ended.code < 0
        row.faults += [f"call {call}: {f}" for f in case.faults_in()]
        recover(case.folder)
        if case.results() not in (case.old, case.new):
            row.faults.append(f"call {call}: neither the old result nor the new one is whole")
    return row


def full(case: Case) -> Row:
    row = Row("full", case.suffix)
    for call in range(1, calls_of(case) + 1):
        case.reset()
        ended = runs.run(
            case.folder, *case.command, before=runs.fault(case.folder, call, kill=False)
        )
        row.ended(ended)
        row.cut += ended.code != 0
        if ended.code not in (0, 2) or (ended.code == 2 and ended.text.count("error: ") != 1):
            row.faults.append(f"call {call}: exit code {ended.code}: {ended.text[-300:]}")
        if case.results() not in (case.old, case.new):
            row.faults.append(f"call {call}: neither the old result nor the new one is whole")
        row.left += len(case.left_over())
    return row


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--kinds", default="kills,interrupts,deaths,full")
    parser.add_argument("--suffixes", default=".glb,.gltf,.obj,.usda")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    runs.with_faults()
    runs.prepare()
    suffixes = given.suffixes.split(",")
    rows: list[Row] = []
    path = FOLDER / f"results_{given.kinds.replace(',', '_')}{'_'.join(suffixes)}.json"
    for suffix in suffixes:
        for kind in given.kinds.split(","):
            case = Case(FOLDER / f"{kind}{suffix}", suffix, STEPS[kind])
            print(
                f"{kind} {suffix}: {case.whole.seconds:.1f} s a run, {calls_of(case)} changes of the disk",
                flush=True,
            )
            if kind in ("deaths", "full"):
                row = {"deaths": deaths, "full": full}[kind](case)
            else:
                row = {"kills": kills, "interrupts": interrupts}[kind](
                    case, given.count // len(suffixes), given.seed
                )
            rows.append(row)
            path.write_text(json.dumps([asdict(r) for r in rows], indent=1))
            print(table([row]), *row.faults, sep="\n", flush=True)
    print(table(rows))


def table(rows: list[Row]) -> str:
    """Markdown."""
    lines = [
        "| what | format | runs | cut short | ended with | faults | resumed within | equal | left over |",
        "|" + "---|" * 9,
    ]
    for r in rows:
        codes = ", ".join(f"{code}: {count}" for code, count in sorted(r.codes.items()))
        again = (f"{r.lost:.3f} dB", str(r.equal)) if r.kind == "kills" else ("", "")
        cells = (r.kind, r.suffix, r.runs, r.cut, codes, len(r.faults), *again, r.left)
        lines.append("| " + " | ".join(str(c) for c in cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
