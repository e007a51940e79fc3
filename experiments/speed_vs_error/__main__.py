"""Speed against error: every lever of a fit on its own, and whole jobs, PSNR and FLIP against wall-clock time.

    python -m experiments.speed_vs_error [--scenes ...] [--levers ...] [--seconds 15] [--jobs ...]
    python -m experiments.speed_vs_error --write-docs

Rows are appended to out/speed_vs_error/curves.csv (one fit of ``--seconds``, measured at several times) and jobs.csv
(one command as a user runs it); those that are there are not run again. ``--write-docs`` measures nothing: it draws
the pictures and puts tables and numbers into docs/. Scenes other than the embedded one need the folder
``../shared/judge/references``, and are left out without it.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from pathlib import Path

from experiments.speed_vs_error import plots, tables
from experiments.speed_vs_error.results import CurveRow, JobRow, read, scores, write
from experiments.speed_vs_error.runner import Point, run
from experiments.speed_vs_error.setups import DEFAULT, GROUPS, LEVERS, UNAVERAGED, Lever, Setup, default_setup
from experiments.speed_vs_error.subjects import OUT, ROOT, SUBJECTS, Bench, Subject
from experiments.speed_vs_error.whole_jobs import JOBS, run_job

CURVES, WHOLE = OUT / "curves.csv", OUT / "jobs.csv"
DOCUMENT, IMAGES = ROOT / "docs" / "speed_vs_error.md", ROOT / "docs" / "images"


def main() -> None:
    a = _arguments()
    if a.write_docs:
        write_docs(a.seconds)
        return
    for subject in _chosen(SUBJECTS, a.scenes):
        try:
            subject.path()
        except FileNotFoundError as missing:
            print(f"{subject.name}: {missing} is not there, left out", flush=True)
            continue
        run_subject(subject, _levers(a.levers), a.seconds, a.jobs)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default="", help=f"some of: {'; '.join(s.name for s in SUBJECTS)} (separated by ;)")
    parser.add_argument("--levers", default="core", help="core, all, none, or names separated by ;")
    parser.add_argument("--seconds", type=float, default=15.0, help="length of each fit [15]")
    parser.add_argument("--jobs", default="all", help="all, none, or names of whole jobs separated by ;")
    parser.add_argument("--write-docs", action="store_true", help="pictures and tables into docs/, no measuring")
    return parser.parse_args()


def _names(text: str) -> list[str]:
    return [n.strip() for n in text.split(";") if n.strip()]


def _chosen(subjects: tuple[Subject, ...], text: str) -> list[Subject]:
    wanted = _names(text)
    unknown = set(wanted) - {s.name for s in subjects}
    if unknown:
        sys.exit(f"--scenes {text}: no scene '{unknown.pop()}'; there are {'; '.join(s.name for s in subjects)}")
    return [s for s in subjects if not wanted or s.name in wanted]


def _levers(text: str) -> list[Lever]:
    if text in ("core", "all", "none"):
        return [lever for lever in LEVERS if text == "all" or (text == "core" and lever.core)]
    wanted = _names(text)
    unknown = set(wanted) - {lever.name for lever in LEVERS}
    if unknown:
        sys.exit(f"--levers {text}: no lever '{unknown.pop()}'; there are {'; '.join(lever.name for lever in LEVERS)}")
    return [lever for lever in LEVERS if lever.name in wanted]


def run_subject(subject: Subject, levers: list[Lever], seconds: float, jobs: str) -> None:
    """All rows of a scene that are asked for and not there."""
    rows, whole = read(CURVES, CurveRow), read(WHOLE, JobRow)
    done = {(r.scene, r.lever, r.budget) for r in rows}
    levers = [lever for lever in levers if (subject.name, lever.name, seconds) not in done]
    ran = {(r.scene, r.job) for r in whole}
    todo = [j for j in JOBS.get(subject.name, ()) if (subject.name, j.name) not in ran]
    if jobs != "all":
        todo = [j for j in todo if j.name in _names(jobs)]
    if not levers and not todo:
        print(f"{subject.name}: nothing to do", flush=True)
        return
    from appearance_opt import backend

    backend.select("cpu")
    began = time.perf_counter()
    bench = Bench(subject)
    setup = default_setup(subject.grown, len(bench.start(256).mesh.faces) if subject.grown else 0)
    print(f"{subject.name}: {len(levers)} fits of {seconds:g} s, {len(todo)} whole jobs", flush=True)
    for lever in levers:
        changed = lever.change(setup)
        if changed is None:
            continue
        rows += run_lever(bench, lever, changed, seconds)
        write(CURVES, rows, CurveRow)
        own = tables.curve(rows, subject.name, lever.name)
        found = tables.against_default([r for r in rows if r.budget == seconds], subject.name, lever.name)
        against = "" if found is None else f", {found[0]:+.2f} dB, FLIP x {found[1]:.3f}"
        print(
            f"  [{time.perf_counter() - began:5.0f} s] {lever.name}: {own[-1].step} steps, "
            f"{own[-1].psnr_covered:.2f} dB{against}",
            flush=True,
        )
    for job in todo:
        whole.append(run_job(bench, job))
        write(WHOLE, whole, JobRow)
        print(
            f"  [{time.perf_counter() - began:5.0f} s] job {job.name}: {whole[-1].seconds:.1f} s, "
            f"{whole[-1].psnr_covered:.2f} dB, FLIP {whole[-1].flip:.4f}",
            flush=True,
        )


def run_lever(bench: Bench, lever: Lever, setup: Setup, seconds: float) -> list[CurveRow]:
    """The curve of one fit; that of the default twice, with and without averaging."""
    fitted = run(bench, setup, seconds)

    def rows(name: str, points: list[Point]) -> list[CurveRow]:
        return [
            CurveRow(bench.subject.name, lever.group, name, seconds, round(p.seconds, 3), p.step, **scores(p.metrics))
            for p in points
        ]

    out = rows(lever.name, fitted.measured())
    if lever.name == DEFAULT:
        out += rows(UNAVERAGED, fitted.measured(averaged=False))
    return out


def write_docs(seconds: float) -> None:
    """Pictures, tables and CSV into docs/, from the rows of fits of ``seconds``."""
    order = {s.name: k for k, s in enumerate(SUBJECTS)}
    place = {name: k for k, name in enumerate(GROUPS)}
    curves = [r for r in read(CURVES, CurveRow) if r.budget == seconds]
    curves.sort(key=lambda r: (order[r.scene], place[r.lever], r.seconds))
    jobs = sorted(read(WHOLE, JobRow), key=lambda r: (order[r.scene], r.seconds))
    if not curves and not jobs:
        sys.exit(f"no rows of {seconds:g} s in {OUT}: run the experiment first")
    for path in plots.draw(curves, jobs, IMAGES):
        print(path.relative_to(ROOT))
    write(IMAGES / "speed_vs_error_curves.csv", curves, CurveRow)
    write(IMAGES / "speed_vs_error_jobs.csv", jobs, JobRow)
    sections = {
        "machine": f"{os.cpu_count()} cores, {_processor()}; fits of {seconds:g} s.",
        "levers": tables.lever_table(curves),
        "jobs": tables.job_table(jobs),
    }
    tables.insert(DOCUMENT, sections)
    print(DOCUMENT.relative_to(ROOT))


def _processor() -> str:
    """Name of the processor, as the system gives it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
