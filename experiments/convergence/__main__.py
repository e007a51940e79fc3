"""Which visibility estimator brings a whole fit further in the same time?

    python -m experiments.convergence                       # 3 cases x 6 estimators, 25 s each: about 10 minutes
    python -m experiments.convergence --rows sphere decimated:pairs --seconds 5 --out out/try
    python -m experiments.convergence --plot                # picture and tables from what was measured

Each fit is one row of out/convergence/curves.csv per look at the held-out views; a rerun skips fits
of the same length that are there, and picture and tables are of the fits of ``--seconds``. Needs
spot and flight_helmet in ``../shared/assets``. Images of the reference are rendered, and kernels
compiled, before the clock starts.
"""

from __future__ import annotations

import argparse
import csv
import gc
from dataclasses import replace
from pathlib import Path

from appearance_opt import backend
from appearance_opt.optimize.loop import fit
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.boundary.edges import Edges
from appearance_opt.render.boundary.pairs import Pairs
from appearance_opt.render.quality import Quality
from experiments.convergence.cases import Case, make_case, names, source
from experiments.convergence.plot import draw

OUT = Path("out/convergence")
ESTIMATORS = {
    "none": Quality(visibility=CameraRays(())),
    "edges 1, 4 rays": Quality(visibility=CameraRays(samples=4)),
    "edges 1, 8 rays": Quality(),
    "edges 4, 8 rays": Quality(visibility=CameraRays((Edges(4.0),))),
    "pairs": Quality(visibility=Pairs()),
    "pairs, 2 x 2": Quality(4, visibility=Pairs()),
}
FIELDS = ("case", "estimator", "seed", "budget", "seconds", "step", "psnr")
LOOK = 1 / 12
"""Part of a fit between two looks at the held-out views; their time counts for all alike."""

WARM_UP = 4
"""Steps of a fit that is thrown away: kernels are compiled in the first ones."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", nargs="*", default=names(), help="case, or case:estimator")
    parser.add_argument("--seconds", type=float, default=25.0, help="of each fit")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--plot", action="store_true")
    arguments = parser.parse_args()
    path = arguments.out / "curves.csv"
    if not arguments.plot:
        for name in names():  # before any fit
            source(name)
        backend.select("cpu")
        for seed in range(arguments.seeds):
            for name in names():
                wanted = [
                    e
                    for e in ESTIMATORS
                    if name in arguments.rows or f"{name}:{e}" in arguments.rows
                ]
                there = {
                    (r["case"], r["estimator"], int(r["seed"]))
                    for r in lasting(rows_of(path), arguments.seconds)
                }
                missing = [e for e in wanted if (name, e, seed) not in there]
                if missing:
                    run(make_case(name, seed), missing, seed, arguments.seconds, path)
    draw(path, lasting(rows_of(path), arguments.seconds))


def run(case: Case, estimators: list[str], seed: int, seconds: float, path: Path) -> None:
    """Fit one case with each of the estimators; each curve is kept as soon as it is complete."""
    for name in estimators:
        options = replace(case.options, quality=ESTIMATORS[name], validate_every=LOOK)
        fit(case.make(), case.pool, case.validation, replace(options, steps=WARM_UP))
        result = fit(case.make(), case.pool, case.validation, replace(options, seconds=seconds))
        rows = [(case.name, name, seed, seconds, p.seconds, p.step, p.psnr) for p in result.curve]
        keep(path, rows)
        last = result.curve[-1]
        print(
            f"{case.name:10} {name:18} seed {seed}: {last.step:5} steps, {last.psnr:.2f} dB",
            flush=True,
        )
        gc.collect()


def rows_of(path: Path) -> list[dict[str, str]]:
    """What was measured so far."""
    if not path.exists():
        return []
    with path.open() as file:
        return list(csv.DictReader(file))


def lasting(rows: list[dict[str, str]], seconds: float) -> list[dict[str, str]]:
    """Those of fits of that length."""
    return [r for r in rows if abs(float(r["budget"]) - seconds) < 1e-3]


def keep(path: Path, rows: list[tuple]) -> None:
    """Append a curve to the table (rewritten under another name, so that it is never half
    there)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    every = [tuple(r[f] for f in FIELDS) for r in rows_of(path)]
    every += [tuple(f"{v:.4f}" if isinstance(v, float) else v for v in r) for r in rows]
    temporary = path.with_suffix(".partial")
    with temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(FIELDS)
        writer.writerows(every)
    temporary.rename(path)


if __name__ == "__main__":
    main()
