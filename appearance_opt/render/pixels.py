"""The pixels of a batch of images, from where they are seen, and in which of them samples lie."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

# not only for the type checker: Dr.Jit resolves the annotations of data classes when it looks for
# arrays
from appearance_opt.render.samples import Samples

TILE = 4
"""Rays are ordered in tiles of 4 x 4 pixels: neighbours in the wavefront are neighbours in the
image, which makes tracing faster than scan lines (docs/trials.md: kernels)."""


@dataclass(eq=False)
class Grid:
    """The pixels of a batch of square images, on the device, tile by tile (see ``TILE``).

    ``size``, ``rows``: the resolution as opaque numbers, so that another one compiles no new
    kernel. ``view``, ``column``, ``row``: of every pixel. Made once and reused by every step.
    """

    views: int
    resolution: int
    size: mi.Float = field(init=False)
    rows: mi.UInt32 = field(init=False)
    view: mi.UInt32 = field(init=False)
    column: mi.UInt32 = field(init=False)
    row: mi.UInt32 = field(init=False)

    def __post_init__(self) -> None:
        self.size = dr.opaque(mi.Float, self.resolution)
        self.rows = dr.opaque(mi.UInt32, self.resolution)
        self.view, self.column, self.row = pixel_grid(self.views, self.resolution)
        dr.eval(self.view, self.column, self.row)
        self._finer: dict[int, Grid] = {}

    def finer(self, factor: int) -> Grid:
        """Return ``factor`` squared points in every pixel, as a grid of their own; made when first
        asked for."""
        if factor == 1:
            return self
        if factor not in self._finer:
            self._finer[factor] = Grid(self.views, self.resolution * factor)
        return self._finer[factor]

    @property
    def pixels(self) -> int:
        """Pixels of the whole batch."""
        return self.views * self.resolution * self.resolution

    @property
    def index(self) -> mi.UInt32:
        """Index in the batch of every pixel: (view, row, column), row major."""
        return (self.view * self.rows + self.row) * self.rows + self.column


@dataclass(frozen=True, eq=False)
class Batch:
    """From where images are seen, and their pixels. ``records``: see ``Views.records``."""

    records: mi.Float
    grid: Grid


def pixel_grid(views: int, resolution: int) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
    """List (view, column, row) of every pixel of a batch, tile by tile."""
    padded = -(-resolution // TILE)
    i = dr.arange(mi.UInt32, views * padded * padded * TILE * TILE)
    inside = i & (TILE * TILE - 1)
    tile = i // (TILE * TILE)
    view = tile // (padded * padded)
    tile -= view * (padded * padded)
    column = (tile % padded) * TILE + (inside & (TILE - 1))
    row = (tile // padded) * TILE + inside // TILE
    if resolution % TILE == 0:
        return view, column, row
    keep = dr.compress((column < resolution) & (row < resolution))
    return (
        dr.gather(mi.UInt32, view, keep),
        dr.gather(mi.UInt32, column, keep),
        dr.gather(mi.UInt32, row, keep),
    )


def add_colors(
    image: mi.Float, color: mi.Color3f, weight: mi.Float, pixel: mi.UInt32, mode: dr.ReduceMode
) -> None:
    """Add radiance and coverage of samples to an image (pixels * 4), in place: each ``weight`` of
    its pixel."""
    value = mi.ArrayXf([color.x * weight, color.y * weight, color.z * weight, weight])
    dr.scatter_reduce(dr.ReduceOp.Add, image, value, pixel, mode=mode)


def pixel_index(samples: Samples, resolution: mi.UInt32) -> mi.UInt32:
    """Return the index of the pixel of each sample in the batch: (view, row, column), row major."""
    column, row = mi.UInt32(samples.x), mi.UInt32(samples.y)
    return (samples.view * resolution + row) * resolution + column
