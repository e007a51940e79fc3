"""Many runs of one small job, each in a process of its own that is forked when all is imported.

Dr.Jit computes in one thread here: runs of one job are then equal to the last bit, so that any file
that is not of the old result or of the new one, byte by byte, is found.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import pkgutil
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import appearance_opt
from appearance_opt import backend
from appearance_opt.asset import load, save
from appearance_opt.cli import main
from appearance_opt.jobs import simplify
from appearance_opt.publish import PREFIX
from experiments.common import OUT
from scenes.analytic import two_materials

SOURCES = Path(__file__).parent / "faults.c"

JOB = [
    "simplify", "in.glb", "--texture-size", "32", "--resolution", "32", "--pool", "4", "--views", "2",
    "--reallocate", "0", "--seed", "1", "--triangles", "150", "--device", "cpu", "--no-report", "--checkpoint", "state",
]  # fmt: skip
OLD = ("--steps", "0")
"""What tells the result that is there from the one that takes its place."""


@dataclass(frozen=True)
class Ended:
    """How a run ended: ``code`` is negative for the signal that ended it; ``text``: what it said;
    ``calls``: how often it changed the disk; ``seconds`` of computing."""

    code: int
    text: str
    calls: int
    seconds: float


def prepare() -> None:
    """Import everything that a run needs, so that it costs the forked processes nothing. No thread
    is started."""
    backend.select("cpu")
    simplify.CHECKPOINT_SECONDS = 0.0
    for module in pkgutil.walk_packages(appearance_opt.__path__, "appearance_opt."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    for name in (
        "OpenImageIO",
        "pxr.UsdGeom",
        "pxr.UsdShade",
        "pxr.UsdUtils",
        "scipy.ndimage",
        "scipy.sparse",
        "xatlas",
    ):
        importlib.import_module(name)


def run(folder: Path, *more: str, before: Callable[[], None] = lambda: None) -> Ended:
    """The job in ``folder``. ``before``: what happens in the process at its start."""
    log = folder.with_name(folder.name + ".log")  # elsewhere: it is none of the files that matter
    faults = _faults()
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            os.chdir(folder)
            handle = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
            os.dup2(handle, 1)
            os.dup2(handle, 2)
            (folder / "tmp").mkdir(exist_ok=True)
            tempfile.tempdir = str(folder / "tmp")
            import drjit as dr

            dr.set_thread_count(1)
            sys.argv = ["appearance-opt", *JOB, *more]
            before()
            main()
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        finally:
            calls = 0 if faults is None else faults.fault_calls()
            os.write(write, f"{calls}".encode())
            os._exit(code)
    os.close(write)
    _, status, usage = os.wait4(child, 0)
    with os.fdopen(read) as file:
        calls = file.read()
    code = os.waitstatus_to_exitcode(status)
    return Ended(
        code, log.read_text(errors="replace"), int(calls or 0), usage.ru_utime + usage.ru_stime
    )


def after(seconds: float, number: signal.Signals) -> Callable[[], None]:
    """A signal after so many seconds of computing, however busy the machine is."""

    def set_timer() -> None:
        if number == signal.SIGKILL:
            signal.signal(signal.SIGPROF, signal.SIG_DFL)  # which ends the process as surely
        else:
            signal.signal(signal.SIGPROF, lambda *_: os.kill(os.getpid(), number))
        signal.setitimer(signal.ITIMER_PROF, max(seconds, 1e-3))

    return set_timer


def fault(folder: Path, call: int, *, kill: bool) -> Callable[[], None]:
    """From the call on that changes the disk under ``folder`` after so many others: no room (or
    death)."""

    def set_fault() -> None:
        faults = _faults()
        assert faults is not None
        faults.fault_set(f"{folder}/".encode(), ctypes.c_long(call), int(kill))

    return set_fault


def with_faults() -> None:
    """Start this program again with the library that makes faults, if it is not loaded. Needs a C
    compiler."""
    if _faults() is not None:
        return
    if "LD_PRELOAD" in os.environ:
        raise SystemExit("the library that makes faults cannot be loaded (LD_PRELOAD is set)")
    library = OUT / "robustness" / f"faults_{os.getpid()}.so"
    library.parent.mkdir(parents=True, exist_ok=True)
    compiler = shutil.which("cc")
    if compiler is None:
        raise SystemExit("this experiment needs a C compiler (cc)")
    os.spawnv(
        os.P_WAIT,
        compiler,
        [compiler, "-shared", "-fPIC", "-O1", "-w", "-o", str(library), str(SOURCES), "-ldl"],
    )
    os.execve(
        sys.executable,
        [sys.executable, *sys.orig_argv[1:]],
        {**os.environ, "LD_PRELOAD": str(library)},
    )


def _faults() -> ctypes.CDLL | None:
    program = ctypes.CDLL(None)
    return program if hasattr(program, "fault_set") else None


class Case:
    """A folder with an input and an old result of one format, and what the new one is to be, after
    so many steps. ``command``: what makes it."""

    def __init__(self, folder: Path, suffix: str, steps: int) -> None:
        self.suffix, self.folder = suffix, folder
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        save(two_materials(600), self.folder / "in.glb")
        self.input = (self.folder / "in.glb").read_bytes()
        self.command = ("--out", f"low{suffix}", "--steps", str(steps))
        self.whole = self._made()
        self.new = self.results()
        self.psnr = _psnr(self.whole.text)
        self._made(*OLD)
        self.old = self.results()
        assert self.old.keys() <= self.new.keys() and self.old != self.new

    def _made(self, *options: str) -> Ended:
        for path in self.folder.glob("low*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        ended = run(self.folder, *self.command, *options)
        assert ended.code == 0, ended
        return ended

    def reset(self) -> None:
        """The old result, no checkpoint, nothing temporary."""
        for path in self.folder.iterdir():
            if path.name != "in.glb":
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        for name, data in self.old.items():
            (self.folder / name).parent.mkdir(exist_ok=True)
            (self.folder / name).write_bytes(data)

    def results(self) -> dict[str, bytes]:
        """Files of the result, by their names."""
        files = (p for p in self.folder.rglob("*") if p.is_file())
        named = {str(p.relative_to(self.folder)): p for p in files}
        return {name: p.read_bytes() for name, p in sorted(named.items()) if name.startswith("low")}

    def faults_in(self, *, interrupted: bool = False) -> list[str]:
        """What is wrong with the files there: nothing may be of another version than the root file,
        or changed. ``interrupted``: may the result be one of fewer steps, which is only read?"""
        found, root = self.results(), f"low{self.suffix}"
        out = (
            [] if (self.folder / "in.glb").read_bytes() == self.input else ["the input was changed"]
        )
        if root not in found:
            return out
        expected = self.old if found[root] == self.old[root] else self.new
        if interrupted and found[root] not in (self.old[root], self.new[root]):
            if load(self.folder / root).triangle_count > 150:
                out.append("the result has too many triangles")
        else:
            out += [f"{n} is of another version" for n in expected if found.get(n) != expected[n]]
        return out

    def left_over(self) -> list[str]:
        """Temporary files."""
        state = list((self.folder / "state").glob(".*")) if (self.folder / "state").exists() else []
        return [
            p.name for p in (*self.folder.glob(PREFIX + "*"), *self.folder.glob(".low*"), *state)
        ]


def psnr_lost(case: Case, ended: Ended) -> float:
    """By how much a run's last held-out PSNR lies off that of the whole one (dB)."""
    return abs(_psnr(ended.text) - case.psnr)


def _psnr(text: str) -> float:
    return float(text.rsplit(" -> ", 1)[1].split()[0])
