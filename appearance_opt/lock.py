"""One process at a time: locks on names that two runs must not write to at once."""

from __future__ import annotations

import fcntl
import os
import socket
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

PREFIX = b"appearance-opt: process "
"""How the content of a lock file begins."""


FOLDER_LOCK = ".lock"
"""The name of the lock on a folder, in it."""


def lock_path(target: Path) -> Path:
    """Where the lock on the file ``target`` lies: beside it."""
    return target.with_name(f".{target.name}.lock")


@contextmanager
def locked(target: Path, *, folder: bool = False) -> Iterator[None]:
    """Hold ``target``, a file or a ``folder``, for this process. Raises InputError naming the other
    process when another one holds it.

    A file beside it, or in the folder, names process and host. What holds is an advisory lock on
    that file (flock), which the system drops when the process ends, however it ends: the file that
    a killed run leaves behind holds nothing. Folders that are made for it are removed at the end if
    nothing else came into them.
    """
    path = target / FOLDER_LOCK if folder else lock_path(target)
    made = [p for p in (path.parent, *path.parent.parents) if not p.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    handle = acquire(path, target)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(handle)
        for empty in made:
            try:
                empty.rmdir()
            except OSError:
                break  # something is in it


def acquire(path: Path, target: Path) -> int:
    """The handle of the lock file ``path`` of ``target``, which holds until it is closed. Raises
    InputError when another process has it, or when the file is none of ours."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            found = os.read(handle, 512)
            if found and not found.startswith(PREFIX):
                raise InputError(
                    f"{path}: this name is needed for a lock, and the file is none; rename it"
                )
            if not _taken(handle, found):
                who = (
                    found.removeprefix(b"appearance-opt: ").decode(errors="replace").strip()
                    or "another process"
                )
                raise InputError(
                    f"{target}: another run is writing it ({who}); wait for it to end, or choose another name "
                    f"(the lock is {path})"
                )
            if _same(handle, path):
                with suppress(OSError):  # on a full disk it holds without a word
                    os.ftruncate(handle, 0)
                    os.pwrite(
                        handle, PREFIX + f"{os.getpid()} on {socket.gethostname()}\n".encode(), 0
                    )
                return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # its owner has removed it in between


def _taken(handle: int, found: bytes) -> bool:
    """Did we get the lock? ``found``: what its file said."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks: go by what the file says
        return not found or _is_over(found)
    return True


def _is_over(found: bytes) -> bool:
    """Does a lock file name a process of this host that is no more?"""
    process, _, host = found.removeprefix(PREFIX).decode(errors="replace").strip().partition(" on ")
    if host != socket.gethostname() or not process.isdigit():
        return False
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return False


def _same(handle: int, path: Path) -> bool:
    """Is the file behind the handle still the one at ``path``?"""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False
