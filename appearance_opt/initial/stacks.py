"""Faces that lie on others and add nothing to any image.

Booleans and careless modelling leave them: a face twice, a flap of two triangles over the same
three corners, a fin that hangs on an edge of a flat face and lies in its plane. They would take a
part of the budget, and every one of them fights with what it lies on for the same pixels.

What is seen of a face are its sides: both of a double-sided one, the one that it faces of a
single-sided one. A face goes when each side that it shows is shown by others at the same place. Of
faces that coincide the first one stays, which is also the one that is drawn where depths are equal:
which copies go depends on the order of the faces alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from appearance_opt.asset.normals import unit
from appearance_opt.initial.edges import Sides, sides_of

TOLERANCE = 1e-5
"""How far from another face a point of a covered one may lie, in units of the mesh's box: positions
in single precision are exact to a hundredth of that."""

ANGLE, SEAM = 0.03, 0.3
"""Radians between faces at an edge up to which one lies on the other, and where their turns are
counted from."""

STEPS, CHOICES = 64, 32
"""Faces that a walk to a point may cross, and faces that it may choose from at an edge: beyond that
the point counts as not covered."""

LATTICE = 4
"""Points of a face that must be covered: a triangular lattice with this many intervals per side."""


def without_stacks(
    positions: NDArray, faces: NDArray, weight: NDArray, single_sided: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray, Sides]:
    """(indices of the faces that add something (N,), their weights, their sides). ``positions`` (V,
    3) of welded vertices in a unit box; ``faces`` (F, 3); ``weight`` (F,): a face that stays has
    the largest one of those that coincide with it; ``single_sided`` (F,): faces that are seen from
    their front only."""
    shown, weight = without_copies(faces, weight, single_sided)
    kept = np.flatnonzero(shown)
    while True:
        sides = sides_of(faces[kept])
        gone = _covered(positions, faces[kept], sides, single_sided[kept])
        if not gone.any():
            return kept, weight[kept], sides
        kept = kept[~gone]


def without_copies(
    faces: NDArray, weight: NDArray, single_sided: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray]:
    """((F,) faces but for those whose sides others over the same corners show; weights). See
    ``without_stacks``."""
    shown = np.ones(len(faces), bool)
    members, place = coincident(faces)
    if len(members):
        largest = np.zeros(place.max() + 1)
        np.maximum.at(largest, place, weight[members])
        weight = weight.copy()
        weight[members] = largest[place]
        shown[members] = _shows_first(faces[members], place, single_sided[members])
    return shown, weight


def coincident(faces: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(faces that share all three corners with another one (N,), in order; place of each, numbered
    from 0)."""
    corners = np.sort(faces, axis=1)
    hashed = _hash(corners)
    ordered = np.sort(hashed)
    twice = ordered[1:][ordered[1:] == ordered[:-1]]
    # few faces, if any, are looked at closely: sorting triples takes ten times as long as sorting
    # numbers
    members = np.flatnonzero(np.isin(hashed, twice)) if len(twice) else np.empty(0, np.int64)
    if not len(members):
        return members, members
    _, place, count = np.unique(corners[members], axis=0, return_inverse=True, return_counts=True)
    place = place.ravel()
    more = count[place] > 1
    return members[more], np.unique(place[more], return_inverse=True)[1].ravel()


def _hash(corners: NDArray) -> NDArray[np.uint64]:
    a, b, c = corners.astype(np.uint64).T
    mixed = a * np.uint64(0x9E3779B97F4A7C15) ^ (
        b * np.uint64(0xC2B2AE3D27D4EB4F) + c * np.uint64(0x165667B19E3779F9)
    )
    return mixed ^ (mixed >> np.uint64(29))


def _shows_first(faces: NDArray, place: NDArray, single_sided: NDArray) -> NDArray[np.bool_]:
    """(N,) faces that show a side of their place that no earlier one shows."""
    odd = _is_odd(faces)
    index = np.arange(len(faces))
    shows = np.concatenate([2 * place + odd, (2 * place + 1 - odd)[~single_sided]])
    owner = np.concatenate([index, index[~single_sided]])
    out = np.zeros(len(faces), bool)
    first = np.full(2 * (int(place.max()) + 1), len(faces))
    np.minimum.at(first, shows, owner)
    out[first[first < len(faces)]] = True
    return out


def _is_odd(faces: NDArray) -> NDArray[np.int64]:
    """(F,) 1 where the corners are an odd permutation of their order by number."""
    a, b, c = faces.T
    return ((a > b) ^ (b > c) ^ (a > c)).astype(np.int64)


def _covered(
    positions: NDArray, faces: NDArray, sides: Sides, single_sided: NDArray
) -> NDArray[np.bool_]:
    """(F,) faces that lie on others, of patches that hang on an edge of more than two faces.

    Patches are faces that are connected across edges of two. From the face that a patch lies on at
    such an edge, walks lead over the surface to points all over the patch. A face is covered if
    each walk to its points ends on a face that has the point and shows the same sides. Of faces
    that cover each other those of the largest patch stay.
    """
    gone = np.zeros(len(faces), bool)
    if not (sides.uses > 2).any():
        return gone
    patch = _patches(sides, len(faces))
    corners = positions[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.bincount(patch, 0.5 * np.linalg.norm(cross, axis=1))
    ground = _grounds(sides, faces, positions, unit(cross), patch, area)
    tried = np.flatnonzero(ground[patch] >= 0)
    if not len(tried):
        return gone
    i, j = np.meshgrid(np.arange(LATTICE + 1), np.arange(LATTICE + 1))
    inside = i + j <= LATTICE
    lattice = np.stack([i[inside], j[inside], (LATTICE - i - j)[inside]], axis=1) / LATTICE
    lattice = 0.98 * lattice + 0.02 / 3  # corners and sides belong to neighbours as well
    points = np.einsum("lk,fkc->flc", lattice, corners[tried]).reshape(-1, 3)
    owner = np.repeat(tried, len(lattice))
    walk = _Walk(sides, faces, corners, unit(cross), patch)
    end = walk.to(points, ground[patch[owner]], patch[owner])
    facing = np.sum(walk.normals[end] * walk.normals[owner], axis=1) > 0
    shown = (end >= 0) & (~single_sided[end] | (single_sided[owner] & facing))
    gone[tried] = True
    gone[owner[~shown]] = False
    rank = np.empty(len(area), np.int64)
    rank[np.lexsort((-np.arange(len(area)), area))] = np.arange(len(area))
    gone[owner[gone[end] & (rank[patch[end]] < rank[patch[owner]])]] = False
    return gone


def _patches(sides: Sides, count: int) -> NDArray[np.int32]:
    """(F,) patch of each face: faces are connected across edges of two."""
    at = sides.start[sides.uses == 2]
    a, b = sides.face[at], sides.face[at + 1]
    return connected_components(
        coo_matrix((np.ones(len(a)), (a, b)), (count, count)), directed=False
    )[1]


def _grounds(
    sides: Sides,
    faces: NDArray,
    positions: NDArray,
    normals: NDArray,
    patch: NDArray,
    area: NDArray,
) -> NDArray[np.int64]:
    """(patches,) a face of a larger patch that a patch lies on at one of its edges; -1 where there
    is none."""
    first, last, _ = sides.corners(faces)
    many = np.flatnonzero(np.repeat(sides.uses, sides.uses) > 2)
    face = sides.face[many]
    low, high = np.minimum(first, last)[many], np.maximum(first, last)[many]
    _, edge = np.unique(np.stack([low, high], axis=1), axis=0, return_inverse=True)
    inward = _inward(positions[faces], normals, face, sides.corner[many])
    group = _same_way(edge.ravel(), positions[high] - positions[low], inward)
    order = np.lexsort((-face, area[patch[face]], group))
    largest = np.zeros(int(group.max()) + 1, np.int64)
    largest[group[order]] = face[order]
    under = largest[group]
    lies = patch[under] != patch[face]
    out = np.full(len(area), -1, np.int64)
    out[patch[face[lies]]] = under[lies]
    return out


def _same_way(edge: NDArray, along: NDArray, inward: NDArray) -> NDArray[np.int64]:
    """(N,) group of each side, from 0: sides of one ``edge`` (N,) that lead the same way from it.
    ``along`` (N, 3): the edge; ``inward`` (N, 3): where the side's face lies."""
    begins = np.zeros(int(edge.max()) + 1, np.int64)
    begins[edge[::-1]] = np.arange(len(edge))[::-1]
    reference = inward[begins[edge]]
    sine = np.sum(np.cross(reference, inward) * unit(along), axis=1)
    # turns are counted from a little before the first face: what lies in its plane must not be cut
    # at half a turn
    turn = np.mod(np.arctan2(sine, np.sum(reference * inward, axis=1)) + SEAM, 2 * np.pi)
    order = np.lexsort((turn, edge))
    new = np.concatenate([[False], (np.diff(edge[order]) > 0) | (np.diff(turn[order]) > ANGLE)])
    group = np.empty(len(edge), np.int64)
    group[order] = np.cumsum(new)
    return group


def _inward(corners: NDArray, normals: NDArray, face: NDArray, corner: NDArray) -> NDArray:
    """Unit vectors in the plane of faces, perpendicular to a side, to their inside."""
    along = corners[face, (corner + 1) % 3] - corners[face, corner]
    return unit(np.cross(normals[face], along))


class _Walk:
    """Straight walks over the faces of a mesh to points near it, past edges of any number of
    faces."""

    def __init__(
        self, sides: Sides, faces: NDArray, corners: NDArray, normals: NDArray, patch: NDArray
    ) -> None:
        self.sides, self.corners, self.normals, self.patch = sides, corners, normals, patch
        self._edge = np.empty((len(faces), 3), np.int64)
        self._edge[sides.face, sides.corner] = np.repeat(np.arange(len(sides.start)), sides.uses)

    def to(self, points: NDArray, start: NDArray, avoided: NDArray) -> NDArray[np.int64]:
        """(N,) the face that has each of the points (N, 3), on a walk from the face ``start`` that
        does not enter the patch ``avoided``; -1 where it leads nowhere."""
        at = start.copy()
        out = np.full(len(points), -1, np.int64)
        left = np.arange(len(points))
        for _ in range(STEPS):
            f, x = at[left], points[left]
            c, n = self.corners[f], self.normals[f]
            # signed distance of the point from each side, in the plane of the face, positive inside
            distance = np.empty((len(f), 3))
            for k in range(3):
                inward = _inward(self.corners, self.normals, f, np.full(len(f), k))
                distance[:, k] = np.sum(inward * (x - c[:, k]), axis=1)
            worst = np.argmin(distance, axis=1)
            inside = distance[np.arange(len(f)), worst] >= -TOLERANCE
            near = np.abs(np.sum(n * (x - c[:, 0]), axis=1)) <= TOLERANCE
            out[left[inside & near]] = f[inside & near]
            left, f, worst = left[~inside], f[~inside], worst[~inside]
            if not len(left):
                break
            following = self._across(f, worst, avoided[left])
            at[left] = following
            left = left[following >= 0]
        return out

    def _across(self, face: NDArray, corner: NDArray, avoided: NDArray) -> NDArray[np.int64]:
        """The face that goes on across the side at ``corner``: of those outside of the patch
        ``avoided`` the one in the plane of ``face``, or nearest to it; -1 if there is none."""
        s = self.sides
        edge = self._edge[face, corner]
        inward = _inward(self.corners, self.normals, face, corner)
        out, best = np.full(len(face), -1, np.int64), np.full(len(face), 0.0)
        uses = s.uses[edge]
        for k in range(min(int(uses.max(initial=0)), CHOICES)):
            there = np.flatnonzero(k < uses)
            side = s.start[edge[there]] + k
            other, where = s.face[side], s.corner[side]
            on = -np.sum(inward[there] * _inward(self.corners, self.normals, other, where), axis=1)
            better = (
                (other != face[there]) & (self.patch[other] != avoided[there]) & (on > best[there])
            )
            out[there[better]], best[there[better]] = other[better], on[better]
        return out
