"""What every pixel of a batch shows, by rays or by drawing, whichever is faster."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render import raster, rays
from appearance_opt.render.passing import MISS
from appearance_opt.render.samples import Samples

if TYPE_CHECKING:
    from appearance_opt.render.drawn import Drawn
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.pixels import Batch


@dataclass
class Visible:
    """What camera rays see: the ``samples``, their ``depth`` along the camera's forward direction
    (infinite for a miss), and whether each is a ``hit``."""

    samples: Samples
    depth: mi.Float
    hit: mi.Bool

    def keep(self, index: mi.UInt32) -> Visible:
        """Take those at the given positions of the list."""
        return Visible(
            self.samples.keep(index),
            dr.gather(mi.Float, self.depth, index),
            dr.gather(mi.Bool, self.hit, index),
        )


def see_grid(drawn: Drawn, batch: Batch, dx: float, dy: float, run: Run) -> Visible:
    """Find what one ray in every pixel sees, at the offset (dx, dy)."""
    offset = dr.opaque(mi.Float, dx), dr.opaque(mi.Float, dy)
    if raster.drawing_is_faster(drawn.surface, batch.grid):
        samples, depth = run(raster.draw_grid, drawn.surface, batch, *offset)
    else:
        samples, depth = run(rays.trace_grid, drawn.scene, batch, *offset)
    hit = samples.triangle != MISS
    dr.eval(samples, depth, hit)
    return Visible(samples, depth, hit)
