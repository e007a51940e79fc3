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

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.render import rays
from appearance_opt.render.freezing import traced
from appearance_opt.render.rays import Samples

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.render.freezing import Run
    from appearance_opt.render.passing import Scene
    from appearance_opt.render.pixels import Grid

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
class EdgeList:
    """Edges of a mesh: packets (a, b, opposite vertex, other opposite vertex), ``count`` of them.
    An edge with one face, or more than two, has b in place of the other opposite vertex: it counts
    as a silhouette from everywhere.

    ``around``: for walks over the mesh (see ``walkable``), packets (three vertices, 0, three edges,
    0, three neighbours, 0) per face; edge k runs from vertex k to the next, and the neighbour lies
    beyond it (the face itself where there is not exactly one).

    ``sides``: for faces that are not to be seen from behind, sums of the following bits per edge;
    None without any. Of the face with the first opposite vertex: 1 if it is culled, 2 if it runs
    from a to b by its winding; of that with the other one: 4 and 8. Where an edge has more than two
    faces none of them is culled here: some are seen.
    """

    packets: mi.UInt32
    count: int
    around: mi.UInt32 | None = None
    sides: mi.UInt32 | None = None


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
            rays.keep(self.inside, index),
            rays.keep(self.outside, index),
        )


def edge_list(faces: NDArray, culled: NDArray | None = None) -> EdgeList:
    """All edges of a welded mesh (F, 3). ``culled`` (F,): see ``Surface.culled``."""
    low, high, opposite, order, heads, uses = _sorted_edges(faces)
    second = np.minimum(heads + 1, len(low) - 1)
    other = np.where(uses == 2, opposite[second], high[heads])
    packets = np.stack([low[heads], high[heads], opposite[heads], other], axis=1).astype(np.uint32)
    sides = None
    if culled is not None:
        corner, face = np.divmod(order, len(faces))
        bits = np.where(culled[face], 1, 0) + np.where(faces[face, corner] == low, 2, 0)
        bits = np.where(uses <= 2, bits[heads], 0) + np.where(uses == 2, 4 * bits[second], 0)
        sides = mi.UInt32(bits.astype(np.uint32))
    return EdgeList(mi.UInt32(packets.ravel()), len(heads), sides=sides)


def walkable(edges: EdgeList, faces: NDArray) -> EdgeList:
    """The same edges of the same faces (F, 3), with what lies around each face."""
    _, _, _, order, heads, uses = _sorted_edges(faces)
    count = len(faces)
    face, edge = order % count, np.repeat(np.arange(len(heads)), uses)
    partner = np.where(uses == 2, 2 * heads + 1, 0)[edge] - np.arange(len(order))
    beyond = np.where(uses[edge] == 2, face[np.clip(partner, 0, len(order) - 1)], face)
    out = np.zeros((count, 3, 4), np.uint32)
    out[:, 0, :3] = faces
    out[face, 1, order // count] = edge
    out[face, 2, order // count] = beyond
    return replace(edges, around=mi.UInt32(out.ravel()))


def _sorted_edges(faces: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray, NDArray]:
    """The three edges of all faces, those that coincide side by side: lower, higher and opposite
    vertex (3 F), where each comes from (k F + face for the edge after corner k); and where each
    edge begins in that list, and how often it is there (E)."""
    corners = np.asarray(faces, np.int64)
    start, end, opposite = (
        corners.T.ravel(),
        corners[:, [1, 2, 0]].T.ravel(),
        corners[:, [2, 0, 1]].T.ravel(),
    )
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    low, high, opposite = low[order], high[order], opposite[order]
    first = np.ones(len(low), bool)
    first[1:] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    heads = np.flatnonzero(first)
    return low, high, opposite, order, heads, np.diff(np.append(heads, len(low)))


def project(
    camera: rays.Camera, p: mi.Point3f, resolution: mi.Float
) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Pixel position (x, y) and depth along ``forward`` of world points. Differentiable in p."""
    v = p - camera.eye
    depth = dr.dot(v, camera.forward)
    half = 0.5 * resolution
    scale = half / (depth * dr.squared_norm(camera.right))
    return (
        dr.fma(dr.dot(v, camera.right), scale, half),
        dr.fma(dr.dot(v, camera.down), scale, half),
        depth,
    )


def silhouette_edges(
    edges: EdgeList,
    vertices: mi.Float,
    records: mi.Float,
    views: int,
    resolution: mi.Float,
    run: Run = traced,
) -> tuple[mi.UInt32, mi.Float]:
    """(index, length): the silhouettes among all pairs (view * edges + edge), and their projected
    lengths in pixels. ``vertices``: packets of ``Surface.vertices``."""
    visible, length = run(_candidates, edges, vertices, records, views, resolution)
    index = dr.compress(visible)
    return index, dr.gather(mi.Float, length, index)


def _candidates(
    edges: EdgeList, vertices: mi.Float, records: mi.Float, views: int, resolution: mi.Float
) -> tuple[mi.Bool, mi.Float]:
    """(silhouette and in view, projected length) of all pairs (view * edges + edge)."""
    i = dr.arange(mi.UInt32, views * edges.count)
    view = i // edges.count
    edge = dr.gather(
        mi.ArrayXu, edges.packets, i - view * edges.count, shape=(4, views * edges.count)
    )
    camera = rays.camera_of(records, view)
    a, b = position(vertices, edge[0]), position(vertices, edge[1])
    silhouette = is_silhouette(edges, i - view * edges.count, edge, a, b, vertices, camera)
    ax, ay, az = project(camera, a, resolution)
    bx, by, bz = project(camera, b, resolution)
    length = dr.sqrt(dr.square(bx - ax) + dr.square(by - ay))
    near = 0.01 * dr.norm(a - camera.eye)
    # an edge that leaves the image by far would take all the samples: it is dropped, as are those
    # that come too close to the camera to be projected
    visible = silhouette & (az > near) & (bz > near) & (length > 0) & (length < 4 * resolution)
    return visible, length


def is_silhouette(
    edges: EdgeList,
    index: mi.UInt32,
    edge: mi.ArrayXu,
    a: mi.Point3f,
    b: mi.Point3f,
    vertices: mi.Float,
    camera: rays.Camera,
) -> mi.Bool:
    """Do both faces of the edges of numbers ``index`` (with packets ``edge``, from ``a`` to ``b``)
    lie on one side of the plane through eye and edge? No winding is needed, but for culled faces:
    what turns its back to the eye is not there."""
    m = dr.cross(a - camera.eye, b - a)
    side, other_side = (dr.dot(m, position(vertices, edge[k]) - a) for k in (2, 3))
    boundary = edge[3] == edge[1]
    out = boundary | (side * other_side > 0)
    if edges.sides is None:
        return out
    bits = dr.gather(mi.UInt32, edges.sides, index)
    gone, other_gone = _turned_away(bits, side), boundary | _turned_away(bits >> 2, other_side)
    return (out | (gone != other_gone)) & ~(gone & other_gone)


def _turned_away(bits: mi.UInt32, side: mi.Float) -> mi.Bool:
    """Does a culled face turn its back to the eye? ``bits`` of ``EdgeList.sides``; ``side``:
    product of its opposite vertex, from the edge on, and the normal of the plane through eye and
    edge."""
    return ((bits & 1) != 0) & (dr.select((bits & 2) != 0, side, -side) > 0)


def sample_edges(
    scene: Scene,
    edges: EdgeList,
    vertices: mi.Float,
    records: mi.Float,
    grid: Grid,
    density: float,
    seed: int,
    run: Run = traced,
) -> EdgeSamples | None:
    """Visible silhouette points, about ``density`` per pixel of projected length; None if there are
    none. Stratified along the total length; ``seed`` moves the points within their strata."""
    index, length = silhouette_edges(edges, vertices, records, grid.views, grid.size, run)
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
    points, visible = run(
        _points,
        scene,
        edges,
        vertices,
        records,
        grid.size,
        grid.rows,
        grid.views,
        strata,
        number,
        dr.opaque(mi.UInt32, seed),
    )
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
    scene: Scene,
    edges: EdgeList,
    vertices: mi.Float,
    records: mi.Float,
    resolution: mi.Float,
    rows: mi.UInt32,
    views: int,
    strata: Strata,
    number: mi.UInt32,
    seed: mi.UInt32,
) -> tuple[EdgeSamples, mi.Bool]:
    """The points of the given numbers along the silhouettes, and whether each is visible."""
    at = (mi.Float64(number) + mi.Float64(mi.sample_tea_float32(number, seed))) * strata.spacing
    found = _first_not_below(strata.upper, at, strata.last, views * edges.count)
    pair = dr.gather(mi.UInt32, strata.index, found)
    begin = dr.gather(mi.Float64, strata.upper, found - 1, found > 0)
    s = mi.Float((at - begin) / (dr.gather(mi.Float64, strata.upper, found) - begin))
    s = dr.select((s > 0) & (s < 1), s, 0.5)
    view = pair // edges.count
    edge = pair - view * edges.count
    ends = dr.gather(mi.ArrayXu, edges.packets, edge, shape=(4, dr.width(edge)))
    camera = rays.camera_of(records, view)
    ax, ay, az = project(camera, position(vertices, ends[0]), resolution)
    bx, by, bz = project(camera, position(vertices, ends[1]), resolution)
    opposite = _seen_opposite(edges, edge, ends, vertices, camera)
    ox, oy, oz = project(camera, position(vertices, opposite), resolution)
    nx, ny = ay - by, bx - ax
    scale = dr.rsqrt(dr.fma(nx, nx, ny * ny))
    # outward: away from the third vertex of a face that is there; one behind the camera is
    # projected to the other side
    scale = dr.select((nx * (ox - ax) + ny * (oy - ay) > 0) == (oz > 0), -scale, scale)
    nx, ny = nx * scale, ny * scale
    x, y = dr.lerp(ax, bx, s), dr.lerp(ay, by, s)
    depth = dr.rcp(dr.lerp(dr.rcp(az), dr.rcp(bz), s))
    hits = []
    visible = (x > 0) & (y > 0) & (x < resolution) & (y < resolution)
    for sign in (-OFFSET, OFFSET):
        away = resolution * sign
        hit, hit_depth = rays.trace_depth(
            scene, records, view, dr.fma(nx, away, x), dr.fma(ny, away, y), resolution
        )
        visible &= hit_depth > depth * (1 - DEPTH_SLACK)
        hits.append(hit)
    # an edge with the same face (or nothing) on both sides has no contrast
    visible &= hits[0].triangle != hits[1].triangle
    pixel = (view * rows + mi.UInt32(y)) * rows + mi.UInt32(x)
    return EdgeSamples(
        edge, view, s, pixel, mi.Float(strata.spacing), nx, ny, hits[0], hits[1]
    ), visible


def _seen_opposite(
    edges: EdgeList, index: mi.UInt32, ends: mi.ArrayXu, vertices: mi.Float, camera: rays.Camera
) -> mi.UInt32:
    """The opposite vertex of a face of each silhouette that is not culled."""
    if edges.sides is None:
        return ends[2]
    a = position(vertices, ends[0])
    m = dr.cross(a - camera.eye, position(vertices, ends[1]) - a)
    side = dr.dot(m, position(vertices, ends[2]) - a)
    return dr.select(_turned_away(dr.gather(mi.UInt32, edges.sides, index), side), ends[3], ends[2])


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


def motion(
    edges: EdgeList,
    vertices: mi.Float,
    records: mi.Float,
    samples: EdgeSamples,
    resolution: mi.Float,
) -> mi.Float:
    """n . x(theta): the position of each point along its outward normal in pixels, differentiable
    in ``vertices``. Only its derivative means anything."""
    ends = dr.gather(mi.ArrayXu, edges.packets, samples.edge, shape=(4, dr.width(samples.edge)))
    camera = rays.camera_of(records, samples.view)
    ax, ay, _ = project(camera, position(vertices, ends[0]), resolution)
    bx, by, _ = project(camera, position(vertices, ends[1]), resolution)
    x, y = dr.lerp(ax, bx, samples.position), dr.lerp(ay, by, samples.position)
    return dr.fma(samples.normal_x, x, samples.normal_y * y)


def position(vertices: mi.Float, index: mi.UInt32) -> mi.Point3f:
    """Positions of vertices, from the packets of ``Surface.vertices``; differentiable."""
    v = dr.gather(
        mi.ArrayXf, vertices, index, mode=dr.ReduceMode.Expand, shape=(8, dr.width(index))
    )
    return mi.Point3f(v[0], v[1], v[2])
