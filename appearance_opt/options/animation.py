"""Which frames of an animation a fit sees, and what of the skin is written."""

from __future__ import annotations

from dataclasses import dataclass

from appearance_opt.errors import InputError
from appearance_opt.options.option import Record, names_for, option


@dataclass(frozen=True)
class AnimationOptions(Record):
    """``clips``: those that are fitted (none named: all); ``frames``: START:STOP:STEP in each of
    them, at the rate of the file; ``influences``: bones per vertex of the result at the most, and
    ``support``: of those among which the fit chooses."""

    clips: tuple[str, ...] = option(
        (),
        "Clips whose frames are fitted; all are written.",
        panel="Animation",
        key="clip",
        metavar="NAME,...",
        automatic="all",
        parse=names_for("clip"),
    )
    frames: str | None = option(
        None,
        "START:STOP:STEP, frames of each clip that are fitted.",
        panel="Animation",
        metavar="RANGE",
        automatic="all, at most 48",
    )
    influences: int = option(
        4, "Bones per vertex of the result, at most.", panel="Animation", low=1, high=16
    )
    support: int = option(
        8, "Bones per vertex that the fit chooses from.", panel="Animation", low=1, high=32
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.range()

    def range(self) -> tuple[int | None, int | None, int]:
        """(first frame, first frame after the last, step)."""
        if self.frames is None:
            return None, None, 1
        try:
            words = self.frames.split(":")
            start, stop, step = (int(w) if w else None for w in (*words, "", "")[:3])
            if len(words) == 1 and start is not None:
                stop = start + 1
            if len(words) > 3 or (step is not None and step < 1):
                raise ValueError
        except ValueError:
            raise InputError(
                f"--frames {self.frames}: give START:STOP:STEP, such as 0:48:2, STEP at least 1"
            ) from None
        return start, stop, step or 1
