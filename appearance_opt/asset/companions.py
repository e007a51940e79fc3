"""Files that an asset names: where they may lie, and what becomes of those that are not there."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING, Literal, TypeVar, get_args
from urllib.parse import unquote

from appearance_opt.asset import images
from appearance_opt.asset.budget import Budget
from appearance_opt.asset.door import DATA_FAULTS
from appearance_opt.asset.notes import Notes
from appearance_opt.asset.paths import read_bytes, resolve
from appearance_opt.errors import InputError, MissingFileError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

MissingTextures = Literal["error", "ignore"]

CHOICES: tuple[str, ...] = get_args(MissingTextures)

T = TypeVar("T")


@dataclass
class Companions:
    """``policy``: refuse an asset that lacks a file, or go on without it. ``root``: folder in which
    files may lie beside that of the file that names them. ``notes``: the reader's notes; each file
    that was ignored is named there once. ``files``: absolute paths of what the asset consists of,
    read or only mentioned. ``budget``: the memory that all of the asset may take."""

    policy: MissingTextures = "error"
    root: Path | None = None
    notes: Notes = field(default_factory=Notes)
    files: list[Path] = field(default_factory=list)
    budget: Budget = field(default_factory=Budget)

    def note(self, text: str, kind: str | None = None) -> None:
        """Say something to the user, once; see ``Notes``."""
        self.notes(text, kind)

    def find(self, reference: str, owner: Path, percent_encoded: bool = False) -> Path:
        """Path of a file that ``owner`` refers to; see ``_find``."""
        found = self._find(reference, owner, percent_encoded)
        named = PureWindowsPath(unquote(reference) if percent_encoded else reference).parts
        there = found.parts[-len(named) :]
        if there != named and [p.lower() for p in there] == [p.lower() for p in named]:
            self.note(
                f"'{reference}' differs from the name of the file in upper and lower case: '{found.name}' is taken"
            )
        self.files.append(found.resolve())
        return found

    def mention(self, reference: str, owner: Path, percent_encoded: bool = False) -> None:
        """Note that ``owner`` refers to a file, which need not be read, nor be there: what nothing
        shows yet belongs to the asset, too, and must not be replaced."""
        text = unquote(reference) if percent_encoded else reference
        with suppress(OSError, ValueError, RuntimeError):  # no file name
            path = (owner.resolve().parent / text.replace("\\", "/")).resolve()
            if path.is_file() and path not in self.files:
                self.files.append(path)

    def _find(self, reference: str, owner: Path, percent_encoded: bool) -> Path:
        """Raises InputError as ``resolve`` does.

        An absolute path names a place on the machine that wrote the file: where it leads nowhere,
        or to where nothing may be read, a file of the same name beside ``owner`` or in ``root``
        stands for it, with a note.
        """
        try:
            return resolve(reference, owner, percent_encoded, self.root)
        except InputError:
            # it takes both kinds of slashes
            path = PureWindowsPath(unquote(reference) if percent_encoded else reference)
            if not path.root:
                raise
        for folder in (
            owner.resolve().parent,
            *([] if self.root is None else [self.root.resolve()]),
        ):
            try:
                found = resolve(str(folder / path.name), owner, root=self.root)
            except MissingFileError:
                continue
            self.note(
                f"'{reference}' is not there or not to be read: '{found.name}' in {folder} stands for it"
            )
            return found
        raise MissingFileError(
            f"{owner}: refers to '{reference[:200]}' outside its own folder, where there is no '{path.name[:80]}'; "
            "copy it beside the file, or allow the folder with --root"
        )

    def picture(self, path: Path) -> NDArray:
        """Pixels of a picture that was found; see ``images.decode``. Raises InputError."""
        return self.decoded(read_bytes(path), str(path))

    def decoded(self, data: bytes, name: str) -> NDArray:
        """The same for a picture in memory, which errors call ``name``."""
        return images.decode(data, name, self.budget)

    def read(
        self, file: Callable[[], T], instead: str = "the material's constants stand alone"
    ) -> T | None:
        """What ``file`` reads; None if it is missing, or of no use for any other reason, and that
        is to be ignored. ``instead``: what the note says becomes of it. Raises InputError."""
        try:
            return file()
        except (InputError, *DATA_FAULTS) as error:
            if self.policy == "error":
                if not isinstance(error, InputError):
                    raise
                mend = "add the file, or" if isinstance(error, MissingFileError) else "or"
                raise InputError(
                    f"{error}; {mend} go on without it: --missing-textures ignore"
                ) from None
            self.note(f"{error}: ignored, {instead}", f"files ignored, {instead}")
            return None
