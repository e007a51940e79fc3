"""Normals of shapes that come without: smooth within smoothing sets, hard between them.

Formats say in different ways which edges are smooth: by smoothing groups (OBJ), or not at all (STL,
PLY). A face corner shares its normal with those corners at the same place that it reaches over
smooth edges; vertices are split where there are several such sets.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from appearance_opt.asset.batch import Batch, in_range
from appearance_opt.asset.edges import Edges
from appearance_opt.asset.normals import split_where_cancelled, summed_normals, weld

if TYPE_CHECKING:
    from collections.abc import Sequence

    from appearance_opt.asset.types import Mesh

SHARP = np.radians(40.0)
"""Angle between the normals of two faces from which on the edge between them is hard: the rims of
CAD parts and their chamfers, but no facet of a cylinder of ten or more."""

NOISE_FACTOR = 4.0
"""An edge is hard only if its angle is this many times the roughness around it, see ``roughness``.
Of a sphere whose vertices are displaced by a third of an edge, which makes 40 % of its edges sharp,
0.6 % of the vertices are split then, and 3 % with a factor of 3; the edges of 20 CAD parts stay
hard with both."""

LOOSE_ENDS = 3
"""How often the loose ends of creases are taken off: in noise, what is left is short. Creases of
CAD parts end at borders and other creases."""

FOLDED = np.cos(np.radians(179.0))
"""Cosine of the angle from which on faces lie back to back: the rim of a sheet that is modelled
with two sides is never smooth, for their normals cancel."""

FLAT = np.radians(1.0)
"""Angles up to about this count as flat: rounded coordinates bend planes by less."""

TYPICAL = 1.2
"""Of angles that are normally distributed the geometric mean is 0.53 deviations. So many times that
is about what their mean size is after they have partly cancelled each other."""


def smooth_by_angle(
    positions: NDArray, faces: NDArray, edges: Edges, crease_angle: float | None = None
) -> NDArray[np.bool_]:
    """(E,) edges that are smooth in a file that says nothing of it: those whose faces' normals
    differ by at most ``crease_angle`` degrees, if that is given.

    Else hard are those whose faces' normals differ by more than ``SHARP``, and by more than
    ``NOISE_FACTOR`` times the roughness at the smoother of their ends: so that a noisy scan stays
    smooth. The loose ends of what is left are smooth as well (``LOOSE_ENDS``). ``faces``: of
    places, see ``Edges``."""
    p = np.asarray(positions, np.float64)
    if crease_angle is not None:
        return edges.cosine >= max(np.cos(np.radians(crease_angle)), FOLDED)
    smooth = edges.cosine >= np.cos(SHARP)
    sharp = np.flatnonzero(~smooth)
    if not len(sharp):
        return smooth
    angle = np.arccos(edges.cosine)
    one, other = (edges.normals[edges.faces[:, k]] for k in (0, 1))
    apex = faces[edges.faces[:, 1]].sum(axis=1) - edges.ends.sum(axis=1)
    concave = np.sum(one * (p[apex] - p[edges.ends[:, 0]]), axis=1) > 0
    # faces without area, and the rims of sheets, are no noise
    known = np.any(one, axis=1) & np.any(other, axis=1) & (edges.cosine >= FOLDED)
    bend = np.where(known, np.where(concave, -angle, angle), 0)
    rough = roughness(faces, edges, bend, len(p))[edges.ends[sharp]].min(axis=1)
    sharp = sharp[angle[sharp] > NOISE_FACTOR * rough]
    uses = np.bincount(edges.ends.ravel(), minlength=len(p))
    at_border = uses != np.bincount(faces.ravel(), minlength=len(p))
    for _ in range(LOOSE_ENDS):
        ends = edges.ends[sharp]
        lines = np.bincount(ends.ravel(), minlength=len(p)) + at_border
        sharp = sharp[(lines[ends] > 1).all(axis=1)]
    smooth[:] = True
    smooth[sharp] = False
    return smooth


def add_normals(
    meshes: Sequence[Mesh],
    groups: Sequence[NDArray] | None = None,
    crease_angle: float | None = None,
) -> list[Mesh]:
    """The meshes with normals where they have none, vertices split at hard edges. ``groups``: the
    smoothing groups (F,) of the faces of each mesh, 0 for none; without, angles decide
    (``smooth_by_angle``). Meshes are one surface where they meet. Faces that ``repair`` refuses
    leave their mesh as it is."""
    out = list(meshes)
    lacking = [k for k, m in enumerate(meshes) if m.normals is None and in_range(m)]
    if not lacking:
        return out
    batch = Batch([meshes[k] for k in lacking])
    positions = batch.joined("positions")
    first, place = weld(positions)
    faces = place[batch.faces]
    edges = Edges.of(positions[first], faces)
    if groups is None:
        smooth = smooth_by_angle(positions[first], faces, edges, crease_angle)
    else:
        smooth = smooth_by_group(np.concatenate([groups[k] for k in lacking]), edges)
    index, new, normals = split(positions, batch.faces, place, edges, smooth)
    for k, mesh in zip(
        lacking, batch.reindexed(index, new, normals=normals, tangents=None), strict=True
    ):
        out[k] = mesh
    return out


def roughness(faces: NDArray, edges: Edges, bend: NDArray, vertices: int) -> NDArray[np.float64]:
    """(vertices,) how much the angles around a vertex cancel each other, radians.

    ``bend`` (E,): angle between the faces' normals, negative where the surface is concave. Noise
    differs from the edges of a shape in two ways, and roughness is the lesser of two measures of it
    over the edges of the faces at a vertex: noise bends a surface to and fro, so that angles cancel
    out (their mean size less the size of their mean); and it leaves nothing flat (their geometric
    mean). The measure is averaged over the vertices of these faces.
    """

    def of_faces(values: NDArray) -> NDArray[np.float64]:
        first, second = (np.bincount(edges.faces[:, k], values, len(faces)) for k in (0, 1))
        return np.asarray(first + second, np.float64)

    def around(values: NDArray) -> NDArray[np.float64]:
        first, second, third = (np.bincount(faces[:, k], values, vertices) for k in range(3))
        return np.asarray(first + second + third, np.float64)

    one, size = np.ones(len(bend)), np.abs(bend)
    number, *sums = (around(of_faces(v)) for v in (one, bend, size, np.log(size + FLAT)))
    mean, size, log = (v / np.maximum(number, 1) for v in sums)
    rough = np.minimum(size - np.abs(mean), TYPICAL * (np.exp(log) - FLAT))
    return around(rough[faces].mean(axis=1)) / np.maximum(around(np.ones(len(faces))), 1)


def smooth_by_group(groups: NDArray, edges: Edges) -> NDArray[np.bool_]:
    """(E,) edges within one smoothing group, of ``groups`` (F,), 0 for none; but not the rims of
    sheets."""
    one, other = groups[edges.faces].T
    return (one == other) & (one != 0) & (edges.cosine >= FOLDED)


def split(
    positions: NDArray, faces: NDArray, place: NDArray, edges: Edges, smooth: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.int32], NDArray[np.float32]]:
    """(vertex that each new vertex comes from, faces, angle-weighted unit normals).

    ``faces`` (F, 3) refer to ``positions`` (V, 3), which lie at the places ``place`` (V,);
    ``edges`` are those of the places.
    """
    places, vertices = int(place.max(initial=-1)) + 1, len(positions)
    corner, corner_place = faces.ravel().astype(np.int64), place[faces].ravel().astype(np.int64)
    # an edge of a single face is hard as well, but it ends a fan by itself: only where another hard
    # edge meets it, or where surfaces pass through each other, are there two sets
    torn = np.zeros(places, bool)
    torn[edges.ends[~smooth | edges.several]] = True
    at = np.flatnonzero(torn[corner_place])
    number = np.full(len(corner), -1)
    number[at] = np.arange(len(at))
    joined = edges.corners[smooth].reshape(-1, 2)
    joined = number[joined[torn[corner_place[joined[:, 0]]]]]
    graph = coo_matrix((np.ones(len(joined), np.int8), joined.T), (len(at), len(at)))
    count, component = connected_components(graph, directed=False)
    # sets: the places as they are, then those that torn ones come apart into
    sets = corner_place.copy()
    sets[at] = places + component
    where = np.empty((places + count, 3))
    where[place] = positions
    where[sets[at]] = positions[corner[at]]
    normal = summed_normals(where, sets.reshape(-1, 3), welded=True)
    # vertices at one place and in one set stay apart where their other attributes are
    pair, new = np.unique(component * np.int64(vertices) + corner[at], return_inverse=True)
    corner[at] = vertices + new
    index = np.concatenate([np.arange(vertices), pair % vertices])
    set_of = np.concatenate([place, places + pair // vertices])
    used = np.zeros(len(index), bool)
    used[corner] = True
    stray = np.ones(vertices, bool)  # vertices without a face are ``repair``'s
    stray[faces.ravel()] = False
    used[:vertices] |= stray
    index, normal = index[used], normal[set_of[used]]
    new_faces = (np.cumsum(used) - 1)[corner].reshape(-1, 3)
    more, new_faces, normal = split_where_cancelled(positions[index], new_faces, normal)
    return index[more], new_faces.astype(np.int32), normal
