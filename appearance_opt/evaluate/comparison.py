"""Two assets side by side: their images from the same views under the same lights, and the
difference."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from appearance_opt.errors import InputError
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.pool import check_images

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.config import CompareOptions
    from appearance_opt.evaluate.metrics import Metrics
    from appearance_opt.views import Sampler, Views


@dataclass
class Comparison:
    """``metrics`` over the views; images (B, H, W, 4) premultiplied linear radiance and coverage;
    ``notes``: what the loader dropped, repaired or assumed; ``frames``: of an animation, the frame
    of each view and its PSNR over covered pixels in dB."""

    metrics: Metrics
    reference: NDArray[np.float32]
    candidate: NDArray[np.float32]
    notes: tuple[str, ...] = ()
    frames: tuple[tuple[float, float], ...] = ()

    def lines(self) -> list[str]:
        """The metrics for a terminal."""
        m = self.metrics
        return [
            f"PSNR, covered pixels  {m.psnr_covered:7.2f} dB",
            f"PSNR, whole image     {m.psnr:7.2f} dB",
            f"FLIP                  {m.flip:7.4f}",
            f"pixels noticed        {100 * m.noticed:7.2f} %",
            f"silhouette IoU        {m.silhouette_iou:7.4f}",
            f"silhouette shift      {m.silhouette_shift:7.3f} px",
            *(f"PSNR at frame {f:<8g}{psnr:7.2f} dB" for f, psnr in self.frames),
        ]

    def record(self) -> dict[str, Any]:
        """The metrics for JSON."""
        return asdict(self.metrics) | ({"frames": self.frames} if self.frames else {})


def compare_local(
    reference: Asset, candidate: Asset, sampler: Sampler, options: CompareOptions
) -> Comparison:
    """Measure how different two assets look, which lie around the origin as the sampler asks.
    Raises InputError if one of the two shows nothing, BackendError if the path tracer does not
    run here."""
    drawn = sampler.draw(0, options.views)
    (first, told), (second, more) = (_draw(a, drawn, options) for a in (reference, candidate))
    for name, image, side in (
        (reference.name, first, "reference"),
        (candidate.name, second, "candidate"),
    ):
        if not image[..., 3].any():
            raise InputError(
                f"{name}: nothing of it is seen in any of the {options.views} views, so that "
                f"there is nothing to compare; is the {side} far smaller than the other, inside "
                "out, or altogether transparent?"
            )
    notes = tuple(dict.fromkeys((*told, *more)))
    return Comparison(compare_images(first, second), first, second, notes)


MANY_SAMPLES, SAMPLES = 64, 16
"""Rays per pixel where nothing is asked for: under an environment or by paths, and else."""


def _draw(
    asset: Asset, views: Views, options: CompareOptions
) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """(images, notes)"""
    from appearance_opt.evaluate.environment import distant_lights, render_environment

    environment, traced = options.light == "environment", options.renderer == "path"
    samples = options.samples or (MANY_SAMPLES if environment or traced else SAMPLES)
    notes: tuple[str, ...] = ()
    if traced:
        from appearance_opt.evaluate.path_traced import PathTraced

        tracer = PathTraced(asset, environment)
        notes, images = tracer.notes, tracer.render(views, options.resolution, samples)
    elif environment:
        images = render_environment(asset, views, options.resolution, distant_lights(samples))
    else:
        return render_asset(asset, views, options.resolution, samples), ()
    return check_images(images, len(views), options.resolution, asset.name), notes


def render_asset(asset: Asset, views: Views, resolution: int, samples: int) -> NDArray[np.float32]:
    """Images (B, H, W, 4) of an asset; the device memory of its textures is released afterwards."""
    return check_images(
        MeshReference(asset).render(views, resolution, samples), len(views), resolution, asset.name
    )
