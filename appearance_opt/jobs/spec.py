"""A job as a value: what a command line, a batch or a report stores, and the one way to run it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from appearance_opt.config import JOBS, as_dict, flat_keys, make_options, read_table
from appearance_opt.errors import InputError
from appearance_opt.options.option import Record, check_choice

_OWN = ("job", "inputs", "out")


@dataclass(frozen=True)
class JobSpec:
    """``kind``: a key of ``options.jobs.JOBS``. ``inputs``: paths, or assets, in the order of its
    ``inputs``. ``out``: file or folder of the result; None: nothing is written. Raises InputError
    for what does not belong together."""

    kind: str
    inputs: tuple[Any, ...]
    out: str | None
    options: Record

    def __post_init__(self) -> None:
        check_choice("job", self.kind, tuple(JOBS))
        job = JOBS[self.kind]
        if len(self.inputs) != len(job.inputs):
            raise InputError(
                f"{self.kind}: needs {' and '.join(job.inputs)}, not {len(self.inputs)} inputs"
            )
        if not isinstance(self.options, job.options):
            raise InputError(
                f"{self.kind}: takes {job.options.__name__}, not {type(self.options).__name__}"
            )

    def as_dict(self) -> dict[str, Any]:
        """Plain values under flat keys, for JSON. Raises InputError if an input is no file."""
        if not all(isinstance(i, (str, Path)) for i in self.inputs):
            raise InputError(f"{self.kind}: only jobs whose inputs are files can be stored")
        own = {"job": self.kind, "inputs": [str(i) for i in self.inputs], "out": self.out}
        values = as_dict(self.options)
        return own | {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> JobSpec:
        """The reverse of ``as_dict``; options that are missing are those of ``preset``, by default
        "default". Raises InputError."""
        rest = dict(values)
        kind, inputs, out = (rest.pop(name, None) for name in _OWN)
        check_choice("job", kind, tuple(JOBS))
        if not isinstance(inputs, (list, tuple)) or not all(isinstance(i, str) for i in inputs):
            raise InputError("inputs: must be a list of files")
        if out is not None and not isinstance(out, str):
            raise InputError("out: must be the name of a file")
        options = make_options(JOBS[kind].options, rest.pop("preset", "default"), rest)
        return cls(kind, tuple(inputs), out, options)

    def to_toml(self) -> str:
        """The same as a TOML file, which ``read`` reads. Raises InputError."""
        values = self.as_dict()
        if values.get("budget", 0) is None:
            values["budget"] = "none"  # else it would be the preset's
        lines = (f"{k} = {_toml(v)}" for k, v in values.items() if v is not None)
        return "\n".join(lines) + "\n"

    @classmethod
    def read(cls, path: str | Path) -> JobSpec:
        """A job from a TOML file, or from a JSON file by its suffix. Paths are relative to the
        current folder. Raises InputError."""
        path = Path(path)
        values = read_table(path)
        kind = values.get("job")
        if isinstance(kind, str) and kind in JOBS:
            values = flat_keys(path, values, JOBS[kind].options, _OWN)
        try:
            return cls.from_dict(values)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error


def _toml(value: Any) -> str:
    # basic strings of TOML are written like those of JSON, but for one more control character
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def run(spec: JobSpec, **surroundings: Any) -> Any:
    """Run a job: the recipe of ``spec.kind`` with its inputs, out and options. ``surroundings``:
    what the recipe takes beside them, and no option of the result: progress, report, checkpoint,
    ... Raises AppearanceError."""
    recipe = getattr(import_module(f"appearance_opt.jobs.{spec.kind}"), spec.kind)
    if JOBS[spec.kind].writes:
        surroundings["out"] = spec.out
    return recipe(*spec.inputs, options=spec.options, **surroundings)
