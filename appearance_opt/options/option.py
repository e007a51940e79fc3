"""One option: a field of a frozen dataclass that carries default, range and help."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable
from dataclasses import MISSING, Field, dataclass, field, fields
from typing import Any

from appearance_opt.errors import InputError

_TYPES: dict[str, tuple[type, ...]] = {
    "int": (int,),
    "float": (int, float),
    "str": (str,),
    "bool": (bool,),
}


@dataclass(frozen=True)
class Spec:
    """What a field is as an option. ``help``: a sentence. ``panel``: heading in the help. ``key``:
    its flat name (by default the field's). ``low``, ``high``: range, both included; ``above``: a
    lower end that is not. ``choices``: all that it may be (each element, for several). ``expected``:
    what an error says it must be (by default from the range). ``automatic``: what None stands for.
    ``metavar``: what help calls a value. ``flag``: spelling of a switch, if another than
    --key/--no-key. ``repeated``: the command line may give it several times. ``parse``: makes a value
    of what was given, text included."""

    help: str
    panel: str = ""
    key: str = ""
    low: float | None = None
    high: float | None = None
    above: float | None = None
    choices: tuple[Any, ...] = ()
    expected: str = ""
    automatic: str = ""
    metavar: str = ""
    flag: str = ""
    repeated: bool = False
    parse: Callable[[Any], Any] | None = None

    def check(self, name: str, value: Any) -> None:
        """Raise InputError if ``value`` is none that the option ``name`` may have."""
        if value is None:
            return
        if isinstance(value, tuple) and not value and self.choices:
            require(False, name, "", f"some of {', '.join(self.choices)}")
        for one in value if isinstance(value, tuple) else (value,):
            if self.choices and self.expected:
                require(one in self.choices, name, one, self.expected)
            elif self.choices:
                check_choice(name, one, self.choices)
            elif self.low is not None or self.high is not None or self.above is not None:
                require(self._holds(one), name, one, self.expected or self.range())

    def _holds(self, value: float) -> bool:
        return (
            (self.low is None or value >= self.low)
            and (self.high is None or value <= self.high)
            and (self.above is None or value > self.above)
            and value < math.inf
        )

    def range(self) -> str:
        """The range in words; "" if there is none."""
        if self.low is not None and self.high is not None:
            return f"from {self.low:g} to {self.high:g}"
        if self.low is not None:
            return f"{self.low:g} or more"
        if self.above is None:
            return ""
        return f"above {self.above:g}" + (
            "" if self.high is None else f" and at most {self.high:g}"
        )


def option(default: Any, help: str, **spec: Any) -> Any:
    """A field of a record of options; ``spec``: see ``Spec``."""
    return field(default=default, metadata={"option": Spec(help, **spec)})


@dataclass(frozen=True)
class Record:
    """Base of records whose fields are options: checked when made, or InputError."""

    def __post_init__(self) -> None:
        for f in fields(self):
            if "option" in f.metadata:
                f.metadata["option"].check(
                    spelling(f.metadata["option"], key_of(f)), getattr(self, f.name)
                )


@dataclass(frozen=True)
class Part:
    """A record within the options of a job: which of its ``keys`` the job offers, with which
    ``defaults`` by field instead of the record's own."""

    kind: type[Record]
    keys: tuple[str, ...]
    defaults: dict[str, Any]


def part(
    kind: type[Record],
    *,
    only: tuple[str, ...] | None = None,
    without: tuple[str, ...] = (),
    **defaults: Any,
) -> Any:
    """A field that holds a record: all of its keys are offered, ``only`` some or all ``without``
    some; those that are not keep their default. ``defaults``: by field, where they differ."""
    keys = tuple(key_of(f) for f in fields(kind))
    named = {*(only or ()), *without}
    assert named <= set(keys), f"{kind.__name__} lacks some of {named}"
    offered = tuple(k for k in keys if k not in without and (only is None or k in only))
    return field(
        default_factory=lambda: kind(**defaults),
        metadata={"part": Part(kind, offered, defaults)},
    )


@dataclass(frozen=True)
class Entry:
    """An option of a job under its flat key. ``part``: the job's field that holds its record, ""
    for a field of the job itself. ``name``: its own field. ``kind``: its type, in words."""

    key: str
    part: str
    name: str
    kind: str
    default: Any
    spec: Spec

    def convert(self, value: Any) -> Any:
        """A value as given in Python, TOML or on a command line. Raises InputError for other
        types."""
        if value is None and "None" in self.kind:
            return None
        if self.spec.parse is not None:
            return self.spec.parse(value)
        name = spelling(self.spec, self.key)
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"--{name} {value}: is not a number")
        allowed = tuple(t for word, types in _TYPES.items() if word in self.kind for t in types)
        wrong_bool = isinstance(value, bool) and bool not in allowed
        if allowed and (not isinstance(value, allowed) or wrong_bool):
            raise InputError(f"--{name} {value!r}: expected {self.kind}")
        return value


def entries(kind: type) -> dict[str, Entry]:
    """All options of a record or of a job's options by flat key, in the order of their fields."""
    out: dict[str, Entry] = {}
    for f in fields(kind):
        if "option" in f.metadata:
            out[key_of(f)] = _entry(f, "", {})
        elif "part" in f.metadata:
            held: Part = f.metadata["part"]
            for inner in fields(held.kind):
                if key_of(inner) in held.keys:
                    assert key_of(inner) not in out, f"two options are called {key_of(inner)}"
                    out[key_of(inner)] = _entry(inner, f.name, held.defaults)
    return out


def _entry(f: Field, part: str, defaults: dict[str, Any]) -> Entry:
    default = defaults.get(f.name, f.default)
    assert default is not MISSING
    return Entry(key_of(f), part, f.name, str(f.type), default, f.metadata["option"])


def key_of(f: Field) -> str:
    """Flat key of a field."""
    spec: Spec | None = f.metadata.get("option")
    return f.name if spec is None or not spec.key else spec.key


def spelling(spec: Spec, key: str) -> str:
    """What the command line calls an option, without dashes before it."""
    return spec.flag.split("/")[0].lstrip("-") or flag_name(key)


def flag_name(key: str) -> str:
    """A key as the command line spells it."""
    return key.replace("_", "-")


def require(ok: bool, name: str, value: Any, expected: str) -> None:
    """Raise InputError unless ``ok``."""
    if not ok:
        raise InputError(f"--{name} {value}: must be {expected}")


def check_choice(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Raise InputError, with the nearest name, unless ``value`` is one of ``allowed``."""
    if value not in allowed:
        close = difflib.get_close_matches(str(value), [str(a) for a in allowed], 1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        raise InputError(f"--{name} {value}: choose from {', '.join(map(str, allowed))}{hint}")


def duration(text: str | float) -> float | None:
    """Seconds of "90", "60s", "5m", "1.5h"; None of "none". Raises InputError."""
    if text == "none":
        return None
    if isinstance(text, (int, float)) and not isinstance(text, bool):
        return float(text)
    pattern = r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(s|sec|m|min|h)?\s*"
    match = re.fullmatch(pattern, text) if isinstance(text, str) else None
    if match is None:
        raise InputError(f"'{text}' is not a time: write 90, 60s, 5m or 1.5h")
    return float(match[1]) * {"m": 60.0, "min": 60.0, "h": 3600.0}.get(match[2] or "s", 1.0)


def names_for(key: str) -> Callable[[Any], tuple[str, ...]]:
    """A parser of "a,b" or a list of names, each of which counts once."""

    def parse(value: Any) -> tuple[str, ...]:
        parts = value.split(",") if isinstance(value, str) else value
        if not isinstance(parts, (list, tuple)) or not all(isinstance(p, str) for p in parts):
            raise InputError(f"--{key} {value!r}: write names such as normal,material")
        return tuple(dict.fromkeys(p.strip() for p in parts if p.strip()))

    return parse


def levels(value: Any) -> tuple[int, ...]:
    """Tessellation levels of 3, "1,2,3" or a list. Raises InputError."""
    listed = value.split(",") if isinstance(value, str) else value
    try:
        return tuple(
            dict.fromkeys(map(_whole, listed if isinstance(listed, (list, tuple)) else [listed]))
        )
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"--subdivision {value}: write one level or several, such as 3 or 1,2,3"
        ) from None


def _whole(value: Any) -> int:
    number = int(value)
    if isinstance(value, bool) or (isinstance(value, float) and number != value):
        raise ValueError
    return number
