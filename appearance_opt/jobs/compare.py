"""Two assets, the same views and lights: how different do they look?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from appearance_opt import backend
from appearance_opt.asset import load
from appearance_opt.asset.alpha import kind_of
from appearance_opt.asset.posing import pose_asset
from appearance_opt.asset.types import Asset
from appearance_opt.baking.check import misfit
from appearance_opt.config import CompareOptions, resolve_options
from appearance_opt.errors import InputError
from appearance_opt.evaluate.comparison import Comparison, compare_local
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.evaluate.motion import Motion, show_motion
from appearance_opt.jobs.paths import Outputs
from appearance_opt.jobs.report import write_compare_report
from appearance_opt.placement import Placement
from appearance_opt.views import MEASURED, views_around


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
    of the reference; with a ``clip`` both are posed by it, each view at another frame.
    ``out``: folder for a report with pictures. What is transparent is drawn so (see
    ``render.layers``). Raises AppearanceError, also if one of the two shows nothing."""
    options = resolve_options(CompareOptions, options, values)
    outputs = Outputs.of(None, report=out)
    outputs.check()
    outputs.check_sources(reference, candidate)
    with outputs.held():
        reading = options.asset.arguments() | {"keep_rig": options.clip is not None}
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
        moving, motion = (first, second), None
        if options.clip is None:
            result = _compare(first, second, options)
        else:
            result, first, second = _compare_frames(first, second, options)
        if outputs.report is not None:
            points = np.concatenate([first.points(), second.points()])
            placement = Placement.around(points)
            if options.clip is not None:
                motion = _film(*moving, options.clip, result)
            write_compare_report(outputs.report, first, second, placement, result, options, motion)
    apart = _apart(first, second)
    told = (*first.notes, *second.notes, *apart, *_drawn_otherwise(first, second))
    return replace(result, notes=(*told, *result.notes))


def _compare(first: Asset, second: Asset, options: CompareOptions) -> Comparison:
    """Both as they stand."""
    points = np.concatenate([first.points(), second.points()])
    placement = Placement.around(points)
    sampler = views_around(placement.to_local(points), options.seed).held_out(MEASURED)
    try:
        return compare_local(placement.local(first), placement.local(second), sampler, options)
    except InputError as error:
        # of two small things far from each other, pictures may show neither
        raise InputError("; ".join([str(error), *_apart(first, second)])) from error


def _compare_frames(
    first: Asset, second: Asset, options: CompareOptions
) -> tuple[Comparison, Asset, Asset]:
    """Both at frames of a clip, a view of each; and as they stand at the worst one. Raises
    InputError for a clip that one of the two does not have."""
    assert options.clip is not None
    for asset in (first, second):
        if asset.rig is None:
            raise InputError(f"{asset.name}: there is no animation in it; leave --clip out")
    assert first.rig is not None and second.rig is not None
    clip = first.rig.clip(options.clip)
    second.rig.clip(options.clip)
    times = np.linspace(clip.start, clip.end, options.views)
    if options.frame is not None:
        times = np.full(options.views, options.frame / first.rig.rate)
    each = []
    for k, time in enumerate(times.tolist()):
        a, b = (pose_asset(x, options.clip, time) for x in (first, second))
        one = replace(options, views=1, clip=None, frame=None, seed=options.seed + k)
        each.append(_compare(a, b, one))
    images = (np.concatenate([getattr(c, n) for c in each]) for n in ("reference", "candidate"))
    reference, candidate = images
    frames = tuple(
        (float(t) * first.rig.rate, c.metrics.psnr_covered)
        for t, c in zip(times, each, strict=True)
    )
    worst = times[int(np.argmin([psnr for _, psnr in frames]))]
    notes = tuple(dict.fromkeys(note for c in each for note in c.notes))
    result = Comparison(compare_images(reference, candidate), reference, candidate, notes, frames)
    a, b = (pose_asset(x, options.clip, float(worst)) for x in (first, second))
    return result, a, b


def _film(first: Asset, second: Asset, clip: str, result: Comparison) -> Motion:
    """Both over a clip, with the errors that were measured."""
    assert first.rig is not None
    numbers, psnr = zip(*result.frames, strict=True)
    worst = numbers[int(np.argmin(psnr))] / first.rig.rate
    names = [f"{clip} {n:g}" for n in numbers]
    return show_motion(first, second, clip, worst, names, {"candidate": psnr})


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
