"""Images of surfaces that are seen through others: the layers along each ray, blended from the eye
on.

Every material keeps back a share of what lies behind it, its coverage: that of cut-outs is 0 or 1.
A ray that is not kept back altogether goes on behind what it met. Colours are blended with the
"over" operator (Porter and Duff 1984), in linear radiance, so that coverage in the image becomes
fractional. Without gradients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render import images
from appearance_opt.render.camera import camera_of, direction
from appearance_opt.render.freezing import traced

# not only for the type checker: Dr.Jit resolves the annotations of data classes when it looks for
# arrays
from appearance_opt.render.material import Coverage
from appearance_opt.render.passing import MISS, meet
from appearance_opt.render.pixels import add_colors, pixel_index
from appearance_opt.render.samples import Samples
from appearance_opt.render.shading import shade
from appearance_opt.render.surface import interpolate
from appearance_opt.render.visibility import Visible

if TYPE_CHECKING:
    from appearance_opt.render.drawn import Drawn, Shown
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.images import Footprint, Renderer
    from appearance_opt.render.passing import Scene
    from appearance_opt.render.pixels import Batch

MOST = 128
"""Layers that a ray is followed through, empty parts of cut-outs included. What lies behind is not
drawn: the light that is left counts as background."""

LEAST = 1 / 1024
"""Share of a ray that is not worth following: a quarter of an 8-bit step."""

CHANNELS = ("coverage", "cutoff")
"""Channels of the maps of coverage of a reference, see ``Coverage``."""


@dataclass(frozen=True)
class SeenThrough:
    """An ``images.Renderer`` of surfaces that are seen through, by what each keeps back."""

    coverage: Coverage

    def render_image(
        self,
        drawn: Drawn,
        batch: Batch,
        samples: int,
        width: float | None = None,
        run: Run = traced,
    ) -> mi.Float:
        """See ``images.render_image``. Memory grows neither with ``samples`` nor with the
        layers."""
        return images.render_image(drawn, batch, samples, width, run, self.add_layers)

    def render_pair(
        self, drawn: Drawn, batch: Batch, samples: int, width: float, run: Run = traced
    ) -> tuple[mi.Float, mi.Float]:
        """See ``images.render_pair``. The average is one everywhere: outlines of what is seen
        through may lie anywhere."""
        average = self.render_image(drawn, batch, samples, None, run)
        return average, self.render_image(drawn, batch, 1, width, run)

    def add_layers(
        self,
        image: mi.Float,
        drawn: Drawn,
        batch: Batch,
        seen: Visible,
        footprint: Footprint,
        run: Run,
    ) -> mi.Float:
        """Add all layers along the rays, from the eye on; see ``images.Resolve``. Rays whose light
        is used up take no part in further layers."""
        shown, light = drawn.shown, dr.ones(mi.Float, dr.width(seen.depth))
        dr.eval(light)
        for _ in range(MOST):
            going = dr.compress(seen.hit & (light >= LEAST))
            if dr.width(going) == 0:
                break
            seen, light = seen.keep(going), dr.gather(mi.Float, light, going)
            dr.eval(seen, light)
            share = run(_kept_back, shown, batch, self.coverage, seen.samples, light, footprint)
            dr.eval(share)
            some = dr.compress(share > 0)  # only those are shaded that keep anything back
            if dr.width(some):
                layer = seen.samples, some, share
                image = run(_accumulate, image, shown, batch, layer, footprint)
                dr.eval(image)
            light = light - share
            left = dr.compress(light >= LEAST)
            if dr.width(left) == 0:
                break
            seen, light = seen.keep(left), dr.gather(mi.Float, light, left)
            dr.eval(seen, light)
            seen = run(behind, drawn.scene, batch, seen)
            dr.eval(seen)
        return image


def renderer_of(coverage: Coverage | None) -> Renderer:
    """Return what draws a surface that keeps back so much (None: all) of the light behind it."""
    return images if coverage is None else SeenThrough(coverage)


def _kept_back(
    shown: Shown,
    batch: Batch,
    coverage: Coverage,
    hits: Samples,
    light: mi.Float,
    footprint: Footprint,
) -> mi.Float:
    """What hits keep back of the ``light`` of their rays."""
    camera = camera_of(batch.records, hits.view)
    hit = interpolate(shown.surface, camera, hits, batch.grid.size, footprint.width)
    return coverage.at(hit) * light


def _accumulate(
    image: mi.Float,
    shown: Shown,
    batch: Batch,
    layer: tuple[Samples, mi.UInt32, mi.Float],
    footprint: Footprint,
) -> mi.Float:
    """The image with a ``layer``, one sample at most per pixel: samples, the positions in their
    list of those that count, and the share of its ray's light that each of the list keeps back."""
    samples, index, share = layer
    some = samples.keep(index)
    color, out = shade(shown, batch, some, footprint.width), mi.Float(image)
    part = dr.gather(mi.Float, share, index) * footprint.weight
    pixel = pixel_index(some, batch.grid.rows)
    add_colors(out, color, part, pixel, dr.ReduceMode.NoConflicts)
    return out


def behind(scene: Scene, batch: Batch, seen: Visible) -> Visible:
    """Find what rays meet behind what they have ``seen``, which must be hits."""
    hits = seen.samples
    camera = camera_of(batch.records, hits.view)
    d = direction(camera, hits.x, hits.y, batch.grid.size)
    length = dr.norm(d)
    ray = mi.Ray3f(camera.eye, d / length)
    met = meet(scene, ray, after=seen.depth * length, coherent=True)
    samples = Samples(hits.view, hits.x, hits.y, met.triangle)
    return Visible(samples, met.t / length, met.triangle != MISS)
