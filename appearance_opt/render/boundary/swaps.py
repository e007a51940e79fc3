"""Where two layers of a ray change places: curves in which surfaces that are seen through meet.

Colour a over b is not colour b over a, and the difference jumps across the curve in which they pass
through each other. In the image, the difference f of the reciprocal depths of two planes is affine,
and zero on the curve. A ray that passes at the distance s = f / |grad f| from it stands for a piece
of the curve of the length of its area times 1 - s: a hat of one pixel to both sides has unit area.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render.boundary.intersections import FLATTEST
from appearance_opt.render.camera import Camera, camera_of, direction
from appearance_opt.render.samples import Samples
from appearance_opt.render.surface import vertex_position

if TYPE_CHECKING:
    from appearance_opt.render.drawn import Shown
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.pixels import Batch, Grid


@dataclass
class Pair:
    """M pairs of layers that follow each other. ``front``, ``back``: on the same ray; ``share``: of
    its pixel that the ray stands for; ``contrast``: what changes where they change places, RGB."""

    front: Samples
    back: Samples
    share: mi.Float
    contrast: list[mi.Float]


@dataclass
class Swaps:
    """M points of curves in which layers meet. ``inside``, ``outside``: the layer in front and the
    one behind, at the point; ``length``: of the curve that it stands for, in pixels; ``slope``: of
    the difference of reciprocal depths, per pixel. The rest: see ``Boundary``."""

    inside: Samples
    outside: Samples
    length: mi.Float
    slope: mi.Float
    pixel: mi.UInt32
    contrast: mi.ArrayXf | None = None

    @property
    def measure(self) -> mi.Float:
        """See ``Boundary``."""
        return self.length

    def motion(self, shown: Shown, batch: Batch) -> mi.Float:
        """See ``Boundary``: where the layer in front comes nearer the curve moves outward."""
        camera = camera_of(batch.records, self.inside.view)
        ray = direction(camera, self.inside.x, self.inside.y, batch.grid.size)
        one, other = (plane(shown, camera, s.triangle) for s in (self.inside, self.outside))
        return (dr.dot(one, ray) - dr.dot(other, ray)) / self.slope

    def corrected(self, image: mi.Float, rays: int, grid: Grid) -> mi.Float:
        """See ``Boundary``: they know nothing of what is covered."""
        return image


def swaps(shown: Shown, batch: Batch, pairs: Pair, run: Run) -> Swaps | None:
    """Find the points of curves that pairs are near to; None without any."""
    near, found = run(_near, shown, batch, pairs)
    dr.eval(near, found)
    kept = dr.compress(near)
    if dr.width(kept) == 0:
        return None

    def take(v: mi.Float | mi.UInt32) -> mi.Float | mi.UInt32:
        return dr.gather(type(v), v, kept)

    assert found.contrast is not None
    out = Swaps(
        found.inside.keep(kept),
        found.outside.keep(kept),
        take(found.length),
        take(found.slope),
        take(found.pixel),
        mi.ArrayXf([take(c) for c in found.contrast]),
    )
    dr.eval(out)
    return out


def _near(shown: Shown, batch: Batch, pairs: Pair) -> tuple[mi.Bool, Swaps]:
    """(whether each pair changes places within a pixel of its ray, its point of the curve)."""
    front, back, size, rows = pairs.front, pairs.back, batch.grid.size, batch.grid.rows
    camera = camera_of(batch.records, front.view)
    planes = [plane(shown, camera, s.triangle) for s in (front, back)]
    ray = direction(camera, front.x, front.y, size)
    difference, scale = planes[0] - planes[1], 2 / size
    dx, dy = dr.dot(difference, camera.right) * scale, dr.dot(difference, camera.down) * scale
    f = dr.dot(difference, ray)
    slope = dr.sqrt(dr.fma(dx, dx, dy * dy))
    steep = slope > FLATTEST * dr.abs(dr.dot(planes[0], ray)) / size
    inverse = dr.rcp(dr.select(steep, slope, 1))
    s = dr.select(f > 0, f, 0) * inverse
    x, y = front.x - dx * inverse * s, front.y - dy * inverse * s
    near = steep & (s < 1) & (x > 0) & (y > 0) & (x < size) & (y < size)
    for sample in (front, back):
        near &= _inside(shown, camera, sample.triangle, direction(camera, x, y, size))
    pixel = (front.view * rows + mi.UInt32(y)) * rows + mi.UInt32(x)
    return near, Swaps(
        Samples(front.view, x, y, front.triangle),
        Samples(front.view, x, y, back.triangle),
        (1 - s) * pairs.share,
        slope,
        dr.select(near, pixel, 0),
        mi.ArrayXf([*pairs.contrast, dr.zeros(mi.Float, dr.width(s))]),
    )


def _corners(shown: Shown, triangle: mi.UInt32) -> list[mi.Point3f]:
    face = dr.gather(mi.ArrayXu, shown.surface.faces, triangle, shape=(4, dr.width(triangle)))
    return [vertex_position(shown.surface, face[k]) for k in range(3)]


def plane(shown: Shown, camera: Camera, triangle: mi.UInt32) -> mi.Vector3f:
    """Return the vector whose product with a ray's direction is the reciprocal depth of the
    triangle's plane along it."""
    a, b, c = _corners(shown, triangle)
    n = dr.cross(b - a, c - a)
    height = dr.dot(n, a - camera.eye)
    return n / dr.select(dr.abs(height) > 1e-30, height, 1e-30)


def _inside(shown: Shown, camera: Camera, triangle: mi.UInt32, ray: mi.Vector3f) -> mi.Bool:
    """Do rays meet the triangles?"""
    a, b, c = (p - camera.eye for p in _corners(shown, triangle))
    sides = [dr.dot(ray, dr.cross(p, q)) for p, q in ((a, b), (b, c), (c, a))]
    return ((sides[0] >= 0) & (sides[1] >= 0) & (sides[2] >= 0)) | (
        (sides[0] <= 0) & (sides[1] <= 0) & (sides[2] <= 0)
    )
