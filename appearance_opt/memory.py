"""How much memory there is."""

from __future__ import annotations

import os
from pathlib import Path


def available_memory() -> int | None:
    """Bytes of memory that a process may still take, or None where the system does not say. Limits
    of a container (cgroup v2) count; what it holds as a cache of files does not, as that gives
    way."""
    free = None
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = next(
            int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable")
        )
    except (OSError, StopIteration, ValueError):
        if not hasattr(os, "sysconf") or "SC_PHYS_PAGES" not in os.sysconf_names:
            return None
        free = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        group = Path("/sys/fs/cgroup")
        limit = int((group / "memory.max").read_text()) - int(
            (group / "memory.current").read_text()
        )
        held = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        limit += int(held["inactive_file"])
    except (OSError, ValueError, KeyError):  # no limit, or another system
        return free
    return min(free, max(limit, 0))
