"""Options of the jobs: checked when made, from presets, a TOML file or the command line."""

from __future__ import annotations

import difflib
import math
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from appearance_opt.asset.companions import CHOICES as MISSING_TEXTURES
from appearance_opt.asset.companions import MissingTextures
from appearance_opt.errors import InputError

FIT_PARTS = ("shape", "normal", "material")
INITS = ("decimate", "sphere")
LOSS_NAMES = ("log-srgb-l1", "log-srgb-l2", "l1", "l2", "smape", "relative-l2")
BACKGROUNDS = ("random", "black", "white", "grey")
LIGHTS = ("point", "headlight")
DEVICES = ("auto", "cpu", "cuda")
MAX_SUBDIVISION, DEFAULT_SUBDIVISION = 4, 3
MAPS = (
    "normal",
    "material",
    "base-color",
    "orm",
    "displacement",
    "object-normal",
    "ao",
    "curvature",
    "emission",
)
HITS = ("nearest", "outermost")
GREENS = ("opengl", "directx")
TEXTURE_FORMATS = ("png", "exr")

PRESETS: dict[str, dict[str, Any]] = {
    "draft": {"budget": 19.0, "resolution": 192, "pool": 64, "reallocate": 0},
    "default": {"budget": 65.0, "resolution": 256, "reallocate": 1},
    "final": {"budget": 280.0, "resolution": 320, "reallocate": 2},
}
"""What each preset sets; everything else keeps its default. See docs/performance.md for how they
were chosen."""


@dataclass(frozen=True)
class CommonOptions:
    """What all jobs that fit share.

    ``texture_size``: texels per side of the new maps, a power of two. ``resolution``, ``views``:
    pixels per side and views of a step. ``steps``, ``budget`` (seconds for the whole job, set-up
    and report included): when to stop; whichever comes first. ``pool``: reference views that are
    kept at a time; ``reuse``: how often each is seen before a new one takes its place (0: they
    stay). ``fit``: what moves. ``*_rate``: learning rates, positions in units of the local edge
    length; by default they follow from how good the start is. ``refine``: level for USD subdivision
    surfaces. ``missing_textures``: "error" or "ignore", when an input names a texture that is not
    there. ``root``: folder in which files that inputs refer to may lie, beside their own.
    ``crease_angle``: see ``asset.load``, in degrees. ``seed``: of everything random.
    ``subdivision``: tessellation levels of a displaced result (none given: 3);
    ``write_tessellated``: write those meshes, too. Raises InputError for values that make no sense.
    """

    texture_size: int = 1024
    resolution: int = 256
    views: int = 4
    steps: int | None = None
    budget: float | None = None
    pool: int = 160
    reuse: int = 4
    fit: tuple[str, ...] = ("shape", "normal", "material")
    loss: str = "log-srgb-l1"
    position_rate: float | None = None
    normal_rate: float | None = None
    color_rate: float | None = None
    material_rate: float | None = None
    displacement_rate: float | None = None
    background: str = "random"
    light: str = "point"
    seed: int = 0
    refine: int = 1
    missing_textures: MissingTextures = "error"
    root: str | None = None
    crease_angle: float | None = None
    subdivision: tuple[int, ...] = ()
    write_tessellated: bool = False
    device: str = "auto"

    def __post_init__(self) -> None:
        size = self.texture_size
        _require(
            16 <= size <= 8192 and size & (size - 1) == 0,
            "texture-size",
            size,
            "a power of two from 16 to 8192",
        )
        _require(16 <= self.resolution <= 4096, "resolution", self.resolution, "from 16 to 4096")
        _require(1 <= self.views <= 64, "views", self.views, "from 1 to 64")
        _require(self.pool >= self.views, "pool", self.pool, "at least as many as --views")
        _require(self.reuse >= 0, "reuse", self.reuse, "0 or more")
        _require(self.steps is None or self.steps >= 0, "steps", self.steps, "0 or more")
        _require(
            self.budget is None or self.budget > 0,
            "budget",
            self.budget,
            "a positive time such as 60s",
        )
        _require(self.seed >= 0, "seed", self.seed, "0 or more")
        _require(0 <= self.refine <= 5, "refine", self.refine, "from 0 to 5")
        angle = self.crease_angle
        _require(angle is None or 0 <= angle <= 180, "crease-angle", angle, "from 0 to 180 degrees")
        for level in self.subdivision:
            _require(
                0 <= level <= MAX_SUBDIVISION, "subdivision", level, f"from 0 to {MAX_SUBDIVISION}"
            )
        _require(
            self.displaced or not self.subdivision, "subdivision", self.subdivision, self._needs
        )
        _require(self.displaced or not self.write_tessellated, "write-tessellated", "", self._needs)
        for name in (
            "position_rate",
            "normal_rate",
            "color_rate",
            "material_rate",
            "displacement_rate",
        ):
            rate = getattr(self, name)
            _require(rate is None or 0 <= rate <= 1, name.replace("_", "-"), rate, "from 0 to 1")
        _require(bool(self.fit), "fit", "", f"some of {', '.join(FIT_PARTS)}")
        for part in self.fit:
            _choice("fit", part, FIT_PARTS)
        given = self.displaced or self.displacement_rate is None
        _require(given, "displacement-rate", self.displacement_rate, self._needs)
        _choice("loss", self.loss, LOSS_NAMES)
        _choice("light", self.light, LIGHTS)
        _choice("device", self.device, DEVICES)
        _choice("missing-textures", self.missing_textures, MISSING_TEXTURES)
        self.background_color()

    _needs = "given with a displacement"

    @property
    def displaced(self) -> bool:
        """Is a displacement map fitted, and the mesh tessellated?"""
        return False

    def levels(self) -> tuple[int, ...]:
        """Tessellation levels at which the latent is drawn, in ascending order."""
        if not self.displaced:
            return (0,)
        return tuple(sorted(set(self.subdivision))) or (DEFAULT_SUBDIVISION,)

    def background_color(self) -> str | tuple[float, float, float]:
        """A name, or linear RGB."""
        if self.background in BACKGROUNDS:
            return self.background
        try:
            r, g, b = (float(x) for x in self.background.split(","))
            if not all(0 <= x < math.inf for x in (r, g, b)):
                raise ValueError
        except ValueError:
            raise InputError(
                f"--background {self.background}: give one of {', '.join(BACKGROUNDS)} or three numbers r,g,b from 0"
            ) from None
        return (r, g, b)


@dataclass(frozen=True)
class SimplifyOptions(CommonOptions):
    """How to simplify.

    ``triangles`` or ``ratio``: the budget (exactly one; neither is needed where ``init`` is a
    file). ``init``: "decimate", "sphere", or a file with a start. ``reallocate``: rounds in which
    triangles are moved to where the image error of the decimated mesh is. ``relative``: the
    Laplacian keeps the start's shape; None: where the start is a likeness of the input.
    ``keep_hidden``: keep geometry that no outside view sees. ``displacement``: fit a displacement
    map on the tessellated mesh; ``normal_map``: make one at all. The others: ``CommonOptions``.
    """

    triangles: int | None = None
    ratio: float | None = None
    init: str = "decimate"
    reallocate: int = 1
    laplacian: float = 0.25
    relative: bool | None = None
    keep_hidden: bool = False
    displacement: bool = False
    normal_map: bool = True

    _needs = "given together with --displacement"

    @property
    def displaced(self) -> bool:
        return self.displacement

    def __post_init__(self) -> None:
        given = (self.triangles is not None) + (self.ratio is not None)
        if given != 1 and (
            self.init in INITS or given
        ):  # a file to start from brings its own triangles
            raise InputError("give either --triangles N or --ratio R")
        if self.triangles is not None:
            _require(self.triangles >= 1, "triangles", self.triangles, "at least 1")
        if self.ratio is not None:
            _require(0 < self.ratio <= 1, "ratio", self.ratio, "above 0 and at most 1")
        super().__post_init__()
        _require(0 <= self.reallocate <= 10, "reallocate", self.reallocate, "from 0 to 10")
        _require(self.laplacian >= 0, "laplacian", self.laplacian, "0 or more")
        if self.init not in INITS and not Path(self.init).suffix:
            _choice("init", self.init, INITS)


@dataclass(frozen=True)
class BakeOptions(CommonOptions):
    """How to bake.

    ``maps``: any of ``MAPS``; "material" is base-color, orm and, if HIGH emits any, emission.
    ``closed_form``: no fit. ``samples``: rays per texel. ``cage``: how far rays go outward and
    inward (metres), by default from the two meshes. ``hit``: "nearest" or "outermost" surface that
    faces the texel's way. ``green``: green channel of loose normal maps, "opengl" or "directx".
    ``bits``: 8 or 16, of normal maps and of loose maps. ``texture_format``: png or exr, of loose
    maps. ``ao_rays``, ``ao_distance`` (metres; by default any): ambient occlusion. ``unwrap``: make
    LOW a new atlas. ``align``: fit HIGH to LOW by translation and scale. ``joint``: fit LOW's shape
    and a displacement map as well. The others: ``CommonOptions``; ``fit``: of normal,material.
    """

    maps: tuple[str, ...] = ("normal", "material")
    fit: tuple[str, ...] = ("normal", "material")
    closed_form: bool = False
    samples: int = 4
    cage: float | None = None
    hit: str = "nearest"
    green: str = "opengl"
    bits: int = 8
    texture_format: str = "png"
    ao_rays: int = 64
    ao_distance: float | None = None
    unwrap: bool = False
    align: bool = False
    joint: bool = False

    _needs = "given together with --joint"

    @property
    def displaced(self) -> bool:
        return self.joint

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.joint:
            self._check_joint()
        else:
            _require(self.position_rate is None, "position-rate", self.position_rate, self._needs)
        _require(bool(self.maps), "maps", "", f"some of {', '.join(MAPS)}")
        for name in self.maps:
            _choice("maps", name, MAPS)
        for part in self.fit:
            shape = part == "shape" and self.joint
            _require(
                shape or part in ("normal", "material"),
                "fit",
                part,
                "of normal,material: LOW keeps its shape",
            )
        _require(1 <= self.samples <= 64, "samples", self.samples, "from 1 to 64")
        _require(
            self.cage is None or self.cage > 0, "cage", self.cage, "a positive distance in metres"
        )
        _choice("hit", self.hit, HITS)
        _choice("green", self.green, GREENS)
        _choice("texture-format", self.texture_format, TEXTURE_FORMATS)
        _require(self.bits in (8, 16), "bits", self.bits, "8 or 16")
        _require(1 <= self.ao_rays <= 4096, "ao-rays", self.ao_rays, "from 1 to 4096")
        _require(
            self.ao_distance is None or self.ao_distance > 0,
            "ao-distance",
            self.ao_distance,
            "above 0",
        )

    def _check_joint(self) -> None:
        """A joint bake makes a base mesh with normal map, material and displacement, nothing
        loose."""
        _require(not self.closed_form, "joint", "", "given without --closed-form")
        made = {"normal", "material", "displacement"}
        asked = set(self.maps)
        _require(
            {"normal", "material"} <= asked <= made,
            "maps",
            ",".join(self.maps),
            "normal,material with --joint",
        )
        for name in ("hit", "green", "bits", "texture_format", "ao_rays", "ao_distance"):
            plain = getattr(self, name) == getattr(BakeOptions, name)
            _require(plain, name.replace("_", "-"), getattr(self, name), "given without --joint")

    def wants(self, name: str) -> bool:
        """Is a map asked for? "material" is base-color, orm and emission."""
        return name in self.maps or (
            "material" in self.maps and name in ("base-color", "orm", "emission")
        )


OPTION_NAMES = frozenset(f.name for f in fields(SimplifyOptions))
BAKE_OPTION_NAMES = frozenset(f.name for f in fields(BakeOptions))


def simplify_options(preset: str = "default", **values: Any) -> SimplifyOptions:
    """Options from a preset and what overrides it. Raises InputError for unknown names and bad
    values."""
    return SimplifyOptions(**_merge(SimplifyOptions, OPTION_NAMES, preset, values))


def bake_options(preset: str = "default", **values: Any) -> BakeOptions:
    """The same for a bake."""
    return BakeOptions(**_merge(BakeOptions, BAKE_OPTION_NAMES, preset, values))


def _merge(
    kind: type, known: frozenset[str], preset: str, values: Mapping[str, Any]
) -> dict[str, Any]:
    _choice("preset", preset, tuple(PRESETS))
    for name in values:
        if name not in known:
            raise InputError(_unknown(name, known))
    merged = {**{k: v for k, v in PRESETS[preset].items() if k in known}, **values}
    # an explicit number of steps replaces the preset's time budget
    if values.get("steps") is not None and "budget" not in values:
        merged["budget"] = None
    return {k: _convert(kind, k, v) for k, v in merged.items()}


def read_toml(path: Path, names: frozenset[str] = OPTION_NAMES) -> dict[str, Any]:
    """Keys of a job file, dashes or underscores. Raises InputError for unknown keys, suggesting the
    nearest."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    try:
        data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:  # arrays may be nested deeper than Python's stack
        raise InputError(f"{path}: not a valid TOML file ({error})") from error
    known = names | {"preset"}
    out: dict[str, Any] = {}
    for key, value in data.items():
        name = key.replace("-", "_")
        if name not in known:
            raise InputError(f"{path}: {_unknown(key, known)}")
        out[name] = value
    return out


def duration(text: str | float) -> float:
    """Seconds of "90", "60s", "5m", "1.5h". Raises InputError."""
    if isinstance(text, (int, float)) and not isinstance(text, bool):
        return float(text)
    pattern = r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(s|sec|m|min|h)?\s*"
    match = re.fullmatch(pattern, text) if isinstance(text, str) else None
    if match is None:
        raise InputError(f"'{text}' is not a time: write 90, 60s, 5m or 1.5h")
    return float(match[1]) * {"m": 60.0, "min": 60.0, "h": 3600.0}.get(match[2] or "s", 1.0)


def as_dict(options: CommonOptions) -> dict[str, Any]:
    """Plain values, for reports and fingerprints."""
    return {f.name: getattr(options, f.name) for f in fields(options)}


def with_values(options: SimplifyOptions, **values: Any) -> SimplifyOptions:
    """The same options, but for ``values``."""
    return replace(options, **values)


def _convert(kind: type, name: str, value: Any) -> Any:
    if name == "budget" and value is not None:
        return duration(value)
    if name in ("fit", "maps"):
        parts = value.split(",") if isinstance(value, str) else value
        if not isinstance(parts, (list, tuple)) or not all(isinstance(p, str) for p in parts):
            raise InputError(f"--{name} {value!r}: write names such as normal,material")
        return tuple(dict.fromkeys(p.strip() for p in parts if p.strip()))
    if name == "subdivision":
        return _levels(value)
    kinds: Mapping[str, tuple[type, ...]] = {
        "int": (int,),
        "float": (int, float),
        "str": (str,),
        "bool": (bool,),
    }
    declared = str(next(f.type for f in fields(kind) if f.name == name))
    allowed = tuple(k for word, types in kinds.items() if word in declared for k in types)
    if value is None and "None" in declared:
        return None
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"--{name.replace('_', '-')} {value}: is not a number")
    if allowed and (
        not isinstance(value, allowed) or (isinstance(value, bool) and bool not in allowed)
    ):
        raise InputError(f"--{name.replace('_', '-')} {value!r}: expected {declared}")
    return value


def _levels(value: Any) -> tuple[int, ...]:
    """Tessellation levels of 3, "1,2,3" or a list."""
    parts = (
        value.split(",")
        if isinstance(value, str)
        else value
        if isinstance(value, (list, tuple))
        else [value]
    )
    try:
        return tuple(dict.fromkeys(_whole(p) for p in parts))
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"--subdivision {value}: write one level or several, such as 3 or 1,2,3"
        ) from None


def _whole(value: Any) -> int:
    number = int(value)
    if isinstance(value, bool) or (isinstance(value, float) and number != value):
        raise ValueError
    return number


def _require(ok: bool, name: str, value: Any, expected: str) -> None:
    if not ok:
        raise InputError(f"--{name} {value}: must be {expected}")


def _choice(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        close = difflib.get_close_matches(str(value), allowed, 1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        raise InputError(f"--{name} {value}: choose from {', '.join(allowed)}{hint}")


def _unknown(name: str, known: frozenset[str]) -> str:
    close = difflib.get_close_matches(name.replace("-", "_"), sorted(known), 1, 0.4)
    hint = f"; did you mean '{close[0].replace('_', '-')}'?" if close else ""
    return f"unknown key '{name[:60]}'{hint}"
