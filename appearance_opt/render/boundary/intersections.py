"""Where two surfaces run into each other: a boundary without an edge.

On one side of the curve in which two sheets meet the one hides the other, on the other side the
other the one. In the image, the reciprocal depth of a triangle's plane is an affine function of the
position; where those of the two sheets are equal, the curve crosses. From the differences before
and behind the crossing follows its place, and from its derivative the motion of the curve.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render.boundary.neighbours import Blend, FineGrid, Neighbours
from appearance_opt.render.boundary.silhouette_walk import search
from appearance_opt.render.boundary.silhouettes import edges_of
from appearance_opt.render.camera import Camera, camera_of, direction
from appearance_opt.render.math import clamp
from appearance_opt.render.samples import Samples
from appearance_opt.render.surface import vertex_position

if TYPE_CHECKING:
    from appearance_opt.render.drawn import Drawn, Shown
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.pixels import Batch, Grid
    from appearance_opt.render.sampling import Sampling

FLATTEST = 2e-5
"""Sheets whose reciprocal depths differ less, before and behind a crossing together and relative to
themselves, do not meet: this is the rounding of one sheet at the seam of two triangles, or a
contact too flat to have a place."""


@dataclass
class Crossings:
    """M places where one sheet passes through another between two samples, ``inside`` and
    ``outside``.

    ``horizontal``: are they beside each other? ``position``: of the crossing, from the inside
    sample in units of their distance; ``area``: that is swept when it moves by one unit, in pixels;
    the rest: see ``Boundary``.
    """

    inside: Samples
    outside: Samples
    horizontal: mi.Bool
    position: mi.Float
    area: mi.Float
    pixel: mi.UInt32
    contrast: mi.ArrayXf | None = None

    @property
    def measure(self) -> mi.Float:
        """See ``Boundary``."""
        return self.area

    def motion(self, shown: Shown, batch: Batch) -> mi.Float:
        """See ``Boundary``: the position of each crossing in units of the samples' distance."""
        first, last = _differences(shown, batch, self.inside, self.outside)
        return first / (first - last)

    def corrected(self, image: mi.Float, rays: int, grid: Grid) -> mi.Float:
        """See ``Boundary``: crossings know nothing of what is covered."""
        return image


@dataclass(frozen=True)
class Intersections:
    """A ``Finder`` of crossings, by comparing as many rays on a regular grid as pixels have
    samples (price: docs/accuracy.md)."""

    @property
    def walks(self) -> bool:
        return True

    def find(
        self, drawn: Drawn, batch: Batch, sampling: Sampling, seed: int, run: Run
    ) -> Crossings | None:
        """See ``Finder``."""
        fine = FineGrid.of(batch, isqrt(sampling.samples))
        found = search(drawn.shown, *fine.trace(drawn.scene, run), fine, run)
        if found.meeting is None:
            return None
        there = crossings(drawn.shown, fine, found.meeting)
        return None if there is None else there[0]


def crossings(shown: Shown, fine: FineGrid, meeting: Neighbours) -> tuple[Crossings, Blend] | None:
    """Return (where sheets that are ``meeting`` pass through each other, what moves between pixels
    there), None without any."""
    pairs, batch = meeting, fine.samples
    front, back = pairs.front, pairs.back
    camera = camera_of(batch.records, front.view)
    first, last = _differences(shown, batch, front, back)
    one, other = (_slope(_plane(shown, camera, s.triangle), camera) for s in (front, back))
    dx, dy = dr.abs(one[0] - other[0]), dr.abs(one[1] - other[1])
    ours = dr.select(pairs.horizontal, dx >= dy, dy > dx)
    ray = direction(camera, front.x, front.y, batch.grid.size)
    inverse_depth = dr.abs(dr.dot(_plane(shown, camera, front.triangle), ray))
    steep = first - last > FLATTEST * inverse_depth
    kept = dr.compress(ours & steep & (first > 0) & (last < 0))
    if dr.width(kept) == 0:
        return None
    p = pairs.keep(kept)
    position = clamp(dr.gather(mi.Float, first / (first - last), kept), 0, 1)
    blend = Blend.of(p, position, fine)
    out = Crossings(
        fine.coarse(p.front),
        fine.coarse(p.back),
        p.horizontal,
        position,
        dr.opaque(mi.Float, 1 / fine.per_axis**2),
        blend.pixel,
    )
    dr.eval(out)
    return out, blend


def _differences(
    shown: Shown, batch: Batch, front: Samples, back: Samples
) -> tuple[mi.Float, mi.Float]:
    """Reciprocal depth of the front samples' triangles less that of the back samples', at the front
    samples and at the back samples. The planes that are seen stand for their sheets: hidden
    triangles can be edge-on."""
    camera = camera_of(batch.records, front.view)
    planes = [_plane(shown, camera, s.triangle) for s in (front, back)]
    rays = [direction(camera, s.x, s.y, batch.grid.size) for s in (front, back)]
    first, last = (dr.dot(planes[0], ray) - dr.dot(planes[1], ray) for ray in rays)
    return first, last


def _slope(plane: mi.Vector3f, camera: Camera) -> tuple[mi.Float, mi.Float]:
    """Change of the reciprocal depth of planes across the image, to the right and down, but for a
    common factor."""
    return dr.dot(plane, camera.right), dr.dot(plane, camera.down)


def _plane(shown: Shown, camera: Camera, triangle: mi.UInt32) -> mi.Vector3f:
    """The vector whose product with a ray's direction is the reciprocal depth of the triangle's
    plane along it."""
    around = edges_of(shown).around
    face = dr.gather(mi.ArrayXu, around, triangle, shape=(12, dr.width(triangle)))
    a, b, c = (vertex_position(shown.surface, face[k]) for k in range(3))
    n = dr.cross(b - a, c - a)
    height = dr.dot(n, a - camera.eye)
    return n / dr.select(dr.abs(height) > 1e-30, height, 1e-30)
