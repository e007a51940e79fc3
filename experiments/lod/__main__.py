"""Levels of detail: a chain against separate runs of the same counts, and what --max-error promises.

    python -m experiments.lod [--quick]

Writes ``out/lod/chain.md`` and ``out/lod/bound.md``: PSNR and FLIP of each level at its own size, of a
chain and of ``simplify`` with that many triangles at that size, and seconds; the bound that was
asked for, its certificate, and the error in views of another seed.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import appearance_opt as ao
from appearance_opt.evaluate.comparison import render_asset
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.jobs.smallest import most_of
from appearance_opt.options.bound import parse_bound
from appearance_opt.placement import Placement
from appearance_opt.views import MEASURED, views_around
from experiments.common import OUT, asset

if TYPE_CHECKING:
    from appearance_opt.asset.types import Asset
    from appearance_opt.evaluate.metrics import Metrics

ASSETS = ("spot/spot.obj", "teapot/Teapot.usd")
PIXELS, TRIANGLES = (256, 128, 64, 32), (1500, 700, 300, 120)
BOUND, BOUND_PIXELS = "0.5px", 128
VIEWS, RAYS, SEED = 24, 16, 4711


@dataclass(frozen=True)
class Settings:
    """Seconds of a chain, and of each separate run: those of the chain's finest level."""

    chain: float
    separate: float
    search: float


QUICK, FULL = Settings(90, 58, 60), Settings(400, 258, 280)


def look(source: Asset, light: Asset, pixels: int, seed: int = SEED) -> Metrics:
    """How different two assets look at a size, from views that nothing was chosen by."""
    placement = Placement.around(source.points())
    first, second = placement.local(source), placement.local(light)
    views = views_around(first.points(), seed).held_out(MEASURED).draw(0, VIEWS)
    images = [render_asset(a, views, pixels, RAYS) for a in (first, second)]
    return compare_images(*images)


def compare_chain(path: Path, settings: Settings) -> list[str]:
    """Rows of a table: each level of a chain, and a separate run beside it."""
    source, rows = ao.load(path), []
    began = time.perf_counter()
    chain = ao.lod(
        source, None, pixels=PIXELS, triangles=TRIANGLES, budget=settings.chain, began=began
    )
    whole = time.perf_counter() - began
    separate = 0.0
    for k, (pixels, count) in enumerate(zip(PIXELS, TRIANGLES, strict=True)):
        began = time.perf_counter()
        alone = ao.simplify(
            source,
            None,
            triangles=count,
            pixels=pixels,
            budget=settings.separate,
            began=began,
        )
        separate += time.perf_counter() - began
        ours, other = look(source, chain.levels[k], pixels), look(source, alone.asset, pixels)
        switch = "" if k == 0 else f"{chain.measured.switches[k - 1].pixels:.0f}"
        popping = "" if k == 0 else f"{chain.measured.switches[k - 1].popping:.4f}"
        rows.append(
            f"| {path.stem} | {pixels} | {count} | {ours.psnr_covered:.2f} | "
            f"{other.psnr_covered:.2f} | {ours.flip:.4f} | {other.flip:.4f} | "
            f"{chain.fitted[k].seconds:.0f} | {switch} | {popping} |"
        )
    rows.append(f"| {path.stem} | all | | | | | | {whole:.0f}, separate {separate:.0f} | | |")
    return rows


def check_bound(path: Path, settings: Settings) -> list[str]:
    """A row: what was promised, and what other views show."""
    source, bound = ao.load(path), parse_bound(BOUND)
    began = time.perf_counter()
    result = ao.simplify(
        source, None, max_error=BOUND, pixels=BOUND_PIXELS, budget=settings.search, began=began
    )
    took = time.perf_counter() - began
    told = result.facts["certificate"]
    fresh = look(source, result.asset, BOUND_PIXELS)
    errors = np.array([bound.error(getattr(v, bound.metric)) for v in fresh.views])
    within = float((errors <= bound.limit).mean())
    return [
        f"| {path.stem} | {BOUND} | {result.triangles} | {told['value']:.3f} +- "
        f"{told['standard_error']:.3f} | {100 * told['within']:.0f} % | {errors.mean():.3f} | "
        f"{100 * within:.0f} % | {most_of(errors):.3f} | {took:.0f} | "
        f"{result.facts['triangles tried']} |"
    ]


CHAIN_HEAD = [
    "| asset | pixels | triangles | chain, dB | alone, dB | chain, FLIP | alone, FLIP | seconds | "
    "takes over below | popping, FLIP |",
    "|---|---|---|---|---|---|---|---|---|---|",
]
BOUND_HEAD = [
    "| asset | bound | triangles | certificate | within | other views | within | all but one | "
    "seconds | tried |",
    "|---|---|---|---|---|---|---|---|---|---|",
]


def main() -> None:
    """Run both and write the tables, a row as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="short fits of one asset")
    arguments = parser.parse_args()
    settings = QUICK if arguments.quick else FULL
    folder = OUT / "lod"
    folder.mkdir(parents=True, exist_ok=True)
    for name, head, measure in (
        ("bound", BOUND_HEAD, check_bound),
        ("chain", CHAIN_HEAD, compare_chain),
    ):
        lines = list(head)
        for model in ASSETS[: 1 if arguments.quick else None]:
            lines += measure(asset(model), settings)
            (folder / f"{name}.md").write_text("\n".join(lines) + "\n")
        print("\n".join(lines), flush=True)


if __name__ == "__main__":
    main()
