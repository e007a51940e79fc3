"""Two assets, the same views and lights: how different do they look?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt import backend
from appearance_opt.asset import load
from appearance_opt.asset.alpha import kind_of
from appearance_opt.asset.types import Asset
from appearance_opt.baking.check import misfit
from appearance_opt.config import CompareOptions, resolve_options
from appearance_opt.errors import InputError
from appearance_opt.evaluate.comparison import compare_local
from appearance_opt.jobs.paths import Outputs
from appearance_opt.jobs.report import write_compare_report
from appearance_opt.placement import Placement
from appearance_opt.views import MEASURED, views_around

if TYPE_CHECKING:
    from appearance_opt.evaluate.comparison import Comparison


def compare(
    reference: str | Path | Asset,
    candidate: str | Path | Asset,
    options: CompareOptions | None = None,
    *,
    out: str | Path | None = None,
    **values: Any,
) -> Comparison:
    """Render both assets from random cameras under random lights and measure the difference.
    ``values``: options by flat key, instead of ``options`` or over them: ``views=4``. ``variant`` is
    of the reference. ``out``: folder for a report with pictures. What is transparent is drawn so (see
    ``render.layers``). Raises AppearanceError, also if one of the two shows nothing."""
    options = resolve_options(CompareOptions, options, values)
    outputs = Outputs.of(None, report=out)
    outputs.check()
    outputs.check_sources(reference, candidate)
    with outputs.held():
        reading = options.asset.arguments()
        first, second = (
            asset if isinstance(asset, Asset) else load(asset, **arguments)
            for asset, arguments in (
                (reference, reading),
                (candidate, {**reading, "variants": None}),
            )
        )
        outputs.check_inputs(first, second)
        outputs.check_room(0, None)
        backend.select(options.device)
        points = np.concatenate([first.points(), second.points()])
        placement = Placement.around(points)
        sampler = views_around(placement.to_local(points), options.seed).held_out(MEASURED)
        apart = _apart(first, second)
        try:
            local = placement.local(first), placement.local(second)
            result = compare_local(*local, sampler, options)
        except InputError as error:
            # of two small things far from each other, pictures may show neither
            raise InputError("; ".join([str(error), *apart])) from error
        if outputs.report is not None:
            write_compare_report(outputs.report, first, second, placement, result, options)
    told = (*first.notes, *second.notes, *apart, *_drawn_otherwise(first, second))
    return replace(result, notes=(*told, *result.notes))


def _apart(reference: Asset, candidate: Asset) -> list[str]:
    """A note on two assets that lie so far apart that each is small in every picture."""
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
