"""Files that an asset names: where they may lie, and what becomes of those that are not there."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar, get_args

from appearance_opt.asset.paths import resolve
from appearance_opt.errors import InputError, MissingFileError

if TYPE_CHECKING:
    from collections.abc import Callable

MissingTextures = Literal["error", "ignore"]

CHOICES: tuple[str, ...] = get_args(MissingTextures)

T = TypeVar("T")


@dataclass
class Companions:
    """``policy``: refuse an asset that lacks a file, or go on without it. ``root``: folder in which files may
    lie beside that of the file that names them. ``notes``: the reader's notes; each file that was ignored is named
    there once."""

    policy: MissingTextures = "error"
    root: Path | None = None
    notes: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        """Say something to the user, once."""
        if text not in self.notes:
            self.notes.append(text)

    def find(self, reference: str, owner: Path, percent_encoded: bool = False) -> Path:
        """Path of a file that ``owner`` refers to. Raises InputError as ``resolve`` does."""
        return resolve(reference, owner, percent_encoded, self.root)

    def read(self, file: Callable[[], T], instead: str = "the material's constants stand alone") -> T | None:
        """What ``file`` reads; None if it is missing and that is to be ignored. ``instead``: what the note says
        becomes of it. Raises InputError."""
        try:
            return file()
        except MissingFileError as error:
            if self.policy == "error":
                raise InputError(f"{error}; add the file, or go on without it: --missing-textures ignore") from None
            self.note(f"{error}: ignored, {instead}")
            return None
