"""Files that appear together: written under temporary names, and renamed once all of them are
whole."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from appearance_opt.errors import InputError
from appearance_opt.lock import acquire

if TYPE_CHECKING:
    from collections.abc import Iterator

PREFIX = ".appearance-opt-"
"""How the names of the folders begin in which files wait for their final names."""

NEW, OLD, JOURNAL, LOCK = "new", "old", "journal.json", "lock"
"""What lies in such a folder: what is written; what it replaces, while it does; which names are
being changed; and a lock that holds as long as the process lives."""


class Publication:
    """Files that get their final names together or not at all. Made by ``publication``.

    A single file is renamed at once. Of several, the old ones move aside first, those that refer to
    others before all others, and then the new ones take their names in the opposite order: at no
    moment does a file refer to parts of another version. A journal beside them says what is being
    done. When a rename fails all is undone; when the process is killed in between, ``recover``
    undoes it before the next run writes there.
    """

    def __init__(self) -> None:
        self._staged: dict[Path, _Staged] = {}
        self._roots: list[Path] = []

    def place(self, final: Path) -> Path:
        """Where to write ``final``. What is written beside it, or in folders there, appears beside
        ``final``, and before it."""
        final = Path(final)
        self._roots.append(final)
        folder = final.parent.resolve()
        if folder not in self._staged:
            folder.mkdir(parents=True, exist_ok=True)
            recover(folder)
            self._staged[folder] = _Staged.made(folder)
        return self._staged[folder].new / final.name

    def files(self, main: Path) -> tuple[Path, ...]:
        """The final names of what is written so far, ``main`` first."""
        found = [final for staged in self._staged.values() for _, final in staged.moves()]
        return tuple(sorted(found, key=lambda path: path.name != Path(main).name))

    def commit(self) -> None:
        """Give all files their final names, or none. Raises OSError, InputError."""
        roots = {p.parent.resolve() / p.name for p in self._roots}
        moves = [move for staged in self._staged.values() for move in staged.moves()]
        moves.sort(key=lambda move: (move[1] in roots, str(move[1])))
        for new, final in moves:
            if final.is_dir():
                raise InputError(
                    f"{final}: is a folder, where a file is to be written; choose another name"
                )
            _synchronize(new)
        if len(moves) == 1:
            moves[0][0].replace(moves[0][1])
        elif moves:
            self._replace(moves)
        for folder in {final.parent for _, final in moves}:
            _synchronize(folder)

    def _replace(self, moves: list[tuple[Path, Path]]) -> None:
        for staged in self._staged.values():
            staged.write_journal(
                [str(n.relative_to(staged.new)) for n, _ in moves if n.is_relative_to(staged.new)]
            )
        try:
            for new, final in reversed(moves):
                final.parent.mkdir(parents=True, exist_ok=True)
                old = self._staged_of(new).old_of(new)
                if os.path.lexists(final):
                    old.parent.mkdir(parents=True, exist_ok=True)
                    final.rename(old)
            for new, final in moves:
                new.rename(final)
        except BaseException:
            for staged in self._staged.values():
                staged.undo()
            raise
        for staged in self._staged.values():
            staged.journal.unlink()

    def _staged_of(self, new: Path) -> _Staged:
        return next(s for s in self._staged.values() if new.is_relative_to(s.root))

    def close(self) -> None:
        """Remove what is temporary."""
        for staged in self._staged.values():
            staged.close()

    def named(self, path: object) -> str | None:
        """The final name of a file that waits here, the first of all where none is named; None for
        other files."""
        if not isinstance(path, str):
            return str(self._roots[0]) if self._roots else None
        for staged in self._staged.values():
            if Path(path).is_relative_to(staged.root):
                relative = Path(path).relative_to(staged.root)
                return str(staged.folder.joinpath(*relative.parts[1:]))
        return None


@contextmanager
def publication() -> Iterator[Publication]:
    """Files written to places of the publication appear at the end, all or none; none of them if
    the block raises. Raises OSError naming the file that could not be written by its final name."""
    together = Publication()
    try:
        yield together
        together.commit()
    except OSError as error:
        final = together.named(error.filename)
        if final is None:
            raise
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), final) from error
    finally:
        together.close()


@contextmanager
def publishing(final: Path) -> Iterator[Path]:
    """``publication`` of one file and what is written beside it: where to write it."""
    with publication() as together:
        yield together.place(final)


def recover(folder: Path) -> None:
    """Undo what a killed run has left half done in ``folder``, and remove its temporary files. What
    belongs to a process that lives is left alone."""
    for root in sorted(folder.glob(PREFIX + "*")):
        if not root.is_dir() or root.is_symlink() or not (root / LOCK).is_file():
            continue
        try:
            handle = acquire(root / LOCK, root)
        except (InputError, OSError):
            continue
        _Staged(folder, root, handle).recover()


class _Staged:
    """The temporary folder ``root`` in ``folder``."""

    def __init__(self, folder: Path, root: Path, handle: int) -> None:
        self.folder, self.root, self._handle = folder, root, handle
        self.new, self.old, self.journal = root / NEW, root / OLD, root / JOURNAL

    @classmethod
    def made(cls, folder: Path) -> _Staged:
        """A new one. Raises OSError, and leaves nothing behind then."""
        root = Path(tempfile.mkdtemp(dir=folder, prefix=PREFIX))
        try:
            (root / NEW).mkdir()
            return cls(folder, root, acquire(root / LOCK, root))
        except BaseException:
            shutil.rmtree(root, ignore_errors=True)
            raise

    def moves(self) -> list[tuple[Path, Path]]:
        """(where it waits, final name) of every file."""
        return [
            (p, self.folder / p.relative_to(self.new))
            for p in sorted(self.new.rglob("*"))
            if p.is_file()
        ]

    def old_of(self, new: Path) -> Path:
        """Where the file goes that ``new`` replaces."""
        return self.old / new.relative_to(self.new)

    def write_journal(self, names: list[str]) -> None:
        """Note which names are about to change, those that refer to others last, and which files
        are new."""
        self.journal.write_text(json.dumps([[name, *_identity(self.new / name)] for name in names]))
        _synchronize(self.journal)

    def undo(self) -> None:
        """Back to what was there before: new files go, old ones return. May be cut short and done
        again.

        A journal may come from anybody who packs a folder, so it is not trusted: only files that
        are known by their number on this disk go, nothing is replaced, and no name leads out of the
        folder."""
        for name, device, number in reversed(self._noted()):
            new, final = self.new / name, self.folder / name
            if (
                not os.path.lexists(new)
                and os.path.lexists(final)
                and _identity(final) == (device, number)
            ):
                final.rename(new)
        for name, _, _ in self._noted():
            if os.path.lexists(self.old / name) and not os.path.lexists(self.folder / name):
                (self.old / name).rename(self.folder / name)
        self.journal.unlink(missing_ok=True)

    def _noted(self) -> list[tuple[str, int, int]]:
        """(name, device, number) of the journal, as far as it is one."""
        try:
            rows = [
                (str(name), int(device), int(number))
                for name, device, number in json.loads(self.journal.read_text())
            ]
        except (OSError, ValueError, TypeError):
            return []  # nothing was begun
        return [
            row
            for row in rows
            if all(_within(top / row[0], top) for top in (self.folder, self.new, self.old))
            and not self.new.is_symlink()
            and not self.old.is_symlink()
        ]

    def recover(self) -> None:
        """Undo and remove what a killed process has left."""
        try:
            self.undo()
        finally:
            self.close()

    def close(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.root, ignore_errors=True)
        os.close(self._handle)


def _identity(path: Path) -> tuple[int, int]:
    """(device, number) by which a disk knows a file, whatever its name."""
    found = path.lstat()
    return found.st_dev, found.st_ino


def _within(path: Path, folder: Path) -> bool:
    """Does a file lie in a folder, without detours by links or parents?"""
    return ".." not in path.parts and path.parent.resolve().is_relative_to(folder.resolve())


def _synchronize(path: Path) -> None:
    """Bring a file, or the names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError:
        if path.is_file():
            raise  # some file systems cannot do it for folders
    finally:
        os.close(handle)
