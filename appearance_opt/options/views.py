"""The images that a fit compares: how many, how large, under which light."""

from __future__ import annotations

import math
from dataclasses import dataclass

from appearance_opt.errors import InputError
from appearance_opt.options.option import Record, option, require

BACKGROUNDS = ("random", "black", "white", "grey")
LIGHTS = ("point", "headlight")


@dataclass(frozen=True)
class ViewOptions(Record):
    """``per_step`` views of ``resolution`` pixels per side in a step, out of ``pool`` that are kept
    and replaced when each was seen ``reuse`` times (0: never)."""

    resolution: int = option(
        256, "Pixels per side of a training view.", panel="Fit", low=16, high=4096
    )
    per_step: int = option(4, "Views per step.", panel="Fit", key="views", low=1, high=64)
    pool: int = option(160, "Reference views kept at a time.", panel="Fit")
    reuse: int = option(
        4,
        "How often each view is seen before a new one replaces it; 0: they stay.",
        panel="Fit",
        low=0,
    )
    background: str = option(
        "random", "random, black, white, grey, or linear r,g,b.", panel="Fit", metavar="COLOR"
    )
    light: str = option("point", "point (anywhere) or headlight.", panel="Fit", choices=LIGHTS)
    seed: int = option(0, "Of everything random.", panel="Fit", low=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.pool >= self.per_step, "pool", self.pool, "at least as many as --views")
        self.background_color()

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
                f"--background {self.background}: give one of {', '.join(BACKGROUNDS)} "
                "or three numbers r,g,b from 0"
            ) from None
        return (r, g, b)
