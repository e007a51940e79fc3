"""Lists of camera rays, what they hit, and their shares of the pixels."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Samples:
    """A list of M camera rays and what they hit.

    ``view``: index into the batch; ``x``, ``y``: position in pixels, y down; ``triangle``: index or
    ``MISS``. The pixel is floor(x), floor(y).
    """

    view: mi.UInt32
    x: mi.Float
    y: mi.Float
    triangle: mi.UInt32

    def keep(self, index: mi.UInt32) -> Samples:
        """Take the samples at the given positions of the list."""
        return Samples(
            dr.gather(mi.UInt32, self.view, index),
            dr.gather(mi.Float, self.x, index),
            dr.gather(mi.Float, self.y, index),
            dr.gather(mi.UInt32, self.triangle, index),
        )


@dataclass
class Weighted:
    """Covered camera rays, the ``pixel`` of each and its ``weight`` there, and their ``width`` in
    pixels, which selects mip levels.

    ``behind``: what is seen behind each, premultiplied RGB and coverage, if the surface is seen
    through (``weight`` is then that of the light that reaches it); None where nothing is."""

    samples: Samples
    pixel: mi.UInt32
    weight: mi.Float
    width: mi.Float
    behind: mi.ArrayXf | None = None


@dataclass
class Whole:
    """Pixels all of whose camera rays are covered: the first ray of every ``pixel``, the second,
    and so on, each worth the same, and their ``width`` in pixels."""

    rays: list[Samples]
    pixel: mi.UInt32
    width: mi.Float


def concat(parts: list[Samples]) -> Samples:
    """Put lists of samples one after the other."""
    if len(parts) == 1:
        return parts[0]
    return Samples(
        *(join_arrays([getattr(p, f) for p in parts]) for f in ("view", "x", "y", "triangle"))
    )


def join_arrays(parts: list[mi.Float]) -> mi.Float:
    """Put arrays one after the other. ``dr.concat`` would write their widths, which change every
    step, into the kernel and so compile one every step."""
    out = dr.empty(type(parts[0]), sum(dr.width(p) for p in parts))
    offset = 0
    for part in parts:
        index = dr.arange(mi.UInt32, dr.width(part)) + dr.opaque(mi.UInt32, offset)
        dr.scatter(out, part, index, mode=dr.ReduceMode.Permute)
        offset += dr.width(part)
    return out
