"""Time and memory of a closed-form bake by size of the maps, each in a fresh process.

    python -m experiments.baking.speed [--asset chess_king] [--sizes 1024,2048,4096] [--samples 4] [--maps ...]

The command ``bake --closed-form`` from file to file, on the pair that ``experiments.baking`` makes:
reading, checks, rays, filling and writing included. CPU time is that of all threads together;
memory is the largest resident set.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from experiments.baking.pairs import OUT, ROWS, make_low
from experiments.common import isolated, source_of

BAKE = """
import json, resource, sys, time
import appearance_opt as a
began, cpu = time.perf_counter(), time.process_time()
o = a.bake_options(closed_form=True, texture_size=int(sys.argv[4]), samples=int(sys.argv[5]), maps=sys.argv[6])
r = a.bake(sys.argv[1], sys.argv[2], sys.argv[3], o)
print(json.dumps({"stages": r.seconds, "wall": time.perf_counter() - began, "cpu": time.process_time() - cpu,
                  "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20}))
"""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--asset", default="chess_king")
    parser.add_argument("--sizes", default="1024,2048,4096")
    parser.add_argument("--samples", default="4")
    parser.add_argument("--maps", default="normal,material")
    a = parser.parse_args()
    source, low = source_of(a.asset), OUT / f"{a.asset}_low.glb"
    if not low.exists():
        OUT.mkdir(parents=True, exist_ok=True)
        make_low(source, ROWS[a.asset], low)
    print("| texels | s | CPU s | peak GiB | s by stage |\n|---|---|---|---|---|", flush=True)
    for size in a.sizes.split(","):
        out = Path(OUT / f"{a.asset}_{size}.glb")
        r = isolated(BAKE, str(source), str(low), str(out), size, a.samples, a.maps)
        stages = ", ".join(f"{n} {s:.1f}" for n, s in r["stages"].items() if n != "total")
        print(
            f"| {size} x {size} | {r['wall']:.0f} | {r['cpu']:.0f} | {r['peak_gib']:.2f} | {stages} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
