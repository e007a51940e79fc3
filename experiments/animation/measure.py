"""How alike two characters look over the frames of a clip: the same views of each frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.posing import pose_asset
from appearance_opt.evaluate.comparison import render_asset
from appearance_opt.evaluate.hero import hero_view
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.placement import Placement
from appearance_opt.views import MEASURED, support, views_around

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.evaluate.metrics import Metrics
    from appearance_opt.views import Views

SAMPLES = 9


@dataclass
class Take:
    """A heavy character at a frame: its ``placement``, the ``views`` of it, and their images."""

    clip: str | None
    time: float
    placement: Placement
    views: Views
    images: NDArray[np.float32]


def take(
    asset: Asset, clip: str | None, times: Sequence[float], views: int, resolution: int
) -> list[Take]:
    """The asset at ``times`` of a clip (seconds; None: at rest), in so many held-out views of
    each."""
    out = []
    for k, time in enumerate(times):
        posed = pose_asset(asset, clip, time)
        points = posed.points()
        placement = Placement.around(points)
        sampler = views_around(placement.to_local(points), 0).held_out(MEASURED)
        drawn = sampler.draw(k, views)
        images = render_asset(placement.local(posed), drawn, resolution, SAMPLES)
        out.append(Take(clip, time, placement, drawn, images))
    return out


def upright(asset: Asset, takes: Sequence[Take]) -> list[Take]:
    """The same frames of the asset, seen upright, all from one side."""
    local = [t.placement.local(pose_asset(asset, t.clip, t.time)) for t in takes]
    hull = support(np.concatenate([a.points() for a in local]))
    view = hero_view(hull, lambda v: render_asset(local[0], v, 96, 4))
    size = takes[0].images.shape[1]
    return [
        replace(t, views=view, images=render_asset(a, view, size, SAMPLES))
        for t, a in zip(takes, local, strict=True)
    ]


def images_of(asset: Asset, of: Take) -> NDArray[np.float32]:
    """The same pictures of another character."""
    posed = of.placement.local(pose_asset(asset, of.clip, of.time))
    return render_asset(posed, of.views, of.images.shape[1], SAMPLES)


def errors(asset: Asset, takes: Sequence[Take]) -> list[Metrics]:
    """Of each frame."""
    return [compare_images(t.images, images_of(asset, t)) for t in takes]


def summary(metrics: Sequence[Metrics]) -> dict[str, float]:
    """Means over frames, and PSNR (dB, covered pixels) of the best and the worst one."""
    psnr = [m.psnr_covered for m in metrics]
    return {
        "psnr": float(np.mean(psnr)),
        "worst": float(np.min(psnr)),
        "best": float(np.max(psnr)),
        "flip": float(np.mean([m.flip for m in metrics])),
        "shift": float(np.mean([m.silhouette_shift for m in metrics])),
    }
