"""Speed against error: every lever of a fit on its own, and whole jobs, PSNR and FLIP against
wall-clock time.

    python -m experiments.speed_vs_error [--scenes ...] [--levers ...] [--seconds 12] [--jobs ...]
    python -m experiments.speed_vs_error --levers reference --seconds 50 --jobs none --scenes "chess_king"
    python -m experiments.speed_vs_error --write-docs

Rows are appended to out/speed_vs_error/curves.csv (one fit of ``--seconds``, measured at several
times) and jobs.csv (one command as a user runs it); those that are there are not run again.
``--write-docs`` measures nothing: it draws the pictures and puts tables and numbers into docs/.
Scenes other than the embedded one need the folder ``../shared/judge/references``, and are left out
without it.
"""

from __future__ import annotations

import argparse
import logging
import os
import platform
import sys
import time
from pathlib import Path

from experiments.common import ROOT, Missing
from experiments.speed_vs_error import plots, tables
from experiments.speed_vs_error.results import CurveRow, JobRow, read, scores, write
from experiments.speed_vs_error.runner import Point, run
from experiments.speed_vs_error.setups import (
    DEFAULT,
    GROUPS,
    LEVERS,
    UNAVERAGED,
    Lever,
    Setup,
    default_setup,
)
from experiments.speed_vs_error.subjects import OUT, SUBJECTS, Bench, Subject
from experiments.speed_vs_error.whole_jobs import JOBS, run_job

CURVES, WHOLE = OUT / "curves.csv", OUT / "jobs.csv"
LONG = 50.0
"""Seconds of the fits that tell how often a reference view should be seen."""
DOCUMENT, IMAGES = ROOT / "docs" / "speed_vs_error.md", ROOT / "docs" / "images"


def main() -> None:
    a = _arguments()
    if a.write_docs:
        write_docs(a.seconds)
        return
    # told of every fit that is stopped to be gone on with at another resolution
    logging.getLogger("appearance_opt.optimize.loop").addFilter(
        lambda record: "interrupted" not in record.msg
    )
    subjects, levers = [s for s in _chosen(SUBJECTS, a.scenes) if _is_there(s)], _levers(a.levers)
    for subject in subjects:
        run_levers(subject, levers, a.seconds)
    for subject in subjects:
        run_jobs(subject, a.jobs)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scenes",
        default="",
        help=f"some of: {'; '.join(s.name for s in SUBJECTS)} (separated by ;)",
    )
    parser.add_argument(
        "--levers", default="core", help="core, reference, all, none, or names separated by ;"
    )
    parser.add_argument("--seconds", type=float, default=12.0, help="length of each fit [12]")
    parser.add_argument(
        "--jobs", default="all", help="all, none, or names of whole jobs separated by ;"
    )
    parser.add_argument(
        "--write-docs", action="store_true", help="pictures and tables into docs/, no measuring"
    )
    return parser.parse_args()


def _names(text: str) -> list[str]:
    return [n.strip() for n in text.split(";") if n.strip()]


def _chosen(subjects: tuple[Subject, ...], text: str) -> list[Subject]:
    wanted = _names(text)
    unknown = set(wanted) - {s.name for s in subjects}
    if unknown:
        sys.exit(
            f"--scenes {text}: no scene '{unknown.pop()}'; there are {'; '.join(s.name for s in subjects)}"
        )
    return [s for s in subjects if not wanted or s.name in wanted]


def _levers(text: str) -> list[Lever]:
    if text == "reference":  # how its images are used: only a long fit can tell
        return [lever for lever in LEVERS if lever.name == DEFAULT or lever.group == text]
    if text in ("core", "all", "none"):
        return [lever for lever in LEVERS if text == "all" or (text == "core" and lever.core)]
    wanted = _names(text)
    unknown = set(wanted) - {lever.name for lever in LEVERS}
    if unknown:
        sys.exit(
            f"--levers {text}: no lever '{unknown.pop()}'; there are {'; '.join(lever.name for lever in LEVERS)}"
        )
    return [lever for lever in LEVERS if lever.name in wanted]


def _is_there(subject: Subject) -> bool:
    try:
        subject.path()
    except Missing as missing:
        print(f"{subject.name} is left out: {missing}", flush=True)
        return False
    return True


def run_levers(subject: Subject, levers: list[Lever], seconds: float) -> None:
    """All fits of a scene that are asked for and not there."""
    rows = read(CURVES, CurveRow)
    done = {(r.scene, r.lever, r.budget) for r in rows}
    todo = [lever for lever in levers if (subject.name, lever.name, seconds) not in done]
    if not todo:
        return
    from appearance_opt import backend

    began = time.perf_counter()
    bench = _bench(subject)
    setup = default_setup(subject.grown, len(bench.start(256).mesh.faces) if subject.grown else 0)
    print(f"{subject.name}: at most {len(todo)} fits of {seconds:g} s", flush=True)
    for lever in todo:
        changed = lever.change(setup)
        if changed is None:
            continue
        rows += run_lever(bench, lever, changed, seconds)
        backend.release_memory()  # what 2048² textures took is not to be carried along
        write(CURVES, rows, CurveRow)
        fits = [r for r in rows if r.budget == seconds]
        end = tables.curve(fits, subject.name, lever.name)[-1]
        found = tables.against_default(fits, subject.name, lever.name)
        against = (
            ""
            if found is None
            else f", {found[0]:+.2f} dB, FLIP x {found[1]:.3f} against the default"
        )
        print(
            f"  [{time.perf_counter() - began:4.0f} s] {lever.name}: {end.step} steps, {end.psnr_covered:.2f} dB"
            f"{against}",
            flush=True,
        )


def run_jobs(subject: Subject, names: str) -> None:
    """All whole jobs of a scene that are asked for and not there."""
    rows = read(WHOLE, JobRow)
    done = {(r.scene, r.job) for r in rows}
    jobs = [j for j in JOBS.get(subject.name, ()) if names == "all" or j.name in _names(names)]
    todo = [j for j in jobs if (subject.name, j.name) not in done]
    if not todo:
        return
    bench = _bench(subject)
    print(
        f"{subject.name}: {len(todo)} whole jobs, {sum(j.seconds for j in todo):.0f} s and more",
        flush=True,
    )
    for job in todo:
        rows.append(run_job(bench, job))
        write(WHOLE, rows, JobRow)
        last = rows[-1]
        print(
            f"  {job.name}: {last.seconds:.1f} s, {last.psnr_covered:.2f} dB, FLIP {last.flip:.4f}",
            flush=True,
        )


def _bench(subject: Subject) -> Bench:
    from appearance_opt import backend

    backend.select("cpu")
    return Bench(subject)


def run_lever(bench: Bench, lever: Lever, setup: Setup, seconds: float) -> list[CurveRow]:
    """The curve of one fit; that of the default twice, with and without averaging."""
    fitted = run(bench, setup, seconds)

    def rows(name: str, points: list[Point]) -> list[CurveRow]:
        return [
            CurveRow(
                bench.subject.name,
                lever.group,
                name,
                seconds,
                round(p.seconds, 3),
                p.step,
                **scores(p.metrics),
            )
            for p in points
        ]

    out = rows(lever.name, fitted.measured())
    if lever.name == DEFAULT:
        out += rows(UNAVERAGED, fitted.measured(averaged=False))
    return out


def write_docs(seconds: float) -> None:
    """Pictures, tables and CSV into docs/, from the rows of fits of ``seconds``."""
    from appearance_opt import backend

    order = {s.name: k for k, s in enumerate(SUBJECTS)}
    place = {name: k for k, name in enumerate(GROUPS)}
    # a lever or a scene that is there no more says nothing of the present code
    every = [r for r in read(CURVES, CurveRow) if r.lever in place and r.scene in order]
    every.sort(key=lambda r: (order[r.scene], place[r.lever], r.seconds))
    curves, long = ([r for r in every if r.budget == s] for s in (seconds, LONG))
    jobs = sorted(
        (r for r in read(WHOLE, JobRow) if r.scene in order),
        key=lambda r: (order[r.scene], r.seconds),
    )
    if not any(r.lever == DEFAULT for r in curves):
        sys.exit(
            f"no fit of {seconds:g} s with default settings in {CURVES}: run the experiment first"
        )
    machine = f"{os.cpu_count()} cores of an {_processor()}, LLVM {backend.select('cpu').llvm}; fits of {seconds:g} s."
    sections = {"machine": f"Machine: {machine}", "levers": "", "jobs": ""}
    IMAGES.mkdir(parents=True, exist_ok=True)
    sections["levers"] = _section(plots.draw_levers(curves, IMAGES), tables.lever_table(curves))
    write(IMAGES / "speed_vs_error_curves.csv", curves, CurveRow)
    if long:
        sections["long"] = tables.lever_table(long)
        write(IMAGES / "speed_vs_error_long.csv", long, CurveRow)
    if jobs:
        sections["jobs"] = _section(plots.draw_jobs(jobs, IMAGES), tables.job_table(jobs))
        write(IMAGES / "speed_vs_error_jobs.csv", jobs, JobRow)
    tables.insert(DOCUMENT, sections)
    print(DOCUMENT.relative_to(ROOT))


def _section(pictures: dict[str, Path], table: str) -> str:
    """The first picture, the table, the other pictures."""
    images = [
        f"![{title}]({path.relative_to(DOCUMENT.parent).as_posix()})"
        for title, path in pictures.items()
    ]
    return "\n\n".join([images[0], table, *images[1:]])


def _processor() -> str:
    """Name of the processor, as the system gives it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
