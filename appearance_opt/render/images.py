"""Samples to pixels: whole batches of images, without gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import drjit as dr
import mitsuba as mi

from appearance_opt.render import outlines, rays
from appearance_opt.render.freezing import traced
from appearance_opt.render.lattice import sub_pixel_offsets
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import add_colors, pixel_index
from appearance_opt.render.shading import shade
from appearance_opt.render.visibility import Visible, see_grid

if TYPE_CHECKING:
    from appearance_opt.render.drawn import Drawn, Shown
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.pixels import Batch
    from appearance_opt.render.samples import Samples


class Renderer(Protocol):
    """What draws whole images: this module, or ``layers.SeenThrough``."""

    def render_image(
        self,
        drawn: Drawn,
        batch: Batch,
        samples: int,
        width: float | None = None,
        run: Run = traced,
    ) -> mi.Float:
        """See ``images.render_image``."""
        ...

    def render_pair(
        self, drawn: Drawn, batch: Batch, samples: int, width: float, run: Run = traced
    ) -> tuple[mi.Float, mi.Float]:
        """See ``images.render_pair``."""
        ...


@dataclass(frozen=True)
class Footprint:
    """What a sample stands for: its ``weight``, a share of its pixel, and the ``width`` in pixels
    over which textures are filtered."""

    weight: mi.Float
    width: mi.Float

    @classmethod
    def of(cls, samples: int, width: float | None = None) -> Footprint:
        """That of each of ``samples`` in a pixel; ``width``: as for ``render_image``."""
        if width is None:
            width = 1.0 if samples == 1 else 0.0
        return cls(dr.opaque(mi.Float, 1 / samples), dr.opaque(mi.Float, width))


class Resolve(Protocol):
    """How what rays see gets into the image."""

    def __call__(
        self,
        image: mi.Float,
        drawn: Drawn,
        batch: Batch,
        seen: Visible,
        footprint: Footprint,
        run: Run,
    ) -> mi.Float:
        """Add to the image (pixels * 4) what one ray in every pixel has ``seen``."""
        ...


def add_first(
    image: mi.Float, drawn: Drawn, batch: Batch, seen: Visible, footprint: Footprint, run: Run
) -> mi.Float:
    """Add what rays meet first. See ``Resolve``."""
    shaded = seen.samples, dr.compress(seen.hit)
    # one sample per pixel: no two threads meet
    return _add_shaded(image, drawn.shown, batch, shaded, footprint, dr.ReduceMode.NoConflicts, run)


def render_image(
    drawn: Drawn,
    batch: Batch,
    samples: int,
    width: float | None = None,
    run: Run = traced,
    resolve: Resolve = add_first,
) -> mi.Float:
    """Draw a whole batch of images with ``samples`` samples in every pixel, without gradients.
    Textures are filtered over ``width`` pixels; by default over the whole pixel where it has one
    sample, and by the samples alone where it has several: mip levels of normal maps are flatter
    than what they stand for, and shine in other places. ``run``: how its stages are called (see
    ``freezing``).

    Returns (pixels * 4) premultiplied linear radiance and coverage. One sample of all pixels at a
    time, so that memory does not grow with ``samples``.
    """
    footprint = Footprint.of(samples, width)
    image = dr.zeros(mi.Float, batch.grid.pixels * 4)
    for dx, dy in sub_pixel_offsets(samples):
        image = resolve(image, drawn, batch, see_grid(drawn, batch, dx, dy, run), footprint, run)
    return image


def render_pair(
    drawn: Drawn, batch: Batch, samples: int, width: float, run: Run = traced
) -> tuple[mi.Float, mi.Float]:
    """Draw (average, points): two images of the same views. ``points`` is what the ray through the
    middle of each pixel sees, textures filtered over ``width`` pixels; ``average`` is the same away
    from outlines, and the mean of ``samples`` rays at them. Costs a fraction of ``samples`` full
    images. ``run``: as in ``render_image``."""
    seen = see_grid(drawn, batch, 0.5, 0.5, run)
    points = dr.zeros(mi.Float, batch.grid.pixels * 4)
    points = add_first(points, drawn, batch, seen, Footprint.of(1, width), run)
    average, outlined = run(_without_outlines, points, seen, batch)
    dr.eval(average, outlined)
    index = dr.compress(outlined)
    if dr.width(index):
        fine, hit = rays.trace_pixels(drawn.scene, batch, index, samples, run)
        footprint, mode = Footprint.of(samples, samples**-0.5), dr.ReduceMode.Local
        shaded = fine, dr.compress(hit)
        average = _add_shaded(average, drawn.shown, batch, shaded, footprint, mode, run)
    return average, points


def _without_outlines(points: mi.Float, seen: Visible, batch: Batch) -> tuple[mi.Float, mi.Bool]:
    """(the image ``points`` with zeros in the pixels at outlines, whether the pixel of each sample
    that is ``seen`` is one)."""
    pixels, pixel = batch.grid.pixels, pixel_index(seen.samples, batch.grid.rows)
    far = dr.select(seen.samples.triangle == MISS, mi.Float(outlines.NOTHING), seen.depth)
    outlined = outlines.find(far, pixel, batch.grid.rows, pixels)
    image = dr.select(
        dr.gather(mi.Bool, outlined, dr.arange(mi.UInt32, pixels * 4) // 4), 0, points
    )
    return image, dr.gather(mi.Bool, outlined, pixel)


def _add_shaded(
    image: mi.Float,
    shown: Shown,
    batch: Batch,
    shaded: tuple[Samples, mi.UInt32],
    footprint: Footprint,
    mode: dr.ReduceMode,
    run: Run,
) -> mi.Float:
    """An image (pixels * 4) and the radiance and coverage of ``shaded``: samples, and the positions
    in their list of those that count."""
    if dr.width(shaded[1]) == 0:
        return image
    out = run(_accumulate, image, shown, batch, shaded, footprint, mode)
    dr.eval(out)
    return out


def _accumulate(
    image: mi.Float,
    shown: Shown,
    batch: Batch,
    shaded: tuple[Samples, mi.UInt32],
    footprint: Footprint,
    mode: dr.ReduceMode,
) -> mi.Float:
    some = shaded[0].keep(shaded[1])
    color, out = shade(shown, batch, some, footprint.width), mi.Float(image)
    add_colors(out, color, footprint.weight, pixel_index(some, batch.grid.rows), mode)
    return out
