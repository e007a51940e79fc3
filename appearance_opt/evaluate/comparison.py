"""Two assets side by side: their images from the same views under the same lights, and the
difference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from appearance_opt.errors import InputError
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.pool import check_images

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.evaluate.metrics import Metrics
    from appearance_opt.views import Views, ViewSampler


@dataclass
class Comparison:
    """``metrics`` over the views; images (B, H, W, 4) premultiplied linear radiance and coverage;
    ``notes``: what the loader dropped, repaired or assumed."""

    metrics: Metrics
    reference: NDArray[np.float32]
    candidate: NDArray[np.float32]
    notes: tuple[str, ...] = ()


def compare_local(
    reference: Asset,
    candidate: Asset,
    sampler: ViewSampler,
    views: int,
    resolution: int,
    samples: int,
) -> Comparison:
    """Measure how different two assets look, which lie around the origin as the sampler asks.
    Raises InputError if one of the two shows nothing."""
    drawn = sampler.draw(0, views)
    first, second = (render_asset(a, drawn, resolution, samples) for a in (reference, candidate))
    for name, image, side in (
        (reference.name, first, "reference"),
        (candidate.name, second, "candidate"),
    ):
        if not image[..., 3].any():
            raise InputError(
                f"{name}: nothing of it is seen in any of the {views} views, so that there is nothing to compare; "
                f"is the {side} far smaller than the other, inside out, or altogether transparent?"
            )
    return Comparison(compare_images(first, second), first, second)


def render_asset(asset: Asset, views: Views, resolution: int, samples: int) -> NDArray[np.float32]:
    """Images (B, H, W, 4) of an asset; the device memory of its textures is released afterwards."""
    return check_images(
        MeshReference(asset).render(views, resolution, samples), len(views), resolution, asset.name
    )
