"""Many damaged files of a format, and what became of them."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass, field
from pathlib import Path

from tests.fuzz.seeds import SEEDS, write_seeds

PATIENCE = 20.0
"""Seconds that reading a damaged file may take."""

MEMORY = 2 << 30
"""Bytes that it may take, the libraries that are loaded included."""


@dataclass
class Tally:
    """``read``, ``refused``: counts of what may happen; ``faults``: what may not, by the number of
    the file; ``slowest`` (seconds) and ``peak`` (bytes) of any file that ended."""

    kind: str
    read: int = 0
    refused: int = 0
    faults: dict[int, str] = field(default_factory=dict)
    slowest: float = 0.0
    peak: int = 0

    @property
    def total(self) -> int:
        return self.read + self.refused + len(self.faults)

    def count(self, number: int, how: str, seconds: float, peak: int) -> None:
        """Take in how a file ended."""
        self.slowest, self.peak = max(self.slowest, seconds), max(self.peak, peak)
        if how == "read":
            self.read += 1
        elif how == "refused":
            self.refused += 1
        else:
            self.faults[number] = how
        if peak > MEMORY:
            self.faults[number] = f"{peak / 2**30:.1f} GiB of memory"


def run(kind: str, count: int, first: int = 0) -> Tally:
    """Read ``count`` damaged files of a format of ``seeds.SEEDS``, numbers ``first`` and up: which
    files they are depends on their number alone."""
    tally = Tally(kind)
    with tempfile.TemporaryDirectory(prefix="fuzz") as name:
        folder = Path(name)
        at = first
        while at < first + count:
            write_seeds(folder)
            at = _run_worker(folder, kind, at, first + count, tally)
    return tally


def _run_worker(folder: Path, kind: str, first: int, last: int, tally: Tally) -> int:
    """Let a process read files until it dies, hangs or has done; the number of the next file."""
    command = [sys.executable, "-m", "tests.fuzz.worker", str(folder), kind, str(first), str(last)]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as worker:
        lines: queue.Queue[str] = queue.Queue()
        assert worker.stdout is not None
        threading.Thread(target=_pump, args=(worker.stdout, lines), daemon=True).start()
        begun = -1
        try:
            while True:
                # importing takes longer on a busy machine than any file may
                line = lines.get(timeout=PATIENCE if begun >= 0 else 10 * PATIENCE)
                if not line:
                    break
                said = json.loads(line)
                if "begun" in said:
                    begun = said["begun"]
                else:
                    tally.count(said["done"], said["how"], said["seconds"], said["peak"])
                    begun = -1
                    if said["peak"] > MEMORY:
                        return said["done"] + 1
                    if said["done"] == last - 1:
                        return last
        except queue.Empty:
            tally.faults[begun] = f"took more than {PATIENCE:g} s"
            return begun + 1
        finally:
            worker.kill()
    if begun < 0:
        raise RuntimeError(f"the worker for {kind} ended before it began: {' '.join(command)}")
    tally.faults[begun] = f"the process ended with exit code {worker.returncode}"
    return begun + 1


def _pump(stream, lines: queue.Queue[str]) -> None:
    for line in stream:
        lines.put(line)
    lines.put("")


def main() -> None:
    """``python -m tests.fuzz.campaign COUNT [FORMAT ...]``: run and print."""
    count, kinds = int(sys.argv[1]), sys.argv[2:] or list(SEEDS)
    for kind in kinds:
        tally = run(kind, count)
        print(
            f"{kind:12} {tally.read:5} read {tally.refused:5} refused {len(tally.faults):4} faults, "
            f"slowest {tally.slowest:.1f} s, peak {tally.peak / 2**20:.0f} MiB",
            flush=True,
        )
        for number, how in tally.faults.items():
            print(f"    {number}: {how}", flush=True)


if __name__ == "__main__":
    main()
