"""Two assets, the same views and lights: how different do they look?"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt import backend
from appearance_opt.asset.alpha import kind_of
from appearance_opt.config import DEVICES
from appearance_opt.errors import InputError
from appearance_opt.jobs.paths import Outputs

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.companions import MissingTextures
    from appearance_opt.asset.types import Asset
    from appearance_opt.evaluate.metrics import Metrics
    from appearance_opt.views import Views, ViewSampler


@dataclass
class Comparison:
    """``metrics`` over the views; images (B, H, W, 4) premultiplied linear radiance and coverage; ``notes``: what the
    loader dropped, repaired or assumed."""

    metrics: Metrics
    reference: NDArray[np.float32]
    candidate: NDArray[np.float32]
    notes: tuple[str, ...] = ()


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
    """Render both assets from ``views`` random cameras under random lights and measure the difference.
    ``out``: folder for a report with pictures. ``refine``, ``missing_textures``, ``root``, ``crease_angle``: see
    ``load``; ``variants``: of the reference. What is transparent is drawn so (see ``render.layers``). Raises
    AppearanceError, also if one of the two shows nothing."""
    if device not in DEVICES:
        raise InputError(f"--device {device}: choose from {', '.join(DEVICES)}")
    if seed < 0:
        raise InputError(f"--seed {seed}: must be 0 or more")
    outputs = Outputs.of(None, report=out)
    outputs.check()
    outputs.check_sources(reference, candidate)
    reading = {"refine": refine, "missing_textures": missing_textures, "root": root, "crease_angle": crease_angle}
    with outputs.held():
        given = ((reference, {**reading, "variants": variants}), (candidate, reading))
        return _compared(given, outputs, (views, resolution, samples, seed, device))


def _compared(
    both: tuple[tuple[str | Path | Asset, dict[str, Any]], tuple[str | Path | Asset, dict[str, Any]]],
    outputs: Outputs,
    drawing: tuple[int, int, int, int, str],
) -> Comparison:
    """``both``: each with how it is to be read; ``drawing``: views, resolution, samples, seed, device."""
    from appearance_opt.asset import load
    from appearance_opt.asset.types import Asset

    views, resolution, samples, seed, device = drawing
    first, second = (a if isinstance(a, Asset) else load(a, **reading) for a, reading in both)
    outputs.check_inputs(first, second)
    outputs.check_room(0, None)
    backend.select(device)
    from appearance_opt.jobs.simplify import framed, in_frame
    from appearance_opt.views import MEASURED

    frame, sampler = framed(np.concatenate([first.points(), second.points()]), seed)
    sampler = sampler.held_out(MEASURED)
    apart = _apart(first, second)
    in_one = in_frame(first, *frame), in_frame(second, *frame)
    try:
        result = compare_in_frame(*in_one, sampler, views, resolution, samples)
    except InputError as error:  # of two small things far from each other, pictures may show neither
        raise InputError("; ".join([str(error), *apart])) from error
    if outputs.report is not None:
        from appearance_opt.jobs.report import write_compare_report

        write_compare_report(outputs.report, first, second, result)
    return replace(result, notes=(*first.notes, *second.notes, *apart, *_drawn_otherwise(first, second)))


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
    return ["transmission is drawn like blended alpha: nothing is refracted, coloured inside or blurred"]


def compare_in_frame(
    reference: Asset, candidate: Asset, sampler: ViewSampler, views: int, resolution: int, samples: int
) -> Comparison:
    """The same for assets that lie in the sampler's frame."""
    from appearance_opt.evaluate.metrics import compare_images

    drawn = sampler.draw(0, views)
    first, second = (render_asset(a, drawn, resolution, samples) for a in (reference, candidate))
    for name, image, side in ((reference.name, first, "reference"), (candidate.name, second, "candidate")):
        if not image[..., 3].any():
            raise InputError(
                f"{name}: nothing of it is seen in any of the {views} views, so that there is nothing to compare; "
                f"is the {side} far smaller than the other, inside out, or altogether transparent?"
            )
    return Comparison(compare_images(first, second), first, second)


def render_asset(asset: Asset, views: Views, resolution: int, samples: int) -> NDArray[np.float32]:
    """Images (B, H, W, 4) of an asset; the device memory of its textures is released afterwards."""
    from appearance_opt.reference.mesh import MeshReference
    from appearance_opt.reference.pool import checked

    return checked(MeshReference(asset).render(views, resolution, samples), len(views), resolution, asset.name)
