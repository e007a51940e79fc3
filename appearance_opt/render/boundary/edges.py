"""Silhouette edges: the usual boundaries.

Where a silhouette of the mesh moves across a pixel, the pixel changes although no shaded sample
does. Differentiating the pixel's integral over its area gives, besides the interior term that
automatic differentiation of the shading finds, an integral along the visible silhouettes,

    dI/dtheta = int (c_in - c_out) (n . dx/dtheta) dl   (Reynolds transport theorem; Li et al. 2018),

with x the point of the projected edge, n its outward normal in the image, c_in and c_out the
colours on its two sides. Edges are found from the mesh alone, sampled uniformly by projected
length, and tested for visibility by the two rays that also give the colours. Unbiased, but for
self-intersections of the mesh, which have no edge, and for edges that come too near to the camera
or leave the image by far (``_candidates``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from appearance_opt.render import rays
from appearance_opt.render.boundary import coverage
from appearance_opt.render.boundary.silhouettes import (
    edges_of,
    gather_edges,
    is_silhouette,
    seen_opposite,
)
from appearance_opt.render.camera import camera_of, project
from appearance_opt.render.freezing import traced
from appearance_opt.render.samples import Samples
from appearance_opt.render.surface import vertex_position

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.render.drawn import Drawn, Shown
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.pixels import Batch, Grid
    from appearance_opt.render.sampling import Sampling

OFFSET = 1e-6  # docs/trials.md: silhouettes
"""Distance of the two rays from the edge, in widths of the image: eight times the rounding of a
ray's direction. Farther rays count folds twice that are thinner than this beside an outline."""

DEPTH_SLACK = 0.01  # docs/trials.md: silhouettes
"""A hit nearer than the edge's own depth by more than this fraction hides the edge. Smaller values
reject edges of grazing faces."""

MAX_SAMPLES = 1 << 20
"""Silhouette points of a batch before they are tested for visibility; of longer silhouettes they
lie farther apart, and each stands for more."""


@dataclass
class EdgePoints:
    """V visible points on projected silhouettes.

    ``edge``: index; ``view``; ``position``: parameter along the projected edge in [0, 1];
    ``pixel``: index into the batch; ``length``: share of the projected silhouette length that the
    point stands for, in pixels, one number for all or one for each; ``normal_x``, ``normal_y``: its
    outward normal in the image; the rest: see ``Boundary``.
    """

    edge: mi.UInt32
    view: mi.UInt32
    position: mi.Float
    pixel: mi.UInt32
    length: mi.Float
    normal_x: mi.Float
    normal_y: mi.Float
    inside: Samples
    outside: Samples
    contrast: mi.ArrayXf | None = None

    @property
    def measure(self) -> mi.Float:
        """See ``Boundary``."""
        return self.length

    def motion(self, shown: Shown, batch: Batch) -> mi.Float:
        """See ``Boundary``: n . x(theta), the position of each point along its outward normal in
        pixels."""
        edge, camera = gather_edges(shown, self.edge), camera_of(batch.records, self.view)
        ax, ay, _ = project(camera, edge.a, batch.grid.size)
        bx, by, _ = project(camera, edge.b, batch.grid.size)
        x, y = dr.lerp(ax, bx, self.position), dr.lerp(ay, by, self.position)
        return dr.fma(self.normal_x, x, self.normal_y * y)

    def corrected(self, image: mi.Float, rays: int, grid: Grid) -> mi.Float:
        """See ``Boundary``: the points know the line that bounds what is covered."""
        row = self.pixel // grid.rows
        column = self.pixel - row * grid.rows
        row -= (row // grid.rows) * grid.rows
        x = self.inside.x - mi.Float(column) - 0.5
        y = self.inside.y - mi.Float(row) - 0.5
        nx, ny = self.normal_x, self.normal_y
        missed = coverage.missed_area(nx, ny, dr.fma(nx, x, ny * y), rays)
        # several points of one line: their mean
        count = dr.zeros(mi.UInt32, grid.pixels)
        dr.scatter_reduce(dr.ReduceOp.Add, count, mi.UInt32(1), self.pixel)
        missed /= mi.Float(dr.gather(mi.UInt32, count, self.pixel))
        out = dr.zeros(mi.Float, grid.pixels * 4)
        dr.scatter_reduce(dr.ReduceOp.Add, out, self.contrast * missed, self.pixel)
        return coverage.add_missed(image, out)

    def keep(self, index: mi.UInt32) -> EdgePoints:
        """Take the points at the given places of the list."""

        def pick(v: mi.Float | mi.UInt32) -> mi.Float | mi.UInt32:
            return dr.gather(type(v), v, index)

        return EdgePoints(
            pick(self.edge),
            pick(self.view),
            pick(self.position),
            pick(self.pixel),
            self.length,
            pick(self.normal_x),
            pick(self.normal_y),
            self.inside.keep(index),
            self.outside.keep(index),
        )


@dataclass(frozen=True)
class Edges:
    """A ``Finder`` of silhouettes: about ``density`` points per pixel of their projected length."""

    density: float = 1.0

    @property
    def walks(self) -> bool:
        return False

    def find(
        self, drawn: Drawn, batch: Batch, sampling: Sampling, seed: int, run: Run = traced
    ) -> EdgePoints | None:
        """See ``Finder``: visible points, stratified along the total length; ``seed`` moves them
        within their strata."""
        points = self.spread(_points, drawn, drawn, batch, seed, run)
        if points is None:
            return None
        points, visible = points
        kept = dr.compress(visible)
        return points.keep(kept) if dr.width(kept) else None

    def spread(
        self, place: Callable, seen: Any, drawn: Drawn, batch: Batch, seed: int, run: Run
    ) -> Any:
        """Return ``place(seen, batch, strata, number, seed)`` of points along the total length of
        silhouettes, hidden ones included; None without any."""
        index, length = silhouette_edges(drawn, batch, run)
        if dr.width(index) == 0:
            return None
        # in single precision sums of 1e5 pixels are rounded by a tenth of an edge of a fine mesh
        upper = dr.cumsum(mi.Float64(length))
        total = float(upper[dr.width(upper) - 1])
        count = min(max(int(total * self.density), 1), MAX_SAMPLES)
        number = dr.arange(mi.UInt32, count)
        dr.eval(number)
        strata = Strata(
            index,
            upper,
            dr.opaque(mi.UInt32, dr.width(upper) - 1),
            dr.opaque(mi.Float64, total / count),
        )
        return run(place, seen, batch, strata, number, dr.opaque(mi.UInt32, seed))


def silhouette_edges(drawn: Drawn, batch: Batch, run: Run = traced) -> tuple[mi.UInt32, mi.Float]:
    """Return (index, length): the silhouettes among all pairs (view * edges + edge), and their
    projected lengths in pixels."""
    visible, length = run(_candidates, drawn.shown, batch)
    index = dr.compress(visible)
    return index, dr.gather(mi.Float, length, index)


def _candidates(shown: Shown, batch: Batch) -> tuple[mi.Bool, mi.Float]:
    """(silhouette and in view, projected length) of all pairs (view * edges + edge)."""
    count, size = edges_of(shown).count, batch.grid.size
    i = dr.arange(mi.UInt32, batch.grid.views * count)
    view = i // count
    edge = gather_edges(shown, i - view * count)
    camera = camera_of(batch.records, view)
    silhouette = is_silhouette(shown, edge, camera)
    ax, ay, az = project(camera, edge.a, size)
    bx, by, bz = project(camera, edge.b, size)
    length = dr.sqrt(dr.square(bx - ax) + dr.square(by - ay))
    near = 0.01 * dr.norm(edge.a - camera.eye)
    # an edge that leaves the image by far would take all the samples: it is dropped, as are those
    # that come too close to the camera to be projected
    visible = silhouette & (az > near) & (bz > near) & (length > 0) & (length < 4 * size)
    return visible, length


@dataclass
class Strata:
    """Silhouettes in a row: ``index`` of each (view * edges + edge), the length ``upper`` up to its
    end, the number of the ``last``, and the ``spacing`` of points along them. Lengths in pixels."""

    index: mi.UInt32
    upper: mi.Float64
    last: mi.UInt32
    spacing: mi.Float64


def _points(
    drawn: Drawn, batch: Batch, strata: Strata, number: mi.UInt32, seed: mi.UInt32
) -> tuple[EdgePoints, mi.Bool]:
    """The points of the given numbers along the silhouettes, and whether each is visible."""
    points, visible, depth = place_points(drawn.shown, batch, strata, number, seed)
    hits = []
    for side in (points.inside, points.outside):
        hit, hit_depth = rays.trace_depth(drawn.scene, batch, side.view, side.x, side.y)
        visible &= hit_depth > depth * (1 - DEPTH_SLACK)
        hits.append(hit)
    # an edge with the same face (or nothing) on both sides has no contrast
    visible &= hits[0].triangle != hits[1].triangle
    return replace(points, inside=hits[0], outside=hits[1]), visible


def place_points(
    shown: Shown, batch: Batch, strata: Strata, number: mi.UInt32, seed: mi.UInt32
) -> tuple[EdgePoints, mi.Bool, mi.Float]:
    """Return (the points of the given numbers along the silhouettes, with the edge's own number for
    what is seen on both sides; whether each lies in the image; their depth)."""
    size, rows = batch.grid.size, batch.grid.rows
    count = edges_of(shown).count
    at = (mi.Float64(number) + mi.Float64(mi.sample_tea_float32(number, seed))) * strata.spacing
    found = _first_not_below(strata.upper, at, strata.last, batch.grid.views * count)
    pair = dr.gather(mi.UInt32, strata.index, found)
    begin = dr.gather(mi.Float64, strata.upper, found - 1, found > 0)
    s = mi.Float((at - begin) / (dr.gather(mi.Float64, strata.upper, found) - begin))
    s = dr.select((s > 0) & (s < 1), s, 0.5)
    view = pair // count
    edge = gather_edges(shown, pair - view * count)
    camera = camera_of(batch.records, view)
    ax, ay, az = project(camera, edge.a, size)
    bx, by, bz = project(camera, edge.b, size)
    opposite = seen_opposite(shown, edge, camera)
    ox, oy, oz = project(camera, vertex_position(shown.surface, opposite), size)
    nx, ny = ay - by, bx - ax
    scale = dr.rsqrt(dr.fma(nx, nx, ny * ny))
    # outward: away from the third vertex of a face that is there; one behind the camera is
    # projected to the other side
    scale = dr.select((nx * (ox - ax) + ny * (oy - ay) > 0) == (oz > 0), -scale, scale)
    nx, ny = nx * scale, ny * scale
    x, y = dr.lerp(ax, bx, s), dr.lerp(ay, by, s)
    depth = dr.rcp(dr.lerp(dr.rcp(az), dr.rcp(bz), s))
    within = (x > 0) & (y > 0) & (x < size) & (y < size)
    sides = []
    for sign in (-OFFSET, OFFSET):
        away = size * sign
        sides.append(Samples(view, dr.fma(nx, away, x), dr.fma(ny, away, y), edge.index))
    pixel = (view * rows + mi.UInt32(y)) * rows + mi.UInt32(x)
    points = EdgePoints(edge.index, view, s, pixel, mi.Float(strata.spacing), nx, ny, *sides)
    return points, within, depth


def _first_not_below(
    ascending: mi.Float64, value: mi.Float64, last: mi.UInt32, longest: int
) -> mi.UInt32:
    """Index of the first entry >= value (the ``last`` entry if there is none). The number of
    bisections follows from the ``longest`` possible array, so that one kernel serves all
    lengths."""
    found = dr.zeros(mi.UInt32, dr.width(value))
    for bit in reversed(range(longest.bit_length())):
        candidate = found + (1 << bit)
        inside = candidate <= last
        below = dr.gather(mi.Float64, ascending, candidate - 1, inside) < value
        found = dr.select(inside & below, candidate, found)
    return found
