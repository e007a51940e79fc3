"""Pixels at the outlines of what an image shows, by jumps of its depth."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

DISCONTINUITY = 1.02
"""Ratio of depths between neighbouring pixels from which an outline may pass between them."""

REACH = 1
"""Pixels beyond the two at a jump that count as being at an outline: that of a fitted shape lies a
little away."""

NOTHING = 1e30
"""Depth of pixels that show nothing."""


def find(depth: mi.Float, pixel: mi.UInt32, rows: mi.UInt32, pixels: int) -> mi.Bool:
    """Mark (pixels,) which pixels are at an outline. ``depth`` of every pixel, of which ``pixel``
    is the index in the batch: (view, row, column) of images of ``rows`` rows and columns."""
    image = dr.empty(mi.Float, pixels)
    dr.scatter(image, depth, pixel, mode=dr.ReduceMode.Permute)
    dr.eval(image)
    batch = _Neighbourhood(rows, pixels)
    return batch.grown(_jumps(image, batch), REACH)


def _jumps(depth: mi.Float, batch: _Neighbourhood) -> mi.Bool:
    """Pixels beside a jump in depth or a border of the object. Only neighbours in a row or column
    are compared: further apart, the depths of any slanted surface differ."""
    nearest = farthest = depth
    for axis in (0, 1):
        for neighbour in batch.neighbours(axis, 1):
            beside = dr.gather(mi.Float, depth, neighbour)
            nearest, farthest = dr.fmin(nearest, beside), dr.fmax(farthest, beside)
    return farthest > DISCONTINUITY * nearest


class _Neighbourhood:
    """Who is whose neighbour among the pixels of a batch."""

    def __init__(self, rows: mi.UInt32, pixels: int) -> None:
        self.rows = rows
        self._index = dr.arange(mi.UInt32, pixels)
        line = self._index // rows
        self._axes = (self._index - line * rows, mi.UInt32(1)), (line % rows, rows)

    def neighbours(self, axis: int, away: int) -> tuple[mi.UInt32, mi.UInt32]:
        """The pixels ``away`` after and before each along an axis; itself beyond the border of the
        image."""
        i, (place, stride) = self._index, self._axes[axis]
        after = dr.select(place + away < self.rows, i + away * stride, i)
        return after, dr.select(place >= away, i - away * stride, i)

    def grown(self, marked: mi.Bool, reach: int) -> mi.Bool:
        """All pixels within squares of ``reach`` pixels around marked ones."""
        for axis in (0, 1):  # along rows first, then along columns
            dr.eval(marked)
            before = marked
            for away in range(1, reach + 1):
                for neighbour in self.neighbours(axis, away):
                    # no |=: it would change the array in place, which is the caller's
                    marked = marked | dr.gather(mi.Bool, before, neighbour)
        dr.eval(marked)
        return marked
