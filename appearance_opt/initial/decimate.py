"""Edge collapse to an exact budget, in rounds of independent collapses.

The metric is Garland and Heckbert's, with faces weighted by area times an importance that the
caller gives: how much of the face an observer sees. Instead of one collapse at a time, each round
collapses all cheap edges that are the cheapest of their neighbourhood; their neighbourhoods do not
touch, so a round is a handful of array operations. Far from the budget, rounds are bolder: see
``BOLD``. What libraries do instead, and why it was not enough, is in docs/trials.md: decimation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.normals import accumulate, unit, weld
from appearance_opt.initial import quadrics
from appearance_opt.initial.collapse import STRICT, TEARING, TURNING, State, collapse, legal
from appearance_opt.initial.edges import Sides, edges_of, keys, touching
from appearance_opt.initial.flips import flip_edges
from appearance_opt.initial.parts import drop_cheap_parts, drop_smallest_parts
from appearance_opt.initial.stacks import without_stacks

if TYPE_CHECKING:
    from collections.abc import Callable

BOUNDARY_WEIGHT = 1.0
"""Weight of the planes that hold open boundaries in place, relative to a face of the same size."""

POINT_WEIGHT = 1e-4
"""Weight of the distance to the original vertices, relative to that of the planes: it keeps
triangles well shaped where the surface is flat (after Liu, Rahimzadeh and Zordan 2025, line
quadrics)."""

ROUND_FRACTION, EARLY_FRACTION = 0.12, 0.5
"""Share of all edges, cheapest first, among which a round chooses. Smaller is closer to one
collapse at a time, and slower. Early rounds, far from the budget, can be bolder: what they collapse
would go anyway."""

EARLY = 6
"""Rounds are early while there are more than this many times the budget of triangles."""

BOLD, LARGE = 8, 20_000
"""Rounds are bold while there are more than this many times the budget of triangles, and more than
``LARGE``: smaller meshes are quick anyway."""

ALIKE = 4.0
"""In bold rounds, costs within this factor of one another count as equal, and such edges are taken
in random order. Costs vary smoothly over a fine mesh, so that few edges are the very cheapest
around: a round would collapse 1 % of all edges, and collapses 4 %."""

BOLD_PASSES = 6
"""How often a bold round chooses among the edges whose neighbourhoods are still free (Luby 1986). A
pass costs a tenth of what the costs do. In late rounds it would take expensive edges beside cheap
ones: they choose once."""

BLOCK = 1 << 15
"""Edges whose costs are computed at once: their quadrics fit into a core's cache."""


def decimate(
    positions: NDArray,
    faces: NDArray,
    triangles: int,
    importance: NDArray | None = None,
    single_sided: NDArray | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """``decimate_with_source`` without the source."""
    return decimate_with_source(positions, faces, triangles, importance, single_sided)[:2]


def decimate_with_source(
    positions: NDArray,
    faces: NDArray,
    triangles: int,
    importance: NDArray | None = None,
    single_sided: NDArray | None = None,
    owner: NDArray | None = None,
    told: Callable[[int], None] = lambda _: None,
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int64]]:
    """At most ``triangles`` triangles that look like the given ones.

    ``positions`` (V, 3), ``faces`` (F, 3): any triangle soup; vertices at one place are welded, so
    that attribute seams are no borders. ``importance`` (F,): non-negative weight of each face, 1 by
    default. ``single_sided`` (F,): faces that are seen from their front only; none are by default.
    ``owner`` (F,): number of the part to which each belongs, one for all by default: where parts
    touch their vertices move together, so that no gap opens, and no edge between them is flipped.
    Faces that lie on others and add nothing to any image go first (see ``stacks``). Parts that
    would cost more than they show are dropped as a whole. ``told``: called before rounds with the
    number of triangles that are left.

    Returns welded positions, faces, and for each of these one of the given faces that it comes
    from, which has the same sidedness. The count falls short of the budget by one or two at most,
    unless no legal collapse is left; no faces are returned if no collapse whatever reaches the
    budget.
    """
    centre, scale = _centre_and_scale(positions)
    first, place = weld(np.asarray(positions))
    p = (np.asarray(positions, np.float64)[first] - centre) / scale
    f = place[np.asarray(faces)].astype(np.int64)
    weight = np.ones(len(f)) if importance is None else np.asarray(importance, np.float64)
    single = np.zeros(len(f), bool) if single_sided is None else np.asarray(single_sided, bool)
    source = np.flatnonzero((f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0]))
    kept, weight, sides = without_stacks(p, f[source], weight[source], single[source])
    source = source[kept]
    f = f[source]
    state = State(p, vertex_quadrics(p, f, weight, sides, single[source]), f, source, single)
    for freedom in (STRICT, TURNING):
        state.blocked = state.blocked[:0]
        while (
            len(state.faces) > triangles
            and (price := _round(state, triangles, freedom)) is not None
        ):
            told(len(state.faces))
            if len(state.faces) <= EARLY * triangles:
                drop_cheap_parts(state, triangles, price)
    if len(state.faces) > triangles:
        drop_smallest_parts(state, triangles)
        state.blocked = state.blocked[:0]
        while len(state.faces) > triangles and _round(state, triangles, TEARING) is not None:
            pass
    if len(state.faces) > triangles:
        state.keep(np.zeros(len(state.faces), bool))
    kind = single.astype(np.int64) if owner is None else 2 * owner.astype(np.int64) + single
    state.faces, _ = flip_edges(state.positions, state.faces, kind[state.source], state.quadrics)
    used, compact = np.unique(state.faces, return_inverse=True)
    return (
        state.positions[used] * scale + centre,
        compact.reshape(-1, 3).astype(np.int32),
        state.source,
    )


def vertex_quadrics(
    positions: NDArray, faces: NDArray, importance: NDArray, sides: Sides, single_sided: NDArray
) -> NDArray:
    """(V, 10): planes of the faces around each vertex, planes that hold boundaries, original
    points."""
    p0, p1, p2 = (positions[faces[:, k]] for k in range(3))
    cross = np.cross(p1 - p0, p2 - p0)
    area = 0.5 * np.linalg.norm(cross, axis=1)
    weight = area * importance / 3
    q = quadrics.of_planes(unit(cross), p0, weight)
    total = np.zeros((len(positions), quadrics.SIZE))
    share = np.zeros((len(positions), 1))
    for k in range(3):
        accumulate(total, faces[:, k], q)
        accumulate(share, faces[:, k], weight[:, None])
    _add_boundaries(total, positions, faces, unit(cross), importance, sides, single_sided)
    return total + quadrics.of_points(positions, POINT_WEIGHT * share[:, 0])


def _add_boundaries(
    total: NDArray,
    positions: NDArray,
    faces: NDArray,
    normals: NDArray,
    importance: NDArray,
    sides: Sides,
    single_sided: NDArray,
) -> None:
    """Planes through the edges whose faces all have the same corners (one face, or the two sides of
    a sheet), and through those between faces that are seen from one side and from both."""
    opposite = faces[:, [2, 0, 1]].ravel()[3 * sides.face + sides.corner]
    alone = np.minimum.reduceat(opposite, sides.start) == np.maximum.reduceat(opposite, sides.start)
    if single_sided.any():
        one_way = single_sided[sides.face]
        alone |= np.logical_and.reduceat(one_way, sides.start) != np.logical_or.reduceat(
            one_way, sides.start
        )
    if not alone.any():
        return
    open_ = np.flatnonzero(np.repeat(alone, sides.uses))
    face, corner = sides.face[open_], sides.corner[open_]
    a, b = faces[face, corner], faces[face, (corner + 1) % 3]
    edge = positions[b] - positions[a]
    weight = BOUNDARY_WEIGHT * np.sum(edge**2, axis=1) * importance[face] / 2
    q = quadrics.of_planes(unit(np.cross(edge, normals[face])), positions[a], weight)
    accumulate(total, a, q)
    accumulate(total, b, q)


def _round(state: State, triangles: int, freedom: int) -> float | None:
    """Collapse an independent set of cheap edges. What the dearest of them cost (0 if none was
    legal); None when there is nothing left to try."""
    edges, uses = edges_of(state.faces)
    key = keys(edges[:, 0], edges[:, 1])
    if len(state.blocked):
        free = ~np.isin(key, state.blocked)
        edges, key = edges[free], key[free]
    if not len(edges):
        return None
    target, cost = _costs(state, edges)
    needed = (len(state.faces) - triangles + 1) // 2
    bold = len(state.faces) > max(BOLD * triangles, LARGE)
    fraction = EARLY_FRACTION if len(state.faces) > EARLY * triangles else ROUND_FRACTION
    limit = min(max(int(fraction * len(edges)), min(needed, 16), 1), len(edges))
    cheap = np.argpartition(cost, limit - 1)[:limit]
    rank = np.full(len(edges), len(edges))
    rank[cheap[_order(state, edges[cheap], cost[cheap], bold)]] = np.arange(limit)
    chosen = _independent(state, edges, rank, limit, BOLD_PASSES if bold else 1)
    allowed = legal(state, edges[chosen], target[chosen], freedom)
    state.blocked = np.concatenate([state.blocked, key[chosen[~allowed]]])
    chosen = chosen[allowed]
    chosen = chosen[np.argsort(rank[chosen])][:needed]
    collapse(state, edges[chosen], target[chosen], bool((uses > 2).any()))
    return float(cost[chosen].max(initial=0.0))


def _costs(state: State, edges: NDArray) -> tuple[NDArray, NDArray]:
    """(where each edge would collapse to (E, 3), what it costs (E,))."""
    target, cost = np.empty((len(edges), 3)), np.empty(len(edges))
    for start in range(0, len(edges), BLOCK):
        here = slice(start, start + BLOCK)
        a, b = edges[here].T
        q = state.quadrics[a] + state.quadrics[b]
        target[here] = quadrics.minimize(q, (state.positions[a] + state.positions[b]) / 2)
        # between a sum over the surface (which gives small parts away) and a mean (which forgets
        # large ones)
        size = np.sqrt(np.maximum(q[:, 0] + q[:, 3] + q[:, 5], 1e-300))
        cost[here] = quadrics.evaluate(q, target[here]) / size
    return target, cost


def _order(state: State, edges: NDArray, cost: NDArray, bold: bool) -> NDArray:
    """Indices of edges in the order in which they are to be collapsed."""
    if bold:
        order = np.random.default_rng(0).permutation(len(edges))
        level = np.floor(np.log(cost + 1e-300) / np.log(ALIKE))
        return order[np.argsort(level[order], kind="stable")]
    # of edges that cost the same (nothing, in flat regions) the shorter go first
    length = np.sum((state.positions[edges[:, 0]] - state.positions[edges[:, 1]]) ** 2, axis=1)
    return np.lexsort((length, cost))


def _independent(state: State, edges: NDArray, rank: NDArray, limit: int, passes: int) -> NDArray:
    """Edges of rank below ``limit`` that are the best around both of their ends, ``passes`` times
    over: no other chosen edge touches a vertex of the faces that they change."""
    n = len(state.positions)
    faces, left = state.faces, np.flatnonzero(rank < limit)
    chosen = []
    for _ in range(passes):
        e, r = edges[left], rank[left]
        best = np.full(n, np.iinfo(np.int64).max)
        np.minimum.at(best, e[:, 0], r)
        np.minimum.at(best, e[:, 1], r)
        face_best = np.minimum(np.minimum(best[faces[:, 0]], best[faces[:, 1]]), best[faces[:, 2]])
        ring = best.copy()
        for k in range(3):
            np.minimum.at(ring, faces[:, k], face_best)
        won = (ring[e[:, 0]] == r) & (ring[e[:, 1]] == r)
        chosen.append(left[won])
        near = np.zeros(n, bool)
        near[e[won].ravel()] = True
        changed = touching(near, faces)
        near[faces[changed].ravel()] = True
        faces, left = faces[~changed], left[~(near[e[:, 0]] | near[e[:, 1]])]
        if not len(left):
            break
    return np.concatenate(chosen)


def _centre_and_scale(positions: NDArray) -> tuple[NDArray, float]:
    """Centre and size: collapses are computed in a unit box, so that scale and offset do not
    matter."""
    p = np.asarray(positions, np.float64)
    low, high = p.min(axis=0), p.max(axis=0)
    return (low + high) / 2, max(float((high - low).max()), 1e-300)
