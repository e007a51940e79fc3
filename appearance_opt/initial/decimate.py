"""Edge collapse to an exact budget, in rounds of independent collapses.

The metric is Garland and Heckbert's, with faces weighted by area times an importance that the caller
gives: how much of the face an observer sees. Instead of one collapse at a time, each round collapses all
cheap edges that are the cheapest of their neighbourhood; their neighbourhoods do not touch, so a round is a
handful of array operations. Far from the budget, rounds are bolder: see ``BOLD``. What libraries do instead, and
why it was not enough, is in docs/design.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.normals import accumulate, unit, weld
from appearance_opt.initial import quadrics

BOUNDARY_WEIGHT = 1.0
"""Weight of the planes that hold open boundaries in place, relative to a face of the same size."""

POINT_WEIGHT = 1e-4
"""Weight of the distance to the original vertices, relative to that of the planes: it keeps triangles well
shaped where the surface is flat (after Liu, Rahimzadeh and Zordan 2025, line quadrics)."""

MINIMUM_COSINE = -0.6
"""A collapse may not turn the normal of a face it keeps by more than the angle of this cosine. Thin parts need
a loose bound: with 0.2 it forbids all cheap collapses there (flight_helmet loses 2 dB)."""

ROUND_FRACTION, EARLY_FRACTION = 0.12, 0.5
"""Share of all edges, cheapest first, among which a round chooses. Smaller is closer to one collapse at a
time, and slower. Early rounds, far from the budget, can be bolder: what they collapse would go anyway."""

EARLY = 6
"""Rounds are early while there are more than this many times the budget of triangles."""

BOLD, LARGE = 8, 20_000
"""Rounds are bold while there are more than this many times the budget of triangles, and more than ``LARGE``: smaller
meshes are quick anyway."""

ALIKE = 4.0
"""In bold rounds, costs within this factor of one another count as equal, and such edges are taken in random order.
Costs vary smoothly over a fine mesh, so that few edges are the very cheapest around: a round would collapse 1 % of all
edges, and collapses 4 %."""

BOLD_PASSES = 6
"""How often a bold round chooses among the edges whose neighbourhoods are still free (Luby 1986). A pass costs a tenth
of what the costs do. In late rounds it would take expensive edges beside cheap ones: they choose once."""

STRICT, TURNING, TEARING = range(3)
"""What a collapse may do when nothing better is left: turn faces over, then change the topology, too."""

LOST = 0.03
"""What it costs to drop a connected part, in units of its weight times its diameter squared: as if its surface moved by
a sixth of its diameter. Between 0.01 and 0.1 flight_helmet's start changes by less than a decibel."""

BLOCK = 1 << 15
"""Edges whose costs are computed at once: their quadrics fit into a core's cache."""


@dataclass
class _State:
    """The mesh between rounds. ``quadrics``: (V, 10); ``faces``: live faces only; ``blocked``: edges whose
    collapse is illegal as long as the faces around them do not change; ``part``: see ``_parts``."""

    positions: NDArray[np.float64]
    quadrics: NDArray[np.float64]
    faces: NDArray[np.int64]
    blocked: NDArray[np.int64]
    part: NDArray | None = None


def decimate(
    positions: NDArray, faces: NDArray, triangles: int, importance: NDArray | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """At most ``triangles`` triangles that look like the given ones.

    ``positions`` (V, 3), ``faces`` (F, 3): any triangle soup; vertices at one place are welded, so that
    attribute seams are no borders. ``importance`` (F,): non-negative weight of each face, 1 by default.
    Parts that would cost more than they show are dropped as a whole. Returns welded positions and faces;
    the count falls short of the budget by one or two at most, unless no legal collapse is left; none are returned if
    no collapse whatever reaches the budget.
    """
    centre, scale = _frame(positions)
    first, place = weld(np.asarray(positions))
    p = (np.asarray(positions, np.float64)[first] - centre) / scale
    f = place[np.asarray(faces)].astype(np.int64)
    weight = np.ones(len(f)) if importance is None else np.asarray(importance, np.float64)
    proper = (f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])
    proper[proper] = _first_of_their_kind(f[proper], len(p))
    f, weight = f[proper], weight[proper]
    none = np.empty(0, np.int64)
    state = _State(p, vertex_quadrics(p, f, weight), f, none)
    for freedom in (STRICT, TURNING):
        state.blocked = none
        while len(state.faces) > triangles and (price := _round(state, triangles, freedom)) is not None:
            if len(state.faces) <= EARLY * triangles:
                _drop_cheap_parts(state, triangles, price)
    if len(state.faces) > triangles:
        _drop_smallest_parts(state, triangles)
        state.blocked = none
        while len(state.faces) > triangles and _round(state, triangles, TEARING) is not None:
            pass
    if len(state.faces) > triangles:
        state.faces = state.faces[:0]
    used, compact = np.unique(state.faces, return_inverse=True)
    return state.positions[used] * scale + centre, compact.reshape(-1, 3).astype(np.int32)


def _first_of_their_kind(faces: NDArray, vertices: int) -> NDArray[np.bool_]:
    """(F,) faces that are not the same as an earlier one: meshes that lie twice at one place would take the budget
    twice. Two sides of a sheet are not the same."""
    start = np.argmin(faces, axis=1)[:, None]
    a, b, c = np.take_along_axis(faces, (start + np.arange(3)) % 3, axis=1).T
    # one number for two corners, then one for those and the third: three may not fit into 64 bits
    _, pair = np.unique(a * vertices + b, return_inverse=True)
    _, first = np.unique(pair * vertices + c, return_index=True)
    out = np.zeros(len(faces), bool)
    out[first] = True
    return out


def vertex_quadrics(positions: NDArray, faces: NDArray, importance: NDArray) -> NDArray:
    """(V, 10): planes of the faces around each vertex, planes that hold boundaries, original points."""
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
    _add_boundaries(total, positions, faces, unit(cross), importance)
    return total + quadrics.of_points(positions, POINT_WEIGHT * share[:, 0])


def _add_boundaries(total: NDArray, positions: NDArray, faces: NDArray, normals: NDArray, importance: NDArray) -> None:
    start, end = faces.T.ravel(), faces[:, [1, 2, 0]].T.ravel()
    face = np.tile(np.arange(len(faces)), 3)
    _, inverse, uses = np.unique(_keys(start, end), return_inverse=True, return_counts=True)
    open_ = np.flatnonzero(uses[inverse] == 1)
    if not len(open_):
        return
    a, b, face = start[open_], end[open_], face[open_]
    edge = positions[b] - positions[a]
    weight = BOUNDARY_WEIGHT * np.sum(edge**2, axis=1) * importance[face] / 2
    q = quadrics.of_planes(unit(np.cross(edge, normals[face])), positions[a], weight)
    accumulate(total, a, q)
    accumulate(total, b, q)


def _round(state: _State, triangles: int, freedom: int) -> float | None:
    """Collapse an independent set of cheap edges. What the dearest of them cost (0 if none was legal); None when there
    is nothing left to try."""
    edges, uses = _edges(state.faces)
    keys = _keys(edges[:, 0], edges[:, 1])
    if len(state.blocked):
        free = ~np.isin(keys, state.blocked)
        edges, uses, keys = edges[free], uses[free], keys[free]
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
    legal = _legal(state, edges[chosen], target[chosen], uses[chosen], freedom)
    state.blocked = np.concatenate([state.blocked, keys[chosen[~legal]]])
    chosen = chosen[legal]
    chosen = chosen[np.argsort(rank[chosen])][:needed]
    _collapse(state, edges[chosen], target[chosen])
    return float(cost[chosen].max(initial=0.0))


def _costs(state: _State, edges: NDArray) -> tuple[NDArray, NDArray]:
    """(where each edge would collapse to (E, 3), what it costs (E,))."""
    target, cost = np.empty((len(edges), 3)), np.empty(len(edges))
    for start in range(0, len(edges), BLOCK):
        here = slice(start, start + BLOCK)
        a, b = edges[here].T
        q = state.quadrics[a] + state.quadrics[b]
        target[here] = quadrics.minimize(q, (state.positions[a] + state.positions[b]) / 2)
        # between a sum over the surface (which gives small parts away) and a mean (which forgets large ones)
        size = np.sqrt(np.maximum(q[:, 0] + q[:, 3] + q[:, 5], 1e-300))
        cost[here] = quadrics.evaluate(q, target[here]) / size
    return target, cost


def _order(state: _State, edges: NDArray, cost: NDArray, bold: bool) -> NDArray:
    """Indices of edges in the order in which they are to be collapsed."""
    if bold:
        order = np.random.default_rng(0).permutation(len(edges))
        level = np.floor(np.log(cost + 1e-300) / np.log(ALIKE))
        return order[np.argsort(level[order], kind="stable")]
    # of edges that cost the same (nothing, in flat regions) the shorter go first
    length = np.sum((state.positions[edges[:, 0]] - state.positions[edges[:, 1]]) ** 2, axis=1)
    return np.lexsort((length, cost))


def _independent(state: _State, edges: NDArray, rank: NDArray, limit: int, passes: int) -> NDArray:
    """Edges of rank below ``limit`` that are the best around both of their ends, ``passes`` times over: no other
    chosen edge touches a vertex of the faces that they change."""
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
        changed = _touching(near, faces)
        near[faces[changed].ravel()] = True
        faces, left = faces[~changed], left[~(near[e[:, 0]] | near[e[:, 1]])]
        if not len(left):
            break
    return np.concatenate(chosen)


def _legal(state: _State, edges: NDArray, target: NDArray, uses: NDArray, freedom: int) -> NDArray[np.bool_]:
    """Collapses that keep the topology (link condition: the ends share as many neighbours as faces) and
    turn no face over, as far as ``freedom`` demands it."""
    n = len(edges)
    if not n:
        return np.zeros(0, bool)
    owner = np.full(len(state.positions), -1, np.int64)
    owner[edges[:, 0]] = np.arange(n)
    owner[edges[:, 1]] = np.arange(n)
    faces = state.faces[_touching(owner >= 0, state.faces)]
    owned = owner[faces]
    which = owned.max(axis=1)  # chosen edges share no face: each face has one owner
    inside = (owned >= 0).sum(axis=1)
    legal = np.ones(n, bool) if freedom == TEARING else _link_condition(faces, which, inside, edges, uses)
    kept = inside == 1
    faces, owned, which = faces[kept], owned[kept], which[kept]
    before = state.positions[faces]
    after = np.where((owned >= 0)[..., None], target[which][:, None, :], before)
    normal = np.cross(before[:, 1] - before[:, 0], before[:, 2] - before[:, 0])
    moved = np.cross(after[:, 1] - after[:, 0], after[:, 2] - after[:, 0])
    sizes = np.linalg.norm(normal, axis=1) * np.linalg.norm(moved, axis=1)
    turned = np.sum(normal * moved, axis=1) < (MINIMUM_COSINE if freedom == STRICT else -1.1) * sizes
    turned |= np.linalg.norm(moved, axis=1) < 1e-14
    legal[which[turned]] = False
    return legal


def _link_condition(
    faces: NDArray, which: NDArray, inside: NDArray, edges: NDArray, uses: NDArray
) -> NDArray[np.bool_]:
    """(N,) edges whose ends have exactly as many common neighbours as the edge has faces."""
    kept = inside == 1
    f, w = faces[kept], which[kept]
    ends = edges[w]
    end = np.where((f == ends[:, :1]).any(axis=1), 0, 1)
    two = faces[inside == 2]
    own = which[inside == 2]
    third = two[(two != edges[own, :1]) & (two != edges[own, 1:])]
    # one number per (chosen edge, neighbour, end that has it): twice the same edge and neighbour is a common one
    n = int(faces.max(initial=0)) + 1
    pairs = [2 * (own * n + third) + side for side in (0, 1)]
    for k in range(3):
        other = f[:, k]
        is_end = (other == ends[:, 0]) | (other == ends[:, 1])
        pairs.append((2 * (w * n + other) + end)[~is_end])
    found = np.sort(np.concatenate(pairs))
    found = found[np.concatenate([[True], found[1:] != found[:-1]])[: len(found)]] // 2
    common = np.bincount(found[1:][found[1:] == found[:-1]] // n, minlength=len(edges))
    # a part that is down to a tetrahedron or a triangle must not collapse any further
    around = np.bincount(which[kept], minlength=len(edges))
    return (common == uses) & (uses <= 2) & (around > 2)


def _collapse(state: _State, edges: NDArray, target: NDArray) -> None:
    state.positions[edges[:, 0]] = target
    state.quadrics[edges[:, 0]] += state.quadrics[edges[:, 1]]
    new = np.arange(len(state.positions))
    new[edges[:, 1]] = edges[:, 0]
    f = new[state.faces]
    alive = (f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])
    state.faces = f[alive]
    # what was illegal around a collapse may be legal now
    moved = np.zeros(len(state.positions), bool)
    moved[edges[:, 0]] = True
    near = moved.copy()
    near[state.faces[_touching(moved, state.faces)].ravel()] = True
    gone = new[state.blocked >> 32] != state.blocked >> 32
    gone |= new[state.blocked & 0xFFFFFFFF] != state.blocked & 0xFFFFFFFF
    state.blocked = state.blocked[~(gone | near[state.blocked >> 32] | near[state.blocked & 0xFFFFFFFF])]


def _parts(state: _State) -> NDArray:
    """(V,) the connected part that each vertex belongs to. Found once: collapses neither join parts nor split them."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if state.part is None:
        n, f = len(state.positions), state.faces
        ends = f[:, [0, 1]].ravel(), f[:, [1, 2]].ravel()
        graph = coo_matrix((np.ones(2 * len(f)), ends), (n, n))
        state.part = connected_components(graph, directed=False)[1]
    return state.part


def _drop_cheap_parts(state: _State, triangles: int, price: float) -> None:
    """Remove connected parts whose loss costs less than their triangles are worth elsewhere: ``price`` for every two.
    No part collapses to nothing, so that many small ones would take what the large ones need."""
    part = _parts(state)
    of_face = part[state.faces[:, 0]]
    count = np.bincount(of_face)
    here = np.flatnonzero(count)
    if len(here) == 1:
        return
    alive = np.zeros(len(part), bool)
    alive[state.faces.ravel()] = True
    used = np.flatnonzero(alive)
    low, high = np.full((len(count), 3), np.inf), np.full((len(count), 3), -np.inf)
    np.minimum.at(low, part[used], state.positions[used])
    np.maximum.at(high, part[used], state.positions[used])
    q = state.quadrics[used]
    weight = np.bincount(part[used], q[:, 0] + q[:, 3] + q[:, 5])
    squared_diameter = np.sum((high[here] - low[here]) ** 2, axis=1)
    cost = np.full(len(count), np.inf)  # of what is gone already
    cost[here] = LOST * np.sqrt(weight[here]) * squared_diameter * 2 / count[here]
    order = np.argsort(cost)
    excess = len(state.faces) - triangles
    gone = order[(cost[order] < price) & (np.cumsum(count[order]) <= excess)]
    gone = gone[weight[gone] < weight.max()]
    state.faces = state.faces[~np.isin(of_face, gone)]


def _drop_smallest_parts(state: _State, triangles: int) -> None:
    """Remove whole connected parts, the smallest first, until the budget is met or the largest is left."""
    f = state.faces
    of_face = _parts(state)[f[:, 0]]
    p = state.positions[f]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    count = np.bincount(of_face)
    order = np.argsort(np.bincount(of_face, area))
    excess = len(f) - triangles
    gone = np.cumsum(count[order]) - count[order] < excess
    gone[-1] = False
    state.faces = f[~np.isin(of_face, order[gone])]


def _touching(marked: NDArray[np.bool_], faces: NDArray) -> NDArray[np.bool_]:
    """(F,) faces with a marked vertex."""
    return marked[faces[:, 0]] | marked[faces[:, 1]] | marked[faces[:, 2]]


def _edges(faces: NDArray) -> tuple[NDArray, NDArray]:
    """(E, 2) unique edges and the number of faces at each."""
    start, end = faces.T.ravel(), faces[:, [1, 2, 0]].T.ravel()
    keys, uses = np.unique(_keys(start, end), return_counts=True)
    return np.stack([keys >> 32, keys & 0xFFFFFFFF], axis=1), uses


def _keys(a: NDArray, b: NDArray) -> NDArray[np.int64]:
    """One number per undirected edge."""
    return (np.minimum(a, b).astype(np.int64) << 32) | np.maximum(a, b)


def _frame(positions: NDArray) -> tuple[NDArray, float]:
    """Centre and size: collapses are computed in a unit box, so that scale and offset do not matter."""
    p = np.asarray(positions, np.float64)
    low, high = p.min(axis=0), p.max(axis=0)
    return (low + high) / 2, max(float((high - low).max()), 1e-300)
