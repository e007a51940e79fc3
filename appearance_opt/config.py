"""Options under flat keys: from a preset, a file, the command line or Python, to the records of a job
and back."""

from __future__ import annotations

import difflib
import json
import sys
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar

from appearance_opt.errors import InputError
from appearance_opt.options.jobs import (
    JOBS,
    PRESETS,
    AnimateOptions,
    BakeOptions,
    CommonOptions,
    CompareOptions,
    ConvertOptions,
    InspectOptions,
    JointOptions,
    LodOptions,
    SimplifyOptions,
)
from appearance_opt.options.option import Record, check_choice, entries, flag_name, spelling

__all__ = [
    "JOBS",
    "PRESETS",
    "AnimateOptions",
    "BakeOptions",
    "CommonOptions",
    "CompareOptions",
    "ConvertOptions",
    "InspectOptions",
    "JointOptions",
    "LodOptions",
    "SimplifyOptions",
    "animate_options",
    "as_dict",
    "bake_options",
    "convert_options",
    "flat_keys",
    "joint_options",
    "lod_options",
    "make_options",
    "read_table",
    "read_toml",
    "resolve_options",
    "simplify_options",
    "with_values",
]

T = TypeVar("T", bound=Record)


def simplify_options(preset: str = "default", **values: Any) -> SimplifyOptions:
    """Options from a preset and what overrides it. Raises InputError for unknown names and bad
    values."""
    return make_options(SimplifyOptions, preset, values)


def animate_options(preset: str = "default", **values: Any) -> AnimateOptions:
    """The same for an animated character."""
    return make_options(AnimateOptions, preset, values)


def lod_options(preset: str = "default", **values: Any) -> LodOptions:
    """The same for a chain of levels of detail."""
    return make_options(LodOptions, preset, values)


def bake_options(preset: str = "default", **values: Any) -> BakeOptions:
    """The same for a bake."""
    return make_options(BakeOptions, preset, values)


def convert_options(preset: str = "default", **values: Any) -> ConvertOptions:
    """The same for a conversion."""
    return make_options(ConvertOptions, preset, values)


def joint_options(preset: str = "default", **values: Any) -> JointOptions:
    """The same for a bake with LOW's shape free."""
    return make_options(JointOptions, preset, values)


def make_options(kind: type[T], preset: str, values: Mapping[str, Any]) -> T:
    """Options of a job from a preset and values under flat keys, which override it. Raises
    InputError for unknown names and bad values."""
    check_choice("preset", preset, tuple(PRESETS))
    known = entries(kind)
    preset_values = PRESETS[preset] if issubclass(kind, CommonOptions) else {}
    merged = {**{k: v for k, v in preset_values.items() if k in known}, **values}
    # an explicit number of steps replaces the preset's time budget
    if values.get("steps") is not None and "budget" not in values:
        merged["budget"] = None
    given, parts = _by_part(kind, merged)
    for f in fields(kind):
        if f.name in parts:
            held = f.metadata["part"]
            given[f.name] = held.kind(**{**held.defaults, **parts[f.name]})
    return kind(**given)


def resolve_options(kind: type[T], options: T | None, values: Mapping[str, Any]) -> T:
    """What a function was given: ``options``, those of the default preset if none, and what
    overrides them under flat keys (``preset`` is one). Raises InputError."""
    if options is not None:
        return with_values(options, **values)
    rest = dict(values)
    return make_options(kind, rest.pop("preset", "default"), rest)


def read_toml(path: Path, kind: type[Record] = SimplifyOptions) -> dict[str, Any]:
    """Flat keys of a file of options. Raises InputError for unknown keys, suggesting the
    nearest."""
    return flat_keys(path, read_table(path), kind)


def flat_keys(
    path: Path, values: Mapping[str, Any], kind: type[Record], others: tuple[str, ...] = ()
) -> dict[str, Any]:
    """What a file holds under the keys of ``kind``, where it has the command line's spelling, too.
    Raises InputError for keys that are no options of ``kind``, nor ``others``."""
    options = entries(kind)
    known = {*options, "preset", *others}
    spelt = {spelling(e.spec, key): key for key, e in options.items()}
    out = {}
    for key, value in values.items():
        key = key if key in known else spelt.get(key, key)
        if key not in known:
            raise InputError(f"{path}: {_unknown(key, kind, known)}")
        if key in out:
            raise InputError(f"{path}: '{key}' is given twice")
        out[key] = value
    return out


def read_table(path: Path) -> dict[str, Any]:
    """What a TOML file holds (JSON by its suffix), dashes in keys as underscores. Raises
    InputError."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    suffix = Path(path).suffix.lower()
    name, parse = ("JSON", json.loads) if suffix == ".json" else ("TOML", tomllib.loads)
    try:
        data = parse(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:  # arrays may be nested deeper than Python's stack
        raise InputError(f"{path}: not a valid {name} file ({error})") from error
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds no keys with values")
    return {key.replace("-", "_"): value for key, value in data.items()}


def as_dict(options: Record) -> dict[str, Any]:
    """Plain values by flat key, for reports and files."""
    return {
        key: getattr(getattr(options, e.part) if e.part else options, e.name)
        for key, e in entries(type(options)).items()
    }


def with_values(options: T, **values: Any) -> T:
    """The same options, but for ``values``, by flat key. Raises InputError as they do."""
    given, parts = _by_part(type(options), values)
    changed = {name: replace(getattr(options, name), **new) for name, new in parts.items()}
    return replace(options, **given, **changed)


def _by_part(
    kind: type[Record], values: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """(converted values of a job's own fields, those of its records) by field."""
    known = entries(kind)
    own: dict[str, Any] = {}
    parts: dict[str, dict[str, Any]] = {}
    for key, value in values.items():
        if key not in known:
            raise InputError(_unknown(key, kind))
        entry = known[key]
        place = parts.setdefault(entry.part, {}) if entry.part else own
        place[entry.name] = entry.convert(value)
    return own, parts


def _unknown(key: str, kind: type[Record], known: Iterable[str] = ()) -> str:
    """What to say of a key that the job of these options does not know."""
    for job in JOBS.values():
        if job.options is kind and key in job.hints:
            return f"--{key}: {job.hints[key]}"
    others = [name for name, job in JOBS.items() if key in entries(job.options)]
    if others:
        return f"unknown key '{key}': it is an option of {', '.join(others)}"
    close = difflib.get_close_matches(key, sorted(known or entries(kind)), 1, 0.4)
    hint = f"; did you mean '{flag_name(close[0])}'?" if close else ""
    return f"unknown key '{key[:60]}'{hint}"
