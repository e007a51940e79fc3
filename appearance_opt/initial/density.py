"""Texels go where they are seen to be missing.

How much detail a chart holds, how glossy it is and how often it is looked at differ by orders of
magnitude between the parts of an asset. So the mesh is drawn with its maps and with the same maps
at half the resolution; what that costs in the image is summed over each chart, and charts that it
costs more than others get more texels.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from appearance_opt.initial.atlas import charts_of, uv_areas
from appearance_opt.latent.mesh import LatentTopology
from appearance_opt.latent.texels import maps_of
from appearance_opt.render import rays
from appearance_opt.render.display import display
from appearance_opt.render.images import render_image
from appearance_opt.render.material import CHANNELS
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, Grid

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.render.drawn import Drawn
    from appearance_opt.views import Sampler

BATCHES, BATCH, RESOLUTION, SAMPLES = 4, 8, 256, 4
"""Views in which the loss is measured, and how."""

POWER, SMALLEST, LARGEST = 0.25, 0.4, 2.5
"""Scale of a chart = (loss per texel)^POWER, within bounds. If halving the texels' length quarters
the error, the sum of all errors is least at this power: errors e s^-2 under a fixed sum of n s^2
ask for s = (e / n)^(1/4)."""

UNSEEN = 1e-3
"""Loss per texel that every chart has, relative to the mean: views are few, and miss some."""


def chart_scales(
    mesh: LatentMesh, maps: Mapping[str, NDArray | float], sampler: Sampler
) -> NDArray[np.float64]:
    """(F,) how much longer and wider each face's chart should be than it is in the atlas of
    ``mesh``, relative to the others. ``maps``: (size, size), or a number, by channel name, in
    natural units; ``sampler``: views and lights."""
    chart = charts_of(mesh)
    texels = np.bincount(chart, uv_areas(mesh))
    loss = np.bincount(chart, _loss_of_half(mesh, maps, sampler))
    if not loss.any():
        return np.ones(len(chart))
    per_texel = loss / np.maximum(texels, 1e-12) + UNSEEN * loss.sum() / texels.sum()
    scale = per_texel**POWER
    scale /= np.exp(np.average(np.log(scale), weights=texels))
    return np.clip(scale, SMALLEST, LARGEST)[chart]


def _loss_of_half(
    mesh: LatentMesh, maps: Mapping[str, NDArray | float], sampler: Sampler
) -> NDArray[np.float64]:
    """(F,) squared display error that maps at half the resolution make, over the pixels that show
    each face."""
    drawn = LatentTopology(mesh, tangents="normal_x" in maps).drawn(maps_of(maps))
    half = {n: halve(np.asarray(v)) if np.ndim(v) and n in CHANNELS else v for n, v in maps.items()}
    both = drawn, replace(drawn, maps=maps_of(half))
    grid, out = Grid(BATCH, RESOLUTION), np.zeros(len(mesh.faces))
    pixel = np.array(grid.index)
    for k in range(BATCHES):
        batch = Batch(sampler.draw(k, BATCH).records(), grid)
        fine, coarse = (display(_image(d, batch)) for d in both)
        error = np.mean((fine - coarse) ** 2, axis=-1).ravel()
        face = np.array(rays.trace_grid(drawn.scene, batch)[0].triangle)
        seen = face != MISS
        out += np.bincount(face[seen], error[pixel[seen]], len(out))
    return out


def _image(drawn: Drawn, batch: Batch) -> NDArray[np.float32]:
    with dr.suspend_grad():
        image = render_image(drawn, batch, SAMPLES)
    grid = batch.grid
    return np.array(image).reshape(grid.views, grid.resolution, grid.resolution, 4)


def halve(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) with even sides: averaged over 2 x 2 texels and read again bilinearly."""
    h, w = image.shape
    half = image.reshape(h // 2, 2, w // 2, 2).mean(axis=(1, 3))
    for axis in (0, 1):
        x = np.moveaxis(
            np.pad(half, [(1, 1) if k == axis else (0, 0) for k in (0, 1)], mode="edge"), axis, 0
        )
        pair = np.stack([0.75 * x[1:-1] + 0.25 * x[:-2], 0.75 * x[1:-1] + 0.25 * x[2:]], axis=1)
        half = np.moveaxis(pair.reshape(-1, x.shape[1]), 0, axis)
    return half.astype(np.float32)
