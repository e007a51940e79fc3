"""Parameters of the command line, made from the records of options."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from appearance_opt.config import make_options, read_toml
from appearance_opt.errors import InputError
from appearance_opt.jobs.spec import JobSpec
from appearance_opt.options.jobs import JOBS, PRESETS
from appearance_opt.options.option import Entry, entries, flag_name

PANELS = (
    "Input",
    "Start",
    "Levels",
    "Animation",
    "Fit",
    "Displacement",
    "Baking",
    "Views",
    "Output",
    "Run",
)
"""Headings of the help, in this order; others come after them."""

INPUTS = {
    "INPUT": ".glb .gltf .usd* .obj .ply .stl",
    "HIGH": "What it shall look like.",
    "LOW": "Keeps its topology and its texture coordinates.",
    "KIND": "What SOURCE is: sdf, scene, images or command.",
    "SOURCE": "What it shall look like.",
    "REFERENCE": "What it shall look like.",
    "CANDIDATE": "What is judged.",
}
"""Help of positional arguments."""

WORDS = ("KIND", "SOURCE")
"""Those that are no paths, though a path may be in them."""


class Command(TyperCommand):
    """A command whose help lists options under headings."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the words of a command. Raises InputError for options that are no longer there."""
        for key, hint in JOBS[self.name].hints.items() if self.name in JOBS else ():
            if f"--{flag_name(key)}" in args:
                raise InputError(f"--{flag_name(key)}: {hint}")
        return super().parse_args(ctx, args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the sections of the help."""
        sections: dict[str, list[tuple[str, str]]] = {
            name: [] for name in ("Arguments", *PANELS, "Options")
        }
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is None:
                continue
            panel = getattr(parameter, "rich_help_panel", None)
            if parameter.param_type_name == "argument":
                panel = "Arguments"
            sections.setdefault(panel or "Options", []).append(record)
        for name, rows in sections.items():
            if rows:
                with formatter.section(name):
                    formatter.write_dl(rows)


@dataclass(frozen=True)
class Given:
    """What a user wrote: a ``kind`` of job, its ``inputs``, and ``values`` of options under flat
    keys."""

    kind: str
    inputs: tuple[Path | str, ...]
    values: dict[str, Any]

    def spec(
        self,
        out: Path | None = None,
        config: Path | None = None,
        exclusive: frozenset[str] = frozenset(),
    ) -> JobSpec:
        """The job: what was written on the command line, else in the file ``config``, else by the
        preset. Of ``exclusive`` options one replaces the others. Raises InputError."""
        options = JOBS[self.kind].options
        values = {} if config is None else read_toml(config, options)
        if exclusive & self.values.keys():
            values = {k: v for k, v in values.items() if k not in exclusive}
        values.update(self.values)
        preset = values.pop("preset", "default")
        made = make_options(options, preset, values)
        return JobSpec(self.kind, self.inputs, None if out is None else str(out), made)


def add_command(app: typer.Typer, kind: str, function: Callable[..., None]) -> None:
    """Make ``function(given, **others)`` the command ``kind``: with positional arguments for the
    inputs of that job, its own parameters and an option for each of the job's."""
    job = JOBS[kind]
    _, *own = inspect.signature(function, eval_str=True).parameters.values()
    inputs = [_argument(name) for name in job.inputs]
    options = [_parameter(e) for e in entries(job.options).values()]
    if job.fits:
        options.insert(0, _preset())
    parameters = [p.replace(kind=p.KEYWORD_ONLY) for p in (*inputs, *own, *options)]

    def command(**arguments: Any) -> None:
        paths = tuple(arguments.pop(p.name) for p in inputs)
        values = {p.name: arguments.pop(p.name) for p in options}
        written = {k: v for k, v in values.items() if v is not None and v not in ([], ())}
        function(Given(kind, paths, written), **arguments)

    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in parameters}
    app.command(kind, cls=Command, help=job.help)(command)


def _argument(name: str) -> inspect.Parameter:
    info = typer.Argument(metavar=name, help=INPUTS[name], show_default=False)
    kind = str if name in WORDS else Path
    return inspect.Parameter(
        name.lower(), inspect.Parameter.KEYWORD_ONLY, annotation=Annotated[kind, info]
    )


def _preset() -> inspect.Parameter:
    text = f"{', '.join(PRESETS)}: how long the fit may take. [default: default]"
    info = typer.Option("--preset", help=text, rich_help_panel="Fit", metavar="NAME")
    return _optional("preset", str, info)


def _parameter(entry: Entry) -> inspect.Parameter:
    spec = entry.spec
    if spec.repeated:
        kind: Any = list[str]
    elif spec.parse is not None:
        kind = str
    else:
        words = {"bool": bool, "int": int, "float": float, "str": str}
        kind = next(t for word, t in words.items() if word in entry.kind)
    name = f"--{flag_name(entry.key)}"
    flags = spec.flag or (f"{name}/--no-{flag_name(entry.key)}" if kind is bool else name)
    info = typer.Option(
        flags,
        help=describe(entry),
        rich_help_panel=spec.panel,
        metavar=None if kind is bool else spec.metavar or None,
        show_default=False,
    )
    return _optional(entry.key, kind, info)


def _optional(name: str, kind: Any, info: Any) -> inspect.Parameter:
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=Annotated[kind | None, info],
    )


def describe(entry: Entry) -> str:
    """The help of an option: what it is, what it may be, and its default, in presets, too."""
    spec = entry.spec
    facts = []
    if spec.choices and not spec.expected:
        facts.append(" | ".join(map(str, spec.choices)))
    elif spec.choices or spec.range():
        facts.append(spec.expected or spec.range())
    usual = PRESETS["default"].get(entry.key, entry.default)
    if entry.kind != "bool" or usual:
        shown = _show(entry, usual)
        presets = {n: v[entry.key] for n, v in PRESETS.items() if entry.key in v and n != "default"}
        shown += "".join(f", {n} {_show(entry, v)}" for n, v in presets.items())
        if shown:
            facts.append(f"default: {shown}")
    return f"{spec.help} [{'; '.join(facts)}]" if facts else spec.help


def _show(entry: Entry, value: Any) -> str:
    if value is None or value == ():
        return entry.spec.automatic
    if entry.spec.metavar == "TIME":
        return f"{value:g}s"
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)
