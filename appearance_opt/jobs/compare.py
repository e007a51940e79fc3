"""Two assets, the same views and lights: how different do they look?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt import backend
from appearance_opt.asset.alpha import kind_of
from appearance_opt.config import DEVICES
from appearance_opt.errors import InputError
from appearance_opt.jobs.paths import Outputs
from appearance_opt.placement import Placement

if TYPE_CHECKING:
    from appearance_opt.asset.companions import MissingTextures
    from appearance_opt.asset.types import Asset
    from appearance_opt.evaluate.comparison import Comparison


def compare(
    reference: str | Path | Asset,
    candidate: str | Path | Asset,
    *,
    views: int = 12,
    resolution: int = 384,
    samples: int = 16,
    seed: int = 0,
    device: str = "auto",
    out: str | Path | None = None,
    refine: int = 1,
    missing_textures: MissingTextures = "error",
    root: str | Path | None = None,
    crease_angle: float | None = None,
    variants: dict[str, str] | None = None,
) -> Comparison:
    """Render both assets from ``views`` random cameras under random lights and measure the
    difference. ``out``: folder for a report with pictures. ``refine``, ``missing_textures``,
    ``root``, ``crease_angle``: see ``load``; ``variants``: of the reference. What is transparent is
    drawn so (see ``render.layers``). Raises AppearanceError, also if one of the two shows
    nothing."""
    if device not in DEVICES:
        raise InputError(f"--device {device}: choose from {', '.join(DEVICES)}")
    if seed < 0:
        raise InputError(f"--seed {seed}: must be 0 or more")
    outputs = Outputs.of(None, report=out)
    outputs.check()
    outputs.check_sources(reference, candidate)
    reading = {
        "refine": refine,
        "missing_textures": missing_textures,
        "root": root,
        "crease_angle": crease_angle,
    }
    with outputs.held():
        given = ((reference, {**reading, "variants": variants}), (candidate, reading))
        return _compare(given, outputs, (views, resolution, samples, seed, device))


def _compare(
    both: tuple[
        tuple[str | Path | Asset, dict[str, Any]], tuple[str | Path | Asset, dict[str, Any]]
    ],
    outputs: Outputs,
    drawing: tuple[int, int, int, int, str],
) -> Comparison:
    """``both``: each with how it is to be read; ``drawing``: views, resolution, samples, seed,
    device."""
    from appearance_opt.asset import load
    from appearance_opt.asset.types import Asset

    views, resolution, samples, seed, device = drawing
    first, second = (a if isinstance(a, Asset) else load(a, **reading) for a, reading in both)
    outputs.check_inputs(first, second)
    outputs.check_room(0, None)
    backend.select(device)
    from appearance_opt.evaluate.comparison import compare_local
    from appearance_opt.views import MEASURED, views_around

    points = np.concatenate([first.points(), second.points()])
    placement = Placement.around(points)
    sampler = views_around(placement.to_local(points), seed).held_out(MEASURED)
    apart = _apart(first, second)
    in_one = placement.local(first), placement.local(second)
    try:
        result = compare_local(*in_one, sampler, views, resolution, samples)
    except (
        InputError
    ) as error:  # of two small things far from each other, pictures may show neither
        raise InputError("; ".join([str(error), *apart])) from error
    if outputs.report is not None:
        from appearance_opt.jobs.report import write_compare_report

        write_compare_report(outputs.report, first, second, result)
    return replace(
        result, notes=(*first.notes, *second.notes, *apart, *_drawn_otherwise(first, second))
    )


def _apart(reference: Asset, candidate: Asset) -> list[str]:
    """A note on two assets that lie so far apart that each is small in every picture."""
    from appearance_opt.baking.check import misfit

    offset, ratio, diagonal = misfit(reference, candidate)
    if offset <= (1 + ratio) * diagonal / 2:
        return []
    return [
        f"the two lie {offset:.6g} m apart, {offset / diagonal:.3g} times the size of the reference: move one of them"
    ]


def _drawn_otherwise(*assets: Asset) -> list[str]:
    """A note on what the pictures show differently from what the files say."""
    if all(kind_of(m.material) != "transmission" for a in assets for m in a.meshes):
        return []
    return [
        "transmission is drawn like blended alpha: nothing is refracted, coloured inside or blurred"
    ]
