"""The command line: parse, call a job, print. No heavy import happens before a command runs."""

from __future__ import annotations

import errno
import logging
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from appearance_opt import __version__
from appearance_opt.config import JOBS
from appearance_opt.errors import AppearanceError, InputError
from appearance_opt.jobs.spec import JobSpec, run
from appearance_opt.parameters import Command, Given, add_command

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
    as_json: Json = False,
) -> None:
    """Run a job whose state can be kept: ``simplify`` or ``lod``."""
    counts = {"triangles", "ratio"} | ({"max_error"} if given.kind == "simplify" else set())
    spec = given.spec(out, config, frozenset(counts))
    kept = {"checkpoint": checkpoint, "resume": resume}
    _run(spec, as_json, _folder(out, report, no_report), _files(config), **kept)


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
    as_json: Json = False,
) -> None:
    """Run the command of that name."""
    folder = _folder(out, report, no_report)
    _run(given.spec(out, config), as_json, folder, _files(config), loose=loose)


def make_asset(
    given: Given,
    out: Out,
    report: Report = None,
    no_report: NoReport = False,
    config: Config = None,
    as_json: Json = False,
) -> None:
    """Run a job that makes an asset, and needs no more than all of them do."""
    _run(given.spec(out, config), as_json, _folder(out, report, no_report), _files(config))


def compare(
    given: Given,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for pictures and a report.", rich_help_panel="Output"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Run the command of that name."""
    _run(given.spec(out), as_json)


def inspect(given: Given, as_json: Json = False) -> None:
    """Run the command of that name."""
    _run(given.spec(), as_json)


COMMANDS: dict[str, Callable[..., None]] = {
    "simplify": simplify,
    "lod": simplify,
    "convert": simplify,
    "bake": bake,
    "compare": compare,
    "inspect": inspect,
}

for _kind in JOBS:
    add_command(app, _kind, COMMANDS.get(_kind, make_asset))


@app.command("run", cls=Command)
def run_file(
    job: Annotated[Path, typer.Argument(metavar="JOB", help="A TOML or JSON file.")],
    report: Report = None,
    no_report: NoReport = False,
    as_json: Json = False,
) -> None:
    """Run the job that a file holds: job, inputs and out beside the options of that job."""
    spec = JobSpec.read(job)
    if not JOBS[spec.kind].fits:
        _run(spec, as_json)
        return
    if spec.out is None:
        raise InputError(f"{job}: out: must be the name of a file")
    _run(spec, as_json, _folder(Path(spec.out), report, no_report), [job])


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


def _run(
    spec: JobSpec,
    as_json: bool,
    report: Path | None = None,
    inputs: list[Path] | None = None,
    **surroundings: Any,
) -> None:
    """Run a job and say what came of it."""
    if JOBS[spec.kind].fits:
        from appearance_opt.progress import TerminalProgress

        with TerminalProgress() as progress:
            surroundings |= {"report": report, "progress": progress, "began": BEGAN}
            result = run(spec, inputs=inputs or [], **surroundings)
    else:
        result = run(spec)
    if spec.kind != "inspect":  # which has notes among its lines
        for note in result.notes:
            print(f"note: {note}", file=sys.stderr)
    if as_json:
        _print_json(result.record())
        return
    place = f"{spec.out}: " if JOBS[spec.kind].fits else ""
    print(place + "\n".join(result.lines()))
    if report is not None and (report / "report.html").is_file():
        print(f"report: {report / 'report.html'}")


def _folder(out: Path, report: Path | None, no_report: bool) -> Path | None:
    """Where the report goes."""
    return None if no_report else report or out.with_name(out.stem + ".report")


def _files(config: Path | None) -> list[Path]:
    return [] if config is None else [config]


def _print_json(record: object) -> None:
    import json

    print(json.dumps(record, indent=1))
