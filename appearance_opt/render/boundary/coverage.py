"""Exact coverage of pixels that a silhouette crosses.

The derivative of a loss is only as good as the image it is taken at, and a few rays per pixel know
the covered area of a pixel badly. The silhouette points know the line that bounds it. The area on
its inner side is known in closed form, and so is the share of the pixel's rays that lies there:
their difference, times the contrast across the line, is what the rays missed (a control variate).
It has no bias for any line, so that a pixel with several silhouettes, or a bent one, is no worse
off than with the rays alone. Only where the sum leaves what an image can be (negative radiance,
coverage outside of [0, 1]) is it brought back, which is always nearer to the truth.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from appearance_opt.render.lattice import sub_pixel_offsets
from appearance_opt.render.math import at_least, at_most


def half_plane_area(nx: mi.Float, ny: mi.Float, distance: mi.Float) -> mi.Float:
    """Return the area of the part of the unit square about the origin where n . p < distance, for a
    unit vector n."""
    a, b = dr.abs(nx), dr.abs(ny)
    t = dr.abs(distance)
    wide, narrow = dr.fmax(a, b), dr.fmin(a, b)
    corner = at_least(0.5 * (a + b) - t, 0)
    # beyond the nearer corner the line leaves a triangle, before it a trapezoid
    triangle = dr.square(corner) / at_least(2 * a * b, 1e-12)
    beyond = dr.select(t < 0.5 * (wide - narrow), 0.5 - t / wide, triangle)
    return dr.select(distance > 0, 1 - beyond, beyond)


def missed_area(nx: mi.Float, ny: mi.Float, distance: mi.Float, samples: int) -> mi.Float:
    """Return the covered area that ``samples`` rays of a pixel miss, of its square about the origin
    where n . p < ``distance``; negative where they see too much."""
    seen = mi.Float(0)
    for dx, dy in sub_pixel_offsets(samples) - 0.5:
        seen += dr.select(nx * float(dx) + ny * float(dy) < distance, mi.Float(1 / samples), 0)
    return half_plane_area(nx, ny, distance) - seen


def add_missed(image: mi.Float, missed: mi.Float) -> mi.Float:
    """Return the image (pixels * 4) with what its rays missed: no radiance below 0, no coverage
    outside of [0, 1]."""
    is_coverage = (dr.arange(mi.UInt32, dr.width(image)) & 3) == 3
    return at_most(
        at_least(image + missed, 0), dr.select(is_coverage, mi.Float(1), mi.Float(dr.inf))
    )
