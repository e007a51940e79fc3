"""Which part of a displaced latent wins what, and at which rate: short fits from one start.

    python -m experiments.displacement.rates [--asset chess_king] [--steps 80] [CASE ...]

A CASE is parts joined by "+", a colon, and rates of positions, displacement and maps in units of
the automatic ones, as "shape+displacement:1,1,1". All cases share the start (1,000 triangles, level
3, closed form), the pool of views (48 of 160 x 160) and the held-out views (8 of 192 x 192). The
displacement map's rate is per finest edge, that of positions per base edge. Rows are kept in
``out/displacement/rates.json``.
"""

from __future__ import annotations

import argparse
from functools import cache

from experiments.common import OUT, Kept, Placed, source_of

CASES = (
    "displacement:1,1,1",
    "displacement:1,0.25,1",
    "shape:1,1,1",
    "shape:0.125,1,1",
    "shape:2.5,1,1",
    "normal+material:1,1,1",
    "normal+material:1,1,0.25",
    "shape+displacement:1,1,1",
    "shape+displacement+normal+material:1,1,1",
    "shape+displacement+normal+material:1,1,0.25",
)
TRIANGLES, LEVEL, POOL, RESOLUTION, HELD_OUT = 1000, 3, 48, 160, 192


class Bench:
    """What all cases of an asset share."""

    def __init__(self, asset: str) -> None:
        from appearance_opt import backend, load, simplify_options
        from appearance_opt.optimize.validation import Validation
        from appearance_opt.reference.pool import ReferencePool
        from appearance_opt.stages.decimated import decimate_start
        from appearance_opt.stages.fitting import point_width
        from appearance_opt.views import VALIDATION

        backend.select("cpu")
        placed = Placed(load(source_of(asset)))
        reference, sampler = placed.reference, placed.sampler
        options = simplify_options(
            triangles=TRIANGLES, displacement=True, subdivision=(LEVEL,), reallocate=0
        )
        self.start = decimate_start(placed.subject, options, TRIANGLES)
        width = point_width(RESOLUTION, options.texture.size)
        self.pool = ReferencePool(
            reference, sampler, POOL, options.views.per_step, RESOLUTION, 16, width
        )
        self.validation = Validation(reference, sampler.held_out(VALIDATION).draw(0, 8), HELD_OUT)

    def run(self, case: str, steps: int) -> dict:
        """PSNR before, in the middle and after; seconds include the first rendering of the pool's
        views."""
        from appearance_opt.latent.build import latent_of
        from appearance_opt.latent.parameter import Rates
        from appearance_opt.optimize.loop import fit
        from appearance_opt.optimize.plan import FitOptions
        from appearance_opt.stages.fitting import fit_policy

        parts, numbers = case.split(":")
        position, displacement, maps = (float(x) for x in numbers.split(","))
        model = latent_of(
            self.start.mesh,
            self.start.maps,
            frozenset(parts.split("+")),
            Rates(),
            self.start.levels,
        )
        quality, rates = fit_policy(self.validation.psnr(model), self.start.relative)
        scaled = (
            rates.position * position,
            *(r * maps for r in (rates.normal, rates.base_color, rates.material)),
        )
        model.set_rates(Rates(*scaled, rates.displacement * displacement))
        found = fit(
            model,
            self.pool,
            self.validation,
            FitOptions(steps=steps, quality=quality, validate_every=0.5),
        )
        return {"psnr": [p.psnr for p in found.curve], "seconds": found.seconds}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("cases", nargs="*", default=list(CASES))
    parser.add_argument("--asset", default="chess_king")
    parser.add_argument("--steps", type=int, default=80)
    a = parser.parse_args()
    kept, bench = Kept(OUT / "displacement" / "rates.json"), cache(Bench)
    print(
        "| asset | fitted: rates of positions, displacement, maps | start | half of the steps | all | gain |"
    )
    print("|---|---|---|---|---|---|", flush=True)
    for case in a.cases:
        key = {"asset": a.asset, "case": case, "steps": a.steps}
        row = kept.row(key, lambda case=case: bench(a.asset).run(case, a.steps))
        p = row["psnr"]
        print(
            f"| {a.asset} | {case} | {' | '.join(f'{x:.2f}' for x in p)} | {p[-1] - p[0]:+.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
