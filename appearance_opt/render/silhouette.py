"""The derivative of visibility: explicit silhouette edges.

Where a silhouette of the mesh moves across a pixel, the pixel changes although no shaded sample
does. Differentiating the pixel's integral over its area gives, besides the interior term that
automatic differentiation of the shading finds, an integral along the visible silhouettes,

    dI/dtheta = int (c_in - c_out) (n . dx/dtheta) dl      (Reynolds transport theorem; Li et al. 2018),

with x the point of the projected edge, n its outward normal in the image, c_in and c_out the
colours on its two sides. Edges are found from the mesh alone, sampled uniformly by projected
length, and tested for visibility by the two rays that also give the colours. Unbiased, but for
self-intersections of the mesh, which have no edge, and for edges that come too near to the camera
or leave the image by far (``_candidates``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render import rays
from appearance_opt.render.camera import camera_of, project
from appearance_opt.render.edge_list import EdgeList
from appearance_opt.render.freezing import traced
from appearance_opt.render.samples import Samples
from appearance_opt.render.surface import vertex_position

if TYPE_CHECKING:
    from appearance_opt.render.camera import Camera
    from appearance_opt.render.drawn import Drawn, Shown
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.pixels import Batch

OFFSET = 1e-6
"""Distance of the two rays from the edge, in widths of the image: eight times the rounding of a
ray's direction. Fine meshes have folds thinner than a thousandth of a pixel beside their outline,
which farther rays count twice (the area of a sphere of 20,000 triangles on 64 squared pixels: 5.6 %
too much at 1e-3 pixels, 16 % at 1e-2)."""

DEPTH_SLACK = 0.01
"""A hit nearer than the edge's own depth by more than this fraction hides the edge. Smaller values
reject edges of grazing faces (0.002 costs 4 % bias)."""

MAX_SAMPLES = 1 << 20
"""Silhouette points of a batch before they are tested for visibility; of longer silhouettes they
lie farther apart, and each stands for more."""


@dataclass
class EdgeSamples:
    """V visible points on projected silhouettes.

    ``edge``: index; ``view``; ``position``: parameter along the projected edge in [0, 1];
    ``pixel``: index into the batch; ``length``: share of the projected silhouette length that the
    point stands for, in pixels, one number for all or one for each; ``normal_x``, ``normal_y``: its
    outward normal in the image; ``inside``, ``outside``: what is seen on the two sides.
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

    def keep(self, index: mi.UInt32) -> EdgeSamples:
        """The points at the given places of the list."""

        def pick(v: mi.Float | mi.UInt32) -> mi.Float | mi.UInt32:
            return dr.gather(type(v), v, index)

        return EdgeSamples(
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


@dataclass
class GatheredEdges:
    """Edges of what is drawn: their numbers ``index`` and packets ``corners`` (see ``EdgeList``),
    and their ends ``a`` and ``b``."""

    index: mi.UInt32
    corners: mi.ArrayXu
    a: mi.Point3f
    b: mi.Point3f


def gather_edges(shown: Shown, index: mi.UInt32, active: mi.Bool | bool = True) -> GatheredEdges:
    """The edges of the given numbers; differentiable in the vertices."""
    edges = edges_of(shown)
    corners = dr.gather(mi.ArrayXu, edges.packets, index, active, shape=(4, dr.width(index)))
    a, b = (vertex_position(shown.surface, corners[k]) for k in (0, 1))
    return GatheredEdges(index, corners, a, b)


def edges_of(shown: Shown | Drawn) -> EdgeList:
    """The edges of what is drawn, which must have some."""
    assert shown.edges is not None, "silhouettes need the edges of what is drawn"
    return shown.edges


def silhouette_edges(drawn: Drawn, batch: Batch, run: Run = traced) -> tuple[mi.UInt32, mi.Float]:
    """(index, length): the silhouettes among all pairs (view * edges + edge), and their projected
    lengths in pixels."""
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


def is_silhouette(shown: Shown, edge: GatheredEdges, camera: Camera) -> mi.Bool:
    """Do both faces of edges lie on one side of the plane through eye and edge? No winding is
    needed, but for culled faces: what turns its back to the eye is not there."""
    m = dr.cross(edge.a - camera.eye, edge.b - edge.a)
    side, other_side = (
        dr.dot(m, vertex_position(shown.surface, edge.corners[k]) - edge.a) for k in (2, 3)
    )
    boundary = edge.corners[3] == edge.corners[1]
    out = boundary | (side * other_side > 0)
    sides = edges_of(shown).sides
    if sides is None:
        return out
    bits = dr.gather(mi.UInt32, sides, edge.index)
    gone, other_gone = _turned_away(bits, side), boundary | _turned_away(bits >> 2, other_side)
    return (out | (gone != other_gone)) & ~(gone & other_gone)


def _turned_away(bits: mi.UInt32, side: mi.Float) -> mi.Bool:
    """Does a culled face turn its back to the eye? ``bits`` of ``EdgeList.sides``; ``side``:
    product of its opposite vertex, from the edge on, and the normal of the plane through eye and
    edge."""
    return ((bits & 1) != 0) & (dr.select((bits & 2) != 0, side, -side) > 0)


def sample_edges(
    drawn: Drawn, batch: Batch, density: float, seed: int, run: Run = traced
) -> EdgeSamples | None:
    """Visible silhouette points, about ``density`` per pixel of projected length; None if there are
    none. Stratified along the total length; ``seed`` moves the points within their strata."""
    index, length = silhouette_edges(drawn, batch, run)
    if dr.width(index) == 0:
        return None
    # in single precision the rounding of sums of 1e5 pixels is a tenth of an edge of a fine mesh
    upper = dr.cumsum(mi.Float64(length))
    total = float(upper[dr.width(upper) - 1])
    count = min(max(int(total * density), 1), MAX_SAMPLES)
    number = dr.arange(mi.UInt32, count)
    dr.eval(number)
    strata = Strata(
        index,
        upper,
        dr.opaque(mi.UInt32, dr.width(upper) - 1),
        dr.opaque(mi.Float64, total / count),
    )
    points, visible = run(_points, drawn, batch, strata, number, dr.opaque(mi.UInt32, seed))
    kept = dr.compress(visible)
    return points.keep(kept) if dr.width(kept) else None


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
) -> tuple[EdgeSamples, mi.Bool]:
    """The points of the given numbers along the silhouettes, and whether each is visible."""
    shown, size, rows = drawn.shown, batch.grid.size, batch.grid.rows
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
    opposite = _seen_opposite(shown, edge, camera)
    ox, oy, oz = project(camera, vertex_position(shown.surface, opposite), size)
    nx, ny = ay - by, bx - ax
    scale = dr.rsqrt(dr.fma(nx, nx, ny * ny))
    # outward: away from the third vertex of a face that is there; one behind the camera is
    # projected to the other side
    scale = dr.select((nx * (ox - ax) + ny * (oy - ay) > 0) == (oz > 0), -scale, scale)
    nx, ny = nx * scale, ny * scale
    x, y = dr.lerp(ax, bx, s), dr.lerp(ay, by, s)
    depth = dr.rcp(dr.lerp(dr.rcp(az), dr.rcp(bz), s))
    hits = []
    visible = (x > 0) & (y > 0) & (x < size) & (y < size)
    for sign in (-OFFSET, OFFSET):
        away = size * sign
        hit, hit_depth = rays.trace_depth(
            drawn.scene, batch, view, dr.fma(nx, away, x), dr.fma(ny, away, y)
        )
        visible &= hit_depth > depth * (1 - DEPTH_SLACK)
        hits.append(hit)
    # an edge with the same face (or nothing) on both sides has no contrast
    visible &= hits[0].triangle != hits[1].triangle
    pixel = (view * rows + mi.UInt32(y)) * rows + mi.UInt32(x)
    return EdgeSamples(
        edge.index, view, s, pixel, mi.Float(strata.spacing), nx, ny, hits[0], hits[1]
    ), visible


def _seen_opposite(shown: Shown, edge: GatheredEdges, camera: Camera) -> mi.UInt32:
    """The opposite vertex of a face of each silhouette that is not culled."""
    sides = edges_of(shown).sides
    if sides is None:
        return edge.corners[2]
    m = dr.cross(edge.a - camera.eye, edge.b - edge.a)
    side = dr.dot(m, vertex_position(shown.surface, edge.corners[2]) - edge.a)
    away = _turned_away(dr.gather(mi.UInt32, sides, edge.index), side)
    return dr.select(away, edge.corners[3], edge.corners[2])


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


def motion(shown: Shown, batch: Batch, samples: EdgeSamples) -> mi.Float:
    """n . x(theta): the position of each point along its outward normal in pixels, differentiable
    in the vertices. Only its derivative means anything."""
    edge, camera = gather_edges(shown, samples.edge), camera_of(batch.records, samples.view)
    ax, ay, _ = project(camera, edge.a, batch.grid.size)
    bx, by, _ = project(camera, edge.b, batch.grid.size)
    x, y = dr.lerp(ax, bx, samples.position), dr.lerp(ay, by, samples.position)
    return dr.fma(samples.normal_x, x, samples.normal_y * y)
