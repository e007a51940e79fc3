"""The options of each job, composed of records: made from presets, a TOML file, the command line or
Python, under flat keys."""

from __future__ import annotations

import difflib
import json
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from appearance_opt.errors import InputError
from appearance_opt.options.baking import BakingOptions
from appearance_opt.options.files import OutputOptions
from appearance_opt.options.fitting import FittingOptions
from appearance_opt.options.maps import DisplacementOptions, TextureOptions
from appearance_opt.options.option import Record as Options
from appearance_opt.options.option import (
    check_choice,
    entries,
    flag_name,
    option,
    part,
    require,
    spelling,
)
from appearance_opt.options.reading import AssetOptions
from appearance_opt.options.start import StartOptions
from appearance_opt.options.views import ViewOptions

DEVICES = ("auto", "cpu", "cuda")
COMPARED_LIGHTS = ("point", "environment")
RENDERERS = ("own", "path")

PRESETS: dict[str, dict[str, Any]] = {
    "draft": {"budget": 19.0, "resolution": 192, "pool": 64, "reallocate": 0},
    "default": {"budget": 65.0, "resolution": 256, "reallocate": 1},
    "final": {"budget": 280.0, "resolution": 320, "reallocate": 2},
}
"""What each preset sets; everything else keeps its default. See docs/performance.md for how they
were chosen."""

T = TypeVar("T", bound=Options)


def _device() -> Any:
    return option("auto", "Where to compute.", panel="Run", choices=DEVICES)


@dataclass(frozen=True)
class CommonOptions(Options):
    """What all jobs that fit are told; each offers a part of it, and has its own beside. Raises
    InputError for values that make no sense."""

    asset: AssetOptions = part(AssetOptions)
    views: ViewOptions = part(ViewOptions)
    fit: FittingOptions = part(FittingOptions)
    texture: TextureOptions = part(TextureOptions)
    displacement: DisplacementOptions = part(DisplacementOptions)
    output: OutputOptions = part(OutputOptions)
    device: str = _device()

    def levels(self) -> tuple[int, ...]:
        """Tessellation levels at which the latent is drawn, in ascending order."""
        return self.displacement.levels()


@dataclass(frozen=True)
class SimplifyOptions(CommonOptions):
    """How to simplify."""

    start: StartOptions = part(StartOptions)


@dataclass(frozen=True)
class BakeOptions(CommonOptions):
    """How to bake: LOW keeps its shape, so that a fit moves normals and material alone."""

    fit: FittingOptions = part(
        FittingOptions,
        without=("laplacian", "relative", "position_rate"),
        parts=("normal", "material"),
        laplacian=0.0,
    )
    texture: TextureOptions = part(TextureOptions, only=("texture_size",))
    displacement: DisplacementOptions = part(DisplacementOptions, only=())
    baking: BakingOptions = part(BakingOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.fit.parts:
            held = name in ("normal", "material")
            require(held, "fit", name, "of normal,material: LOW keeps its shape")


@dataclass(frozen=True)
class JointOptions(CommonOptions):
    """How to fit LOW's shape, its displacement, normals and material together."""

    fit: FittingOptions = part(FittingOptions, without=("relative",), relative=True)
    texture: TextureOptions = part(TextureOptions, only=("texture_size",))
    displacement: DisplacementOptions = part(
        DisplacementOptions, without=("displacement",), fitted=True
    )
    baking: BakingOptions = part(BakingOptions, only=("samples", "cage", "unwrap", "align"))


@dataclass(frozen=True)
class CompareOptions(Options):
    """How to compare two assets."""

    asset: AssetOptions = part(AssetOptions)
    views: int = option(12, "Number of views.", panel="Views", low=1)
    resolution: int = option(384, "Pixels per side.", panel="Views", low=16, high=8192)
    samples: int | None = option(
        None,
        "Rays per pixel; under an environment, lights, one ray for each.",
        panel="Views",
        low=1,
        high=4096,
        automatic="16; 64 under an environment or by paths",
    )
    light: str = option(
        "point",
        "point (a lamp of its own in each view) or environment (a sky and three lamps).",
        panel="Views",
        choices=COMPARED_LIGHTS,
    )
    renderer: str = option(
        "own",
        "own (fast, no shadows) or path (Mitsuba's path tracer, its own materials, shadows).",
        panel="Views",
        choices=RENDERERS,
    )
    seed: int = option(0, "Seed of views and lights.", panel="Views", low=0)
    device: str = _device()


@dataclass(frozen=True)
class InspectOptions(Options):
    """How to inspect an asset."""

    asset: AssetOptions = part(AssetOptions)


@dataclass(frozen=True)
class Job:
    """A kind of job: ``help`` in a sentence, its options, what it calls its inputs, whether it
    writes anything, and ``hints``: what to write instead of keys that are no longer there. The
    recipe is the function of the kind's name in the module of ``jobs`` of that name."""

    help: str
    options: type[Options]
    inputs: tuple[str, ...]
    writes: bool = True
    hints: Mapping[str, str] = field(default_factory=dict)

    @property
    def fits(self) -> bool:
        """Does it make an asset, with progress, a report and a time budget?"""
        return issubclass(self.options, CommonOptions)


JOINT = (
    "baking with LOW's shape free is a job of its own: write appearance-opt joint HIGH LOW --out "
    "OUT, in Python appearance_opt.joint with joint_options"
)

JOBS: dict[str, Job] = {
    "simplify": Job(
        "Write an asset with fewer triangles that looks like INPUT.", SimplifyOptions, ("INPUT",)
    ),
    "bake": Job(
        "Bake what HIGH looks like into the maps of LOW, which keeps its shape.",
        BakeOptions,
        ("HIGH", "LOW"),
        hints={"joint": JOINT},
    ),
    "joint": Job(
        "Bake with LOW's shape free: fit it, a displacement, normals and material together.",
        JointOptions,
        ("HIGH", "LOW"),
    ),
    "compare": Job(
        "Measure how different two assets look: PSNR, FLIP, silhouettes.",
        CompareOptions,
        ("REFERENCE", "CANDIDATE"),
    ),
    "inspect": Job(
        "Say what is in an asset, what is wrong with it, and what simplify will do with each "
        "material.",
        InspectOptions,
        ("INPUT",),
        writes=False,
    ),
}
"""All jobs by name: a job is its record above, an entry here, and a recipe."""


def simplify_options(preset: str = "default", **values: Any) -> SimplifyOptions:
    """Options from a preset and what overrides it. Raises InputError for unknown names and bad
    values."""
    return make_options(SimplifyOptions, preset, values)


def bake_options(preset: str = "default", **values: Any) -> BakeOptions:
    """The same for a bake."""
    return make_options(BakeOptions, preset, values)


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


def read_toml(path: Path, kind: type[Options] = SimplifyOptions) -> dict[str, Any]:
    """Flat keys of a file of options. Raises InputError for unknown keys, suggesting the
    nearest."""
    return flat_keys(path, read_table(path), kind)


def flat_keys(
    path: Path, values: Mapping[str, Any], kind: type[Options], others: tuple[str, ...] = ()
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


def as_dict(options: Options) -> dict[str, Any]:
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
    kind: type[Options], values: Mapping[str, Any]
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


def _unknown(key: str, kind: type[Options], known: Iterable[str] = ()) -> str:
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
