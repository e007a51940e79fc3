"""The pixels of a batch of images, and which of them a sample lies in."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from appearance_opt.render import rays
from appearance_opt.render.rays import Samples


class Grid:
    """The pixels of a batch of square images, on the device, tile by tile (see ``rays.TILE``).

    ``size``, ``rows``: the resolution as opaque numbers, so that another one compiles no new
    kernel. ``view``, ``column``, ``row``: of every pixel. Made once and reused by every step.
    """

    def __init__(self, views: int, resolution: int) -> None:
        self.views = views
        self.resolution = resolution
        self.size = dr.opaque(mi.Float, resolution)
        self.rows = dr.opaque(mi.UInt32, resolution)
        self.view, self.column, self.row = rays.pixel_grid(views, resolution)
        dr.eval(self.view, self.column, self.row)
        self._finer: dict[int, Grid] = {}

    def finer(self, factor: int) -> Grid:
        """``factor`` squared points in every pixel, as a grid of their own; made when first asked
        for."""
        if factor == 1:
            return self
        if factor not in self._finer:
            self._finer[factor] = Grid(self.views, self.resolution * factor)
        return self._finer[factor]

    @property
    def pixels(self) -> int:
        """Pixels of the whole batch."""
        return self.views * self.resolution * self.resolution


def pixel_index(samples: Samples, resolution: mi.UInt32) -> mi.UInt32:
    """Index of the pixel of each sample in the batch: (view, row, column), row major."""
    column, row = mi.UInt32(samples.x), mi.UInt32(samples.y)
    return (samples.view * resolution + row) * resolution + column
