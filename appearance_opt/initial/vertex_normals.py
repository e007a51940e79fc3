"""Vertex normals of a simple mesh that follow those of the reference.

The normal of a coarse mesh's faces is far from the one that is meant, and a normal map makes up for
it. Rasterisers take any map for what it says. Path tracers judge by the interpolated vertex normal
on which side of the surface a light is, and darken what the map turns towards a light that is low
above it. So the vertex normals take over what they can: creases where the reference's normals jump,
and elsewhere the normals whose interpolation comes nearest to the reference's, in the sense of least
squares. The map holds the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg

from appearance_opt.asset.edges import Edges
from appearance_opt.asset.normals import edge_basis, summed_normals, unit, vertex_normals
from appearance_opt.baking.reach import automatic_reach

if TYPE_CHECKING:
    from appearance_opt.reference.survey import Survey

STEPS = 6
"""Points of a face in which the reference is asked: STEPS (STEPS + 1) / 2 on a regular grid."""

JUMP = np.radians(40.0)
"""Angle between the reference's normals on both sides of an edge from which on it is a crease."""

BEND = np.radians(20.0)
"""Angle between the faces of a simple mesh up to which the edge between them is no crease."""

PULL = 0.05
"""Weight of the faces' own normals beside the reference's."""

BAND = 1 << 20
"""Points asked for at once."""

SHORTEST = 0.2
"""Length of a mean of unit normals below which they point nowhere."""


@dataclass(frozen=True)
class VertexNormals:
    """See ``LatentMesh``: ``vertex`` (G,) and ``faces`` (F, 3), None where each vertex has one
    normal; ``local`` (G, 3) and ``edge`` (G,), None where they are those of the faces around."""

    vertex: NDArray[np.int32] | None = None
    faces: NDArray[np.int32] | None = None
    local: NDArray[np.float32] | None = None
    edge: NDArray[np.int32] | None = None


Follow = Callable[[NDArray, NDArray], VertexNormals]
"""From the positions (V, 3) and faces (F, 3) of a welded mesh to its vertex normals."""


def follow_normals(survey: Survey, positions: NDArray, faces: NDArray) -> VertexNormals:
    """The vertex normals of a welded mesh, ``positions`` (V, 3) and ``faces`` (F, 3), that follow
    those of the reference."""
    reach = automatic_reach(survey, positions, faces)
    weights, wanted, valid = _ask(survey, positions, faces, reach)
    at_corners = _corner_normals(weights, wanted, valid)
    edges = Edges.of(positions, faces)
    hard = _creases(faces, edges, at_corners)
    vertex, corners = _sets(len(positions), faces, edges, hard)
    own = summed_normals(positions[vertex], corners, welded=True).astype(np.float64)
    area = np.linalg.norm(_doubled(positions, faces), axis=1) / 2
    target = _least_squares(weights, wanted, valid, corners, own, area)
    edge = _longest_edges(positions, faces, corners, len(vertex))
    z = own
    x, y = edge_basis(z, positions[edge].astype(np.float64) - positions[vertex])
    local = np.stack([np.sum(axis * target, axis=1) for axis in (x, y, z)], axis=1)
    if len(vertex) == len(positions):
        return VertexNormals(None, None, local.astype(np.float32), edge)
    return VertexNormals(vertex, corners, local.astype(np.float32), edge)


def _grid() -> NDArray[np.float64]:
    """(N, 3) barycentric coordinates of the centres of a regular grid."""
    i, j = (x.ravel() for x in np.meshgrid(np.arange(STEPS), np.arange(STEPS), indexing="ij"))
    i, j = i[i + j < STEPS], j[i + j < STEPS]
    b, c = (i + 1 / 3) / STEPS, (j + 1 / 3) / STEPS
    return np.stack([1 - b - c, b, c], axis=1)


def _ask(
    survey: Survey, positions: NDArray, faces: NDArray, reach: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """(barycentric coordinates (N, 3) of the points of a face, the reference's unit normals
    (F, N, 3) there, whether there are any (F, N))."""
    weights = _grid()
    p = positions[faces].astype(np.float64)
    along = unit(vertex_normals(positions, faces, welded=True))[faces].astype(np.float64)
    share = np.linalg.norm(_doubled(positions, faces), axis=1) / (2 * len(weights))
    wanted = np.zeros((len(faces), len(weights), 3))
    valid = np.zeros((len(faces), len(weights)), bool)
    every = max(1, BAND // len(weights))
    with dr.suspend_grad():
        for first in range(0, len(faces), every):
            here = slice(first, first + every)
            origin = np.einsum("nk,fkc->fnc", weights, p[here]).reshape(-1, 3)
            ray = unit(np.einsum("nk,fkc->fnc", weights, along[here])).reshape(-1, 3)
            area = np.repeat(share[here], len(weights)).astype(np.float32)
            found = survey.find(_device(origin), mi.Vector3f(_device(ray)), mi.Float(reach))
            dr.eval(found)
            normal = survey.appearance(found, mi.Float(area)).normal
            shape = (-1, len(weights), 3)
            wanted[here] = np.array(normal, np.float64).T.reshape(shape)
            valid[here] = np.array(found.valid).reshape(shape[:2])
    return weights, np.where(valid[..., None], wanted, 0), valid


def _device(points: NDArray) -> mi.Point3f:
    return mi.Point3f(np.ascontiguousarray(points.T, np.float32))


def _doubled(positions: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """(F, 3) normals of faces, twice their area long."""
    a, b, c = (positions[faces[:, k]].astype(np.float64) for k in range(3))
    return np.asarray(np.cross(b - a, c - a), np.float64)


def _corner_normals(
    weights: NDArray, wanted: NDArray, valid: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """(F, 3, 3) unit normals at the corners of each face that come nearest to those that are wanted
    in it; zero where nothing is known of it."""
    known = valid.astype(np.float64)
    mean = wanted.sum(axis=1) / np.maximum(known.sum(axis=1), 1)[:, None]
    left = np.einsum("fn,ni,nj->fij", known, weights, weights) + PULL * np.eye(3)
    right = np.einsum("ni,fnc->fic", weights, wanted) + PULL * mean[:, None, :]
    return unit(np.linalg.solve(left, right))


def _creases(faces: NDArray, edges: Edges, at_corners: NDArray) -> NDArray[np.bool_]:
    """(E,) edges at which the normals of the faces' corners jump."""
    flat = at_corners.reshape(-1, 3)
    one, other = flat[edges.corners[..., 0]], flat[edges.corners[..., 1]]
    cosine = np.sum(one * other, axis=-1)
    known = np.any(one, axis=-1) & np.any(other, axis=-1)
    jump = np.where(known, np.arccos(np.clip(cosine, -1, 1)), 0).mean(axis=1)
    return (jump > JUMP) & (edges.cosine < np.cos(BEND))


def _sets(
    vertices: int, faces: NDArray, edges: Edges, hard: NDArray[np.bool_]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """(vertex (G,) of each normal, the normals (F, 3) of the corners of faces): corners at a vertex
    share one, those apart that creases part. The first of a vertex has its number."""
    corner = faces.ravel().astype(np.int64)
    torn = np.zeros(vertices, bool)
    torn[edges.ends[hard]] = True
    at = np.flatnonzero(torn[corner])
    number = np.full(len(corner), -1)
    number[at] = np.arange(len(at))
    joined = number[edges.corners[~hard].reshape(-1, 2)]
    joined = joined[(joined >= 0).all(axis=1)]
    graph = coo_matrix((np.ones(len(joined), np.int8), joined.T), (len(at), len(at)))
    count, fan = connected_components(graph, directed=False)
    of_fan = np.zeros(count, np.int64)
    of_fan[fan] = corner[at]
    order = np.argsort(of_fan, kind="stable")
    later = np.zeros(count, bool)
    later[order[1:]] = of_fan[order[1:]] == of_fan[order[:-1]]
    name = np.where(later, vertices + np.cumsum(later) - 1, of_fan)
    out = corner.copy()
    out[at] = name[fan]
    vertex = np.concatenate([np.arange(vertices), of_fan[later]])
    return vertex.astype(np.int32), out.reshape(-1, 3).astype(np.int32)


def _longest_edges(
    positions: NDArray, faces: NDArray, corners: NDArray, count: int
) -> NDArray[np.int32]:
    """(G,) the vertex at the other end of the longest edge that begins at a corner of each."""
    after = np.roll(faces, -1, axis=1).ravel()
    length = np.linalg.norm(positions[after] - positions[faces.ravel()], axis=1)
    order = np.argsort(length, kind="stable")
    out = np.zeros(count, np.int32)
    out[corners.ravel()[order]] = after[order]
    return out


def _least_squares(
    weights: NDArray,
    wanted: NDArray,
    valid: NDArray[np.bool_],
    corners: NDArray,
    own: NDArray,
    area: NDArray,
) -> NDArray[np.float64]:
    """(G, 3) unit normals whose interpolation over the faces comes nearest to those wanted, and
    that are pulled towards their ``own``."""
    share = np.maximum(area / len(weights), 1e-12 * max(float(area.sum()), 1e-300))
    known = valid * share[:, None]
    block = np.einsum("fn,ni,nj->fij", known, weights, weights)
    rows, columns = np.repeat(corners, 3, axis=1), np.tile(corners, (1, 3))
    size = len(own), len(own)
    matrix = csr_matrix((block.ravel(), (rows.ravel(), columns.ravel())), shape=size)
    right = np.zeros((len(own), 3))
    pull = np.bincount(corners.ravel(), np.repeat(area / 3, 3), len(own)) * PULL
    pull = np.maximum(pull, 1e-12 * max(float(pull.max(initial=0)), 1e-300))
    for c in range(3):
        sums = np.einsum("fn,ni,fn->fi", share[:, None] * valid, weights, wanted[..., c])
        right[:, c] = np.bincount(corners.ravel(), sums.ravel(), len(own)) + pull * own[:, c]
    matrix = matrix + diags(pull)
    diagonal = matrix.diagonal()
    scale = diags(1 / np.sqrt(diagonal))
    scaled = scale @ matrix @ scale
    out = np.stack([scale @ cg(scaled, scale @ right[:, c], atol=0.0)[0] for c in range(3)], axis=1)
    vague = np.linalg.norm(out, axis=1) < SHORTEST
    return np.where(vague[:, None], own, unit(out))
