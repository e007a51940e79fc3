"""Reads damaged files, one after the other: ``python -m tests.fuzz.worker FOLDER FORMAT FIRST
LAST``.

Prints a line of JSON when it begins with a file and one when it has done: the number of the file,
and how it ended ("read", "refused", or the exception that no reader may raise).
"""

from __future__ import annotations

import json
import os
import random
import resource
import sys
import time
import traceback
from pathlib import Path

from appearance_opt.asset import images, load
from appearance_opt.config import read_toml, simplify_options
from appearance_opt.errors import InputError
from appearance_opt.optimize import archive
from tests.fuzz.mutators import mutate
from tests.fuzz.seeds import FINGERPRINT, SEEDS

LONGEST = 2000
"""Characters of an error at most."""


def read_asset(path: Path) -> None:
    """Load an asset, to triangles."""
    assert load(path).triangle_count > 0


def read_picture(path: Path) -> None:
    """Decode a picture."""
    assert images.read(path).ndim == 3


def read_job(path: Path) -> None:
    """Options of a job file."""
    simplify_options(**read_toml(path))


def read_checkpoint(path: Path) -> None:
    """The values of a checkpoint; whoever reads one names the file."""
    try:
        archive.read(path, FINGERPRINT, ())
    except archive.DamagedError as error:
        raise InputError(f"{path}: {error}") from error


READERS = {
    "asset": read_asset,
    "picture": read_picture,
    "job": read_job,
    "checkpoint": read_checkpoint,
}


def outcome(reader: str, path: Path) -> str:
    """How reading a file ends."""
    try:
        READERS[reader](path)
    except InputError as error:
        text = str(error)
        return (
            "refused"
            if text.isprintable() and len(text) < LONGEST
            else f"no line to show: {text!r}"
        )
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {str(error)[:200]} at {Path(where.filename).name}:{where.lineno}"
    return "read"


def main() -> None:
    """See the module."""
    folder, kind, first, last = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    said = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what libraries print is none of our lines
    seed = SEEDS[kind]
    whole = (folder / seed.file).read_bytes()
    for k in range(first, last):
        (folder / seed.file).write_bytes(mutate(kind, whole, random.Random(f"{kind} {k}")))
        print(json.dumps({"begun": k}), file=said)
        start = time.perf_counter()
        how = outcome(seed.reader, folder / seed.root)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        took = round(time.perf_counter() - start, 3)
        print(json.dumps({"done": k, "how": how, "seconds": took, "peak": peak}), file=said)
    (folder / seed.file).write_bytes(whole)


if __name__ == "__main__":
    main()
