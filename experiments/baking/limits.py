"""What could maps still gain while the shape of the light mesh stands still?

    python -m experiments.baking.limits [--rows chess_king,flight_helmet,relic] [--steps 200] [--views 12]

Three figures for the closed-form bake of each pair of ``experiments.baking``, all of the same views
of 256 x 256, by the renderer of the fit:

- how much of the squared error lies in pixels that an outline of either mesh crosses: no map reaches those;
- the PSNR if every other pixel were perfect: what no map, and no colour that changes with the view, can exceed;
- the PSNR of maps that were fitted to these very views: what maps of this size reach when they know the answers. A
  map has one value for a point, whichever way it is looked at; where HIGH lies before or behind LOW, each view wants
  another.

Results are kept row by row in ``out/baking/limits.json``.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import numpy as np

from experiments.baking.pairs import OUT as FOLDER
from experiments.baking.pairs import ROWS, make_low
from experiments.common import Kept, source_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

RESOLUTION, SIZE = 256, 1024


def outline_share(reference: NDArray, candidate: NDArray) -> tuple[float, float, float]:
    """(PSNR over covered pixels, share of the squared error in pixels that are not fully covered in
    both images, PSNR if the others were perfect), means over views."""
    from appearance_opt.render.display import display

    rows = []
    for r, c in zip(reference, candidate, strict=True):
        error = np.mean((display(r) - display(c)) ** 2, axis=-1)
        either = (r[..., 3] > 0) | (c[..., 3] > 0)
        outline = either & ((r[..., 3] < 1 - 1e-4) | (c[..., 3] < 1 - 1e-4))
        total, left = error[either].sum(), error[outline].sum()
        rows.append(
            [
                -10 * np.log10(total / either.sum()),
                left / total,
                -10 * np.log10(left / either.sum()),
            ]
        )
    psnr, share, bound = np.mean(rows, axis=0)
    return float(psnr), float(share), float(bound)


def limits(asset: str, steps: int, views: int) -> dict:
    """One row."""
    from appearance_opt import backend, bake_options, load
    from appearance_opt.baking.closed_form import Settings, bake
    from appearance_opt.latent.build import latent_of
    from appearance_opt.latent.parameter import Rates
    from appearance_opt.optimize.loop import fit
    from appearance_opt.optimize.plan import FitOptions
    from appearance_opt.optimize.validation import Validation
    from appearance_opt.reference.pool import ReferencePool
    from appearance_opt.stages.fitting import POOL_SAMPLES, fit_policy, point_width
    from appearance_opt.stages.pair import Pair
    from appearance_opt.stages.parts import split
    from appearance_opt.stages.run import Run
    from appearance_opt.views import MEASURED, Views

    backend.select("cpu")
    source, low = source_of(asset), FOLDER / f"{asset}_low.glb"
    if not low.exists():
        FOLDER.mkdir(parents=True, exist_ok=True)
        make_low(source, ROWS[asset], low)
    parts = split(load(source), asset, "bake"), split(load(low, keep_layout=True), asset, "bake")
    pair = Pair.of(*parts, asset, bake_options(texture_size=SIZE), Run())
    maps = dict(bake(pair.survey, pair.mesh, Settings(SIZE, samples=4)).maps)
    reference, sampler = pair.subject.reference, pair.subject.sampler.held_out(MEASURED)
    drawn = Views.concatenate([sampler.draw(k, 4) for k in range(views // 4)])
    model = latent_of(pair.mesh, maps, frozenset({"normal", "material"}), Rates())
    exact = Validation(reference, drawn, RESOLUTION, 16)
    model.set_rates(fit_policy(exact.psnr(model), likeness=True)[1])
    images = reference.render(drawn, RESOLUTION, 16)
    psnr, share, bound = outline_share(images, exact.render(model))
    # the pool draws the same groups of four from the same stream: it holds these views and no other
    pool = ReferencePool(
        reference,
        sampler,
        4 * (views // 4),
        4,
        RESOLUTION,
        POOL_SAMPLES,
        point_width(RESOLUTION, SIZE),
    )
    fit(model, pool, exact, FitOptions(steps=steps, laplacian=0.0))
    known, _, _ = outline_share(images, exact.render(model))
    return {"closed": psnr, "outline_share": share, "bound": bound, "knows_the_views": known}


def table(rows: list[dict]) -> str:
    """Markdown."""
    lines = [
        "| asset | closed form | error in outlines | all other pixels perfect | maps fitted to these very views |",
        "|---|---|---|---|---|",
    ]
    for r in rows:
        lines.append(
            f"| {r['asset']} | {r['closed']:.2f} | {100 * r['outline_share']:.0f} % | {r['bound']:.2f} | "
            f"{r['knows_the_views']:.2f} ({r['knows_the_views'] - r['closed']:+.2f}) |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rows", default="chess_king,flight_helmet,relic")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--views", type=int, default=12)
    a = parser.parse_args()
    kept = Kept(FOLDER / "limits.json")
    for asset in a.rows.split(","):
        key = {"asset": asset, "steps": a.steps, "views": a.views}
        print(
            table([kept.row(key, lambda asset=asset: limits(asset, a.steps, a.views))]), flush=True
        )
    print(table(kept.rows))


if __name__ == "__main__":
    main()
