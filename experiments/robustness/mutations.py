"""Damaged files of every format that is read, by the hundreds (docs/reliability.md).

    python -m experiments.robustness.mutations [--count 500] [--formats GLB,OBJ,...] [--first 0]

What is done to them is in ``tests/fuzz/mutators.py``; which files they are depends on their numbers
alone. Each is read in a process that may die, hang (20 seconds) or take too much memory (2 GiB).
Prints the table of the page, and each fault with the number of its file. Needs the packages of the
extra "dev".
"""

from __future__ import annotations

import argparse

from tests.fuzz.campaign import Tally, run
from tests.fuzz.seeds import SEEDS


def row(tally: Tally) -> str:
    """A row of the table."""
    spent = f"{tally.slowest:.1f} s | {tally.peak / 2**20:.0f} MiB"
    return f"| {tally.kind} | {tally.total} | {tally.read} | {tally.refused} | {len(tally.faults)} | {spent} |"


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--first", type=int, default=0, help="number of the first file")
    parser.add_argument("--formats", default=",".join(SEEDS), help=f"of {list(SEEDS)}")
    options = parser.parse_args()
    print(
        "| format | files | read | refused | faults | slowest | peak memory |\n|---|---|---|---|---|---|---|"
    )
    for kind in options.formats.split(","):
        tally = run(kind, options.count, options.first)
        print(row(tally), flush=True)
        for number, how in tally.faults.items():
            print(f"    {kind} {number}: {how}", flush=True)


if __name__ == "__main__":
    main()
