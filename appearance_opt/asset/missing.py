"""What becomes of textures and material files that an asset names and that are not there."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, TypeVar, get_args

from appearance_opt.errors import InputError, MissingFileError

if TYPE_CHECKING:
    from collections.abc import Callable

MissingTextures = Literal["error", "ignore"]

CHOICES: tuple[str, ...] = get_args(MissingTextures)

T = TypeVar("T")


@dataclass
class Missing:
    """``policy``: refuse an asset that lacks a file, or go on without it. ``notes``: the reader's notes; each
    file that was ignored is named there once."""

    policy: MissingTextures = "error"
    notes: list[str] = field(default_factory=list)

    def read(self, file: Callable[[], T], instead: str = "the material's constants stand alone") -> T | None:
        """What ``file`` reads; None if it is missing and that is to be ignored. ``instead``: what the note says
        becomes of it. Raises InputError."""
        try:
            return file()
        except MissingFileError as error:
            if self.policy == "error":
                raise InputError(f"{error}; add the file, or go on without it: --missing-textures ignore") from None
            note = f"{error}: ignored, {instead}"
            if note not in self.notes:
                self.notes.append(note)
            return None
