"""Which Dr.Jit variant to use, and what this machine offers. The only place that selects one."""

from __future__ import annotations

import ctypes.util
import gc
import glob
import math
import os
import platform
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from appearance_opt.errors import BackendError

if TYPE_CHECKING:
    import mitsuba as mi
    from numpy.typing import NDArray

CPU, CUDA = "llvm_ad_rgb", "cuda_ad_rgb"
MINIMUM_LLVM = 15
"""Oldest LLVM that compiles our kernels (checked: 15, 16, 19)."""

THREADS = "APPEARANCE_OPT_THREADS"
"""Environment variable: at most so many threads compute on the CPU."""


@dataclass(frozen=True)
class Backend:
    """What runs, and on what: variant, LLVM version and library or None, threads, CUDA found."""

    variant: str
    llvm: str | None
    threads: int
    cuda: bool


def select(device: str = "auto") -> Backend:
    """Set the Mitsuba variant for "auto", "cpu" or "cuda" and return what was found. Raises
    BackendError with what to install when it cannot run."""
    _find_llvm()
    import drjit as dr
    import mitsuba as mi

    cuda = bool(dr.has_backend(dr.JitBackend.CUDA))
    if device == "cuda" and not cuda:
        raise BackendError(
            "no CUDA device was found: install NVIDIA's driver (R535 or newer), or use --device cpu"
        )
    variant = CUDA if device == "cuda" or (device == "auto" and cuda) else CPU
    version = None
    if variant == CPU:
        if not dr.has_backend(dr.JitBackend.LLVM):
            raise BackendError(f"libLLVM was not found: {install_hint()}")
        numbers = dr.detail.llvm_version()
        version = ".".join(str(n) for n in numbers)
        if numbers[0] < MINIMUM_LLVM:
            raise BackendError(
                f"libLLVM {version} is too old ({MINIMUM_LLVM} or newer is needed): {install_hint()}"
            )
    _limit_threads()
    if mi.variant() != variant:
        mi.set_variant(variant)
    return Backend(variant, version, dr.thread_count(), cuda)


def cores() -> int:
    """Processor cores that this process may run on: ``taskset`` and cpusets count."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _limit_threads() -> None:
    """Let Dr.Jit (and Mitsuba's Embree, which shares its threads) take no more threads than
    ``THREADS`` says, or than a container's share of the processors (cgroup v2) can run at a time:
    more would wait for each other."""
    import drjit as dr

    given = os.environ.get(THREADS, "").strip()
    if given:
        if not given.isdecimal() or int(given) < 1:
            raise BackendError(f"{THREADS}={given}: must be a whole number of threads, at least 1")
        limit = min(int(given), cores())
    else:
        limit = min(
            dr.thread_count(), _processor_quota(Path("/sys/fs/cgroup/cpu.max")) or dr.thread_count()
        )
    if dr.thread_count() != limit:
        dr.set_thread_count(limit)


def _processor_quota(file: Path) -> int | None:
    """Processors, rounded up, that a container may use at a time, or None where there is no
    limit."""
    try:
        quota, period = file.read_text().split()
        return max(1, math.ceil(int(quota) / int(period)))
    except (OSError, ValueError, ZeroDivisionError):  # "max", or another system
        return None


def to_device(array: NDArray) -> mi.Float:
    """Upload numbers (any shape, flattened) into memory of Dr.Jit's own.

    A bare ``mi.Float(array)`` may go on using NumPy's memory, whose alignment varies from call to
    call, and the kernels that read it are compiled for the one or the other.
    """
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    borrowed = mi.Float(np.ascontiguousarray(array, np.float32).ravel())
    own = dr.gather(mi.Float, borrowed, dr.arange(mi.UInt32, dr.width(borrowed)))
    dr.eval(own)
    return own


def release_memory() -> None:
    """Hand memory that Dr.Jit keeps for later arrays back to the system."""
    import drjit as dr

    gc.collect()  # models and their recorded kernels refer to each other
    dr.flush_malloc_cache()


def install_hint() -> str:
    """How to get libLLVM on this system, in a few words."""
    if sys.platform == "darwin":
        return "run 'brew install llvm'"
    names = _os_release()
    if {"debian", "ubuntu"} & names:
        return "run 'sudo apt-get install libllvm19' (or the newest libllvm* there is)"
    if {"fedora", "rhel", "centos"} & names:
        return "run 'sudo dnf install llvm-libs'"
    if "arch" in names:
        return "run 'sudo pacman -S llvm-libs'"
    return "install LLVM's shared library, or set DRJIT_LIBLLVM_PATH to it"


def versions() -> dict[str, str]:
    """Versions of what results depend on."""
    out = {"python": platform.python_version()}
    for name in (
        "appearance-opt",
        "drjit",
        "mitsuba",
        "numpy",
        "usd-core",
        "OpenImageIO",
        "xatlas",
        "flip-evaluator",
    ):
        try:
            out[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            out[name] = "missing"
    return out


def _find_llvm() -> None:
    """Point Dr.Jit to libLLVM where its own search does not look (Homebrew, versioned folders)."""
    if os.environ.get("DRJIT_LIBLLVM_PATH") or ctypes.util.find_library("LLVM"):
        return
    patterns = (
        "/opt/homebrew/opt/llvm*/lib/libLLVM.dylib",
        "/usr/local/opt/llvm*/lib/libLLVM.dylib",
        "/usr/lib/llvm-*/lib/libLLVM*.so*",
        "/usr/lib64/libLLVM*.so*",
        "/usr/lib64/llvm*/lib*/libLLVM*.so*",
    )
    found = sorted(p for pattern in patterns for p in glob.glob(pattern))
    if found:
        os.environ["DRJIT_LIBLLVM_PATH"] = found[-1]


def _os_release() -> set[str]:
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        return set()
    return {release.get("ID", ""), *release.get("ID_LIKE", "").split()}
