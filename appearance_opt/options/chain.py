"""Levels of detail: how many, at which size each is shown, of how many triangles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from appearance_opt.errors import InputError
from appearance_opt.options.bound import LARGEST, SMALLEST, bound_text
from appearance_opt.options.option import Record, option, require

LEVELS, FINEST = 4, 512
"""Levels, and pixels of the finest one, where nothing is asked for."""

PER_PIXEL = 16
"""Triangles of a level per pixel of its size, where nothing is asked for: an outline of n straight
pieces keeps within 1 / n^2 of the size, so that triangles grow as the size does at the same error
in pixels."""

MOST = 8
"""Levels of a chain."""


def numbers(key: str, kind: type[int] | type[float]) -> Callable[[Any], tuple[Any, ...]]:
    """A parser of one number, "512,128,32" or a list of them; none stand for what is automatic."""

    def parse(value: Any) -> tuple[Any, ...]:
        listed = value.split(",") if isinstance(value, str) else value
        listed = listed if isinstance(listed, (list, tuple)) else [listed]
        try:
            if any(isinstance(v, bool) for v in listed):
                raise ValueError
            out = tuple(kind(v) for v in listed)
            if any(float(v) != w for v, w in zip(listed, out, strict=True)):
                raise ValueError
        except (TypeError, ValueError, OverflowError):
            raise InputError(
                f"--{key} {value}: write one number or several, such as "
                f"{'8000,2000,500' if kind is int else '0.1,0.02'}"
            ) from None
        return out

    return parse


@dataclass(frozen=True)
class ChainOptions(Record):
    """``levels``: how many; ``pixels``: the size on screen at which each is shown, the finest
    first, or of the finest alone: the others are half as large as the one before. ``triangles`` or
    ``ratio``: of each level, or of the finest alone: those of the others are in proportion to their
    pixels. ``max_error``: bound under which a level takes the place of the one before it."""

    levels: int | None = option(
        None,
        "Levels of detail.",
        panel="Levels",
        low=2,
        high=MOST,
        automatic=f"{LEVELS}, or as many as --pixels or --triangles has",
    )
    pixels: tuple[int, ...] = option(
        (),
        "Size on screen for which each level is fitted, or of the finest: each next is half of it.",
        panel="Levels",
        low=SMALLEST,
        high=LARGEST,
        automatic=str(FINEST),
        metavar="N,N,...",
        parse=numbers("pixels", int),
    )
    triangles: tuple[int, ...] = option(
        (),
        "Triangles of each level, or of the finest: others in proportion to their pixels.",
        panel="Levels",
        low=1,
        automatic=f"{PER_PIXEL} per pixel, at most half of the input",
        metavar="N,N,...",
        parse=numbers("triangles", int),
    )
    ratio: tuple[float, ...] = option(
        (),
        "Fractions of the input's triangles instead.",
        panel="Levels",
        above=0,
        high=1,
        metavar="R,R,...",
        parse=numbers("ratio", float),
    )
    max_error: str = option(
        "0.5px",
        "Error at which a coarser level takes over: 0.5px (of silhouettes), flip=0.02 or psnr=35.",
        panel="Levels",
        metavar="BOUND",
        parse=bound_text,
    )
    separate_files: bool = option(
        False,
        "Write each level as a file of its own, too: <OUT>_lod0, _lod1, ...",
        panel="Levels",
        flag="--files",
    )
    screen: int = option(
        1080,
        "Height in pixels of the screen that switching sizes are told for (16:9).",
        panel="Levels",
        low=16,
        high=16384,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.triangles and self.ratio:
            raise InputError("give either --triangles or --ratio, not both")
        counts = {
            name: len(values)
            for name, values in (
                ("pixels", self.pixels),
                ("triangles", self.triangles),
                ("ratio", self.ratio),
            )
            if len(values) > 1
        }
        for name, count in counts.items():
            require(count <= MOST, name, f"of {count} levels", f"{MOST} levels at most")
            if self.levels not in (None, count):
                raise InputError(
                    f"--levels {self.levels}: --{name} is given for {count} levels; leave one out"
                )
        if len(set(counts.values())) > 1:
            told = " and ".join(f"--{n} has {c}" for n, c in counts.items())
            raise InputError(f"levels contradict each other: {told}")
        for name in ("pixels", "triangles", "ratio"):
            values = getattr(self, name)
            for before, after in zip(values, values[1:], strict=False):
                if after >= before:
                    raise InputError(
                        f"--{name} {','.join(map(str, values))}: levels must shrink, the finest "
                        "first"
                    )
        if self.sizes()[-1] < SMALLEST:
            raise InputError(
                f"--levels {len(self.sizes())}: the last would be shown below {SMALLEST} pixels; "
                "ask for fewer, or for larger --pixels"
            )

    def count(self) -> int:
        """Levels."""
        lists = (self.pixels, self.triangles, self.ratio)
        return self.levels or max((len(v) for v in lists if len(v) > 1), default=LEVELS)

    def sizes(self) -> tuple[int, ...]:
        """Pixels of each level, the finest first."""
        if len(self.pixels) > 1:
            return self.pixels
        first = self.pixels[0] if self.pixels else FINEST
        return tuple(first >> k for k in range(self.count()))

    def budgets(self, available: int) -> tuple[int, ...]:
        """Triangles of each level for an input that has ``available``. Raises InputError for levels
        that do not shrink, and if the finest one would be no smaller than the input."""
        sizes = self.sizes()
        if self.ratio:
            given = tuple(max(4, round(r * available)) for r in self.ratio)
        else:
            given = self.triangles or (min(PER_PIXEL * sizes[0], available // 2),)
        if len(given) == 1:
            given = tuple(max(4, round(given[0] * s / sizes[0])) for s in sizes)
        name = "ratio" if self.ratio else "triangles"
        if given[0] > available:
            raise InputError(
                f"--{name}: the finest level would have {given[0]} triangles, and the input has "
                f"only {available}; ask for fewer"
            )
        if any(b >= a for a, b in zip(given, given[1:], strict=False)):
            raise InputError(
                f"the input has {available} triangles, so that levels would have "
                f"{', '.join(map(str, given))}, which do not shrink: ask for fewer --levels, or "
                "give --triangles of each"
            )
        return given
