"""What does this machine offer?"""

from __future__ import annotations

import os
import platform

from appearance_opt import backend
from appearance_opt.errors import BackendError


def diagnose() -> dict[str, object]:
    """Facts by name; ``problem`` is empty, or says what to install."""
    facts: dict[str, object] = {
        "system": f"{platform.system()} {platform.release()} {platform.machine()}"
    }
    facts["cores"] = backend.cores()
    facts["memory"] = _memory()
    facts.update(backend.versions())
    try:
        found = backend.select("auto")
        facts.update(
            backend=found.variant,
            llvm=found.llvm or "not used",
            threads=found.threads,
            thread_limit=os.environ.get(backend.THREADS, "").strip()
            or f"none ({backend.THREADS} sets one)",
            cuda="found" if found.cuda else "not found (optional)",
            problem="",
        )
    except BackendError as error:
        facts.update(backend="none", problem=str(error))
    except ImportError as error:
        facts.update(
            backend="none", problem=f"{error}: reinstall with 'pip install appearance-opt'"
        )
    return facts


def _memory() -> str:
    try:
        return f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.1f} GiB"
    except (ValueError, OSError, AttributeError):
        return "unknown"
