"""The mesh between rounds of collapses: which collapses are legal, and carrying them out."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from appearance_opt.initial.edges import touching
from appearance_opt.initial.stacks import without_copies

MINIMUM_COSINE = -0.6  # docs/trials.md: decimation
"""A collapse may not turn the normal of a face it keeps by more than the angle of this cosine: thin
parts need a loose bound."""

STRICT, TURNING, TEARING = range(3)
"""What a collapse may do when nothing better is left: turn faces over, then change the topology,
too."""


@dataclass
class State:
    """``positions`` (V, 3); ``quadrics``: (V, 10); ``faces`` (F, 3): live faces only; ``source``
    (F,): the face of the input that each comes from; ``single_sided``: by faces of the input;
    ``blocked``: edges whose collapse is illegal as long as the faces around them do not change;
    ``part``: see ``parts``."""

    positions: NDArray[np.float64]
    quadrics: NDArray[np.float64]
    faces: NDArray[np.int64]
    source: NDArray[np.int64]
    single_sided: NDArray[np.bool_]
    blocked: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    part: NDArray | None = None

    def keep(self, faces: NDArray[np.bool_]) -> None:
        """Forget all other faces."""
        self.faces, self.source = self.faces[faces], self.source[faces]


def legal(state: State, edges: NDArray, target: NDArray, freedom: int) -> NDArray[np.bool_]:
    """(N,) collapses of ``edges`` (N, 2) to ``target`` (N, 3) that keep the topology and turn no
    face over, as far as ``freedom`` demands it."""
    n = len(edges)
    if not n:
        return np.zeros(0, bool)
    owner = np.full(len(state.positions), -1, np.int64)
    owner[edges[:, 0]] = np.arange(n)
    owner[edges[:, 1]] = np.arange(n)
    faces = state.faces[touching(owner >= 0, state.faces)]
    owned = owner[faces]
    which = owned.max(axis=1)  # chosen edges share no face: each face has one owner
    inside = (owned >= 0).sum(axis=1)
    out = np.ones(n, bool) if freedom == TEARING else _link_condition(faces, which, inside, edges)
    kept = inside == 1
    faces, owned, which = faces[kept], owned[kept], which[kept]
    before = state.positions[faces]
    after = np.where((owned >= 0)[..., None], target[which][:, None, :], before)
    normal = np.cross(before[:, 1] - before[:, 0], before[:, 2] - before[:, 0])
    moved = np.cross(after[:, 1] - after[:, 0], after[:, 2] - after[:, 0])
    sizes = np.linalg.norm(normal, axis=1) * np.linalg.norm(moved, axis=1)
    turned = (
        np.sum(normal * moved, axis=1) < (MINIMUM_COSINE if freedom == STRICT else -1.1) * sizes
    )
    turned |= np.linalg.norm(moved, axis=1) < 1e-14
    out[which[turned]] = False
    return out


def _link_condition(
    faces: NDArray, which: NDArray, inside: NDArray, edges: NDArray
) -> NDArray[np.bool_]:
    """(N,) edges whose ends have no common neighbours but the opposite corners of the edge's faces
    (Dey et al. 1999). How many faces an edge has does not matter: a wall that stands on a floor,
    the two sides of a sheet."""
    kept = inside == 1
    f, w = faces[kept], which[kept]
    ends = edges[w]
    end = np.where((f == ends[:, :1]).any(axis=1), 0, 1)
    two = faces[inside == 2]
    own = which[inside == 2]
    third = two[(two != edges[own, :1]) & (two != edges[own, 1:])]
    # one number per (chosen edge, neighbour, end that has it): twice the same edge and neighbour is
    # a common one
    n = int(faces.max(initial=0)) + 1
    opposite = np.bincount(np.unique(own * n + third) // n, minlength=len(edges))
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
    return (common == opposite) & (around > 2)


def collapse(state: State, edges: NDArray, target: NDArray, branched: bool) -> None:
    """Collapse ``edges`` (N, 2), none of which touches a face of another, to ``target`` (N, 3).
    ``branched``: does any edge have more than two faces? Then faces may come to coincide."""
    state.positions[edges[:, 0]] = target
    state.quadrics[edges[:, 0]] += state.quadrics[edges[:, 1]]
    new = np.arange(len(state.positions))
    new[edges[:, 1]] = edges[:, 0]
    f = new[state.faces]
    alive = (f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])
    state.faces, state.source = f[alive], state.source[alive]
    # what was illegal around a collapse may be legal now
    moved = np.zeros(len(state.positions), bool)
    moved[edges[:, 0]] = True
    changed = touching(moved, state.faces)
    near = moved.copy()
    near[state.faces[changed].ravel()] = True
    gone = new[state.blocked >> 32] != state.blocked >> 32
    gone |= new[state.blocked & 0xFFFFFFFF] != state.blocked & 0xFFFFFFFF
    state.blocked = state.blocked[
        ~(gone | near[state.blocked >> 32] | near[state.blocked & 0xFFFFFFFF])
    ]
    if branched:
        here = np.flatnonzero(changed)
        shown, _ = without_copies(
            state.faces[here], np.zeros(len(here)), state.single_sided[state.source[here]]
        )
        state.keep(np.isin(np.arange(len(state.faces)), here[~shown], invert=True))
