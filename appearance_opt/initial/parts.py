"""Connected parts of a mesh that go as a whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from appearance_opt.initial.collapse import State

LOST = 0.03
"""What it costs to drop a connected part, in units of its weight times its diameter squared: as if
its surface moved by a sixth of its diameter. Between 0.01 and 0.1 flight_helmet's start changes by
less than a decibel."""


def parts(state: State) -> NDArray:
    """(V,) the connected part that each vertex belongs to. Found once: collapses neither join parts
    nor split them."""
    if state.part is None:
        n, f = len(state.positions), state.faces
        ends = f[:, [0, 1]].ravel(), f[:, [1, 2]].ravel()
        graph = coo_matrix((np.ones(2 * len(f)), ends), (n, n))
        state.part = connected_components(graph, directed=False)[1]
    return state.part


def drop_cheap_parts(state: State, triangles: int, price: float) -> None:
    """Remove connected parts whose loss costs less than their triangles are worth elsewhere:
    ``price`` for every two. No part collapses to nothing, so that many small ones would take what
    the large ones need."""
    part = parts(state)
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
    state.keep(~np.isin(of_face, gone))


def drop_smallest_parts(state: State, triangles: int) -> None:
    """Remove whole connected parts, the smallest first, until the budget is met or the largest is
    left."""
    f = state.faces
    of_face = parts(state)[f[:, 0]]
    p = state.positions[f]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    count = np.bincount(of_face)
    order = np.argsort(np.bincount(of_face, area))
    excess = len(f) - triangles
    gone = np.cumsum(count[order]) - count[order] < excess
    gone[-1] = False
    state.keep(~np.isin(of_face, order[gone]))
