"""The command line: parse, call a job, print. No heavy import happens before a command runs."""

from __future__ import annotations

import errno
import logging
import signal
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from appearance_opt import __version__
from appearance_opt.config import as_dict
from appearance_opt.errors import AppearanceError, InputError
from appearance_opt.jobs.spec import JobSpec, run
from appearance_opt.parameters import Command, Given, job_command

if TYPE_CHECKING:
    from appearance_opt.evaluate.comparison import Comparison
    from appearance_opt.jobs.inspect import Inspection

BEGAN = time.perf_counter()
"""Time budgets count from here: importing is part of a run."""

INTERRUPTED = 130
"""Exit code after a Ctrl-C that ended a command: 128 + SIGINT, as shells have it."""

INTERRUPTION = "interrupted; what was written is complete"

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Simplify 3D assets so that the result looks the same.",
)


def main() -> None:
    """Entry point: every expected failure is one line and exit code 2."""
    # what libraries log of the files they read is no message of ours: errors and notes say it
    logging.getLogger().addHandler(logging.NullHandler())
    ours = logging.StreamHandler()
    ours.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    logging.getLogger("appearance_opt").addHandler(ours)
    # schedulers of clusters end a job so: like Ctrl-C, it keeps the best state
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        code = app(standalone_mode=False)
        if code == INTERRUPTED:  # how typer hands on a Ctrl-C
            raise KeyboardInterrupt
        # all is done: a Ctrl-C while the interpreter takes itself apart must not look like a
        # failure
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    except AppearanceError as error:
        _fail(str(error))
    except OSError as error:
        reason = (
            "the disk is full" if error.errno == errno.ENOSPC else (error.strerror or str(error))
        )
        _fail(f"{error.filename or 'file'}: {reason}")
    except KeyboardInterrupt:
        _fail(INTERRUPTION, INTERRUPTED)
    except MemoryError:
        _fail("not enough memory; try a smaller --texture-size, --resolution or --pool")
    except Exception as error:
        # the parser's own errors (typer may bundle its parser, so they are known by what they can
        # do)
        if type(error).__name__ == "Abort":  # a Ctrl-C, in other versions of typer
            _fail(INTERRUPTION, INTERRUPTED)
        if not hasattr(error, "format_message"):
            raise
        _fail(error.format_message())


def _fail(message: str, code: int = 2) -> None:
    print("error: " + " ".join(message.split()), file=sys.stderr)
    sys.exit(code)


def _version(show: bool) -> None:
    if show:
        print(f"appearance-opt {__version__}")
        raise SystemExit(0)


Out = Annotated[Path, typer.Option(help="Result: .glb .gltf .usd* .obj", rich_help_panel="Output")]
Report = Annotated[
    Path | None,
    typer.Option(help="Folder for the report [OUT's name + .report].", rich_help_panel="Output"),
]
NoReport = Annotated[
    bool, typer.Option("--no-report", help="Write no report.", rich_help_panel="Output")
]
Config = Annotated[
    Path | None,
    typer.Option(help="TOML or JSON file with the same keys.", rich_help_panel="Run"),
]
Json = Annotated[bool, typer.Option("--json", help="Print as JSON.", rich_help_panel="Output")]


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Simplify 3D assets so that the result looks the same."""


@job_command(app, "simplify")
def simplify(
    given: Given,
    out: Out,
    report: Report = None,
    no_report: NoReport = False,
    checkpoint: Annotated[
        Path | None, typer.Option(help="Folder for checkpoints.", rich_help_panel="Run")
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on from the checkpoint.", rich_help_panel="Run"),
    ] = False,
    config: Config = None,
) -> None:
    """Write an asset with fewer triangles that looks like INPUT."""
    spec = given.spec(out, config, frozenset({"triangles", "ratio"}))
    folder = None if no_report else report or _report_of(out)
    _run_fit(spec, folder, checkpoint=checkpoint, resume=resume, inputs=_files(config))


@job_command(app, "bake")
def bake(
    given: Given,
    out: Out,
    loose: Annotated[
        Path | None,
        typer.Option(help="Folder for the maps as loose files.", rich_help_panel="Output"),
    ] = None,
    report: Report = None,
    no_report: NoReport = False,
    config: Config = None,
) -> None:
    """Bake what HIGH looks like into the maps of LOW, which keeps its shape."""
    folder = None if no_report else report or _report_of(out)
    spec = given.spec(out, config)
    _run_fit(spec, folder, loose=loose, inputs=_files(config))


@job_command(app, "joint")
def joint(
    given: Given,
    out: Out,
    report: Report = None,
    no_report: NoReport = False,
    config: Config = None,
) -> None:
    """Bake with LOW's shape free: fit it, a displacement, normals and material together."""
    folder = None if no_report else report or _report_of(out)
    _run_fit(given.spec(out, config), folder, inputs=_files(config))


@job_command(app, "compare")
def compare(
    given: Given,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for pictures and a report.", rich_help_panel="Output"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure how different two assets look: PSNR, FLIP, silhouettes."""
    _show_comparison(run(given.spec(out)), as_json)


@job_command(app, "inspect")
def inspect(given: Given, as_json: Json = False) -> None:
    """Say what is in an asset, what is wrong with it, and what simplify will do with each
    material."""
    _show_inspection(run(given.spec()), as_json)


@app.command("run", cls=Command)
def run_file(
    job: Annotated[Path, typer.Argument(metavar="JOB", help="A TOML or JSON file.")],
    report: Report = None,
    no_report: NoReport = False,
    as_json: Json = False,
) -> None:
    """Run the job that a file holds: job, inputs and out beside the options of that job."""
    spec = JobSpec.read(job)
    if spec.kind == "inspect":
        _show_inspection(run(spec), as_json)
    elif spec.kind == "compare":
        _show_comparison(run(spec), as_json)
    elif spec.out is None:
        raise InputError(f"{job}: out: must be the name of a file")
    else:
        _run_fit(spec, None if no_report else report or _report_of(Path(spec.out)), inputs=[job])


@app.command()
def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False) -> None:
    """Say what this machine offers, and what to install when something is missing."""
    from appearance_opt.doctor import diagnose

    found = diagnose()
    if as_json:
        _print_json(found)
    else:
        for name, value in found.items():
            print(f"{name:16} {value}")
    if found["problem"]:
        raise AppearanceError(str(found["problem"]))


def _run_fit(spec: JobSpec, report: Path | None, **surroundings: Any) -> None:
    """Run a job that may fit, and say what it did."""
    from appearance_opt.progress import TerminalProgress

    with TerminalProgress() as progress:
        result = run(spec, report=report, progress=progress, began=BEGAN, **surroundings)
    for note in result.notes:
        print(f"note: {note}", file=sys.stderr)
    if spec.kind == "bake":
        maps = ",".join(as_dict(spec.options)["maps"])
        done = f"{maps}, {100 * result.missed_share:.2f} % of the texels missed"
    else:
        kept = f" and {result.kept_triangles} kept as they are" if result.kept_triangles else ""
        done = f"{result.triangles} of {result.source_triangles} triangles{kept}"
    done += f", {result.seconds['total']:.1f} s"
    if result.fit is not None and result.fit.curve:
        curve = [point.psnr for point in result.fit.curve]
        done += f", held-out PSNR {curve[0]:.2f} -> {max(curve):.2f} dB"
    print(f"{spec.out}: {done}")
    if report is not None and (report / "report.html").is_file():
        print(f"report: {report / 'report.html'}")


def _show_comparison(result: Comparison, as_json: bool) -> None:
    for note in result.notes:
        print(f"note: {note}", file=sys.stderr)
    metrics = result.metrics
    if as_json:
        _print_json(asdict(metrics))
        return
    print(f"PSNR, covered pixels  {metrics.psnr_covered:7.2f} dB")
    print(f"PSNR, whole image     {metrics.psnr:7.2f} dB")
    print(f"FLIP                  {metrics.flip:7.4f}")
    print(f"silhouette IoU        {metrics.silhouette_iou:7.4f}")
    print(f"silhouette shift      {metrics.silhouette_shift:7.3f} px")


def _show_inspection(found: Inspection, as_json: bool) -> None:
    if as_json:
        _print_json(found.record())
    else:
        print("\n".join(found.lines()))


def _report_of(out: Path) -> Path:
    return out.with_name(out.stem + ".report")


def _files(config: Path | None) -> list[Path]:
    return [] if config is None else [config]


def _print_json(record: object) -> None:
    import json

    print(json.dumps(record, indent=1))
