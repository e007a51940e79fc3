"""Flat regions end without slivers: edges are flipped where the surface stays and the triangles get
better."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.normals import unit
from appearance_opt.initial import quadrics
from appearance_opt.initial.edges import keys, sides_of, touching

FLAT = 0.002  # docs/trials.md: decimation
"""How far apart the two diagonals of four corners may lie for their edge to be flipped, in units of
the square root of the area between them."""

THIN = 0.5  # docs/trials.md: decimation
"""How far apart they may lie where the new one is no farther from the original surface, in units of
the least height of the four triangles."""

POOR = 0.3
"""Quality below which a triangle is to be made better: others stay as the decimation chose them."""

GAIN = 1.1
"""How many times better the worse of the two triangles must get: from fans to strips it takes many
small steps."""

ROUNDS = 30  # docs/trials.md: decimation
"""At most: each flip makes the worse triangle of two better, so that few are needed."""


def quality(a: NDArray, b: NDArray, c: NDArray) -> NDArray[np.float64]:
    """(N,) 4 sqrt(3) area over the sum of the squared sides of triangles with corners (N, 3): 1 if
    equilateral, 0 if its corners lie on a line (Bank and Smith 1997)."""
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    squared = sum(np.sum((u - v) ** 2, axis=-1) for u, v in ((a, b), (b, c), (c, a)))
    return 4 * 3**0.5 * area / np.maximum(squared, 1e-300)


def flip_edges(
    positions: NDArray, faces: NDArray, kind: NDArray, point_quadrics: NDArray
) -> tuple[NDArray[np.int64], int]:
    """(faces (F, 3), flips): nearly the same surface (see ``FLAT``), or one that lies nearer to the
    original by the quadrics of its vertices (V, 10) (see ``THIN``), with fewer triangles below
    ``POOR``.

    Only edges of two faces of equal ``kind`` (F,) are flipped, and only to where no edge is:
    borders, creases and edges of more than two faces stay. A face keeps the index of one of the two
    that it came from.
    """
    faces, total = faces.astype(np.int64), 0
    around = faces[quality(*(positions[faces[:, k]] for k in range(3))) < POOR].ravel()
    for _ in range(ROUNDS):
        marked = np.zeros(len(positions), bool)
        marked[around] = True
        # all edges at a marked vertex, with all of their faces
        near = np.flatnonzero(touching(marked, faces))
        part = faces[near]
        won, around = _flip_best(positions, part, kind[near], point_quadrics, marked)
        if not won:
            break
        faces[near] = part
        total += won
    return faces, total


def _flip_best(
    positions: NDArray, faces: NDArray, kind: NDArray, point_quadrics: NDArray, marked: NDArray
) -> tuple[int, NDArray]:
    """Flip the best edges around, of those at ``marked`` vertices; ``faces`` are changed. (How many
    there were, vertices around which there may be more)."""
    sides = sides_of(faces)
    first, last, opposite = sides.corners(faces)
    known = keys(first[sides.start], last[sides.start])
    pair = sides.start[sides.uses == 2]
    f, g = sides.face[pair], sides.face[pair + 1]
    poor = quality(*(positions[faces[:, k]] for k in range(3))) < POOR
    ok = (poor[f] | poor[g]) & (first[pair + 1] == last[pair]) & (kind[f] == kind[g])
    f, g, pair = f[ok], g[ok], pair[ok]
    a, b, c, d = first[pair], last[pair], opposite[pair], opposite[pair + 1]
    new = keys(c, d)
    allowed = (c != d) & (marked[a] | marked[b]) & (marked[c] | marked[d]) & ~np.isin(new, known)
    a, b, c, d, f, g, new = (x[allowed] for x in (a, b, c, d, f, g, new))
    gain = _gain(
        positions[a],
        positions[b],
        positions[c],
        positions[d],
        sum(point_quadrics[x] for x in (a, b, c, d)),
    )
    wanted = np.flatnonzero(gain > GAIN)
    # each face takes part in one flip, each new edge comes from one
    wanted = wanted[np.argsort(-gain[wanted], kind="stable")]
    wanted = wanted[np.sort(np.unique(new[wanted], return_index=True)[1])]
    best, rank = np.full(len(faces), len(wanted)), np.arange(len(wanted))
    np.minimum.at(best, f[wanted], rank)
    np.minimum.at(best, g[wanted], rank)
    won = wanted[(best[f[wanted]] == rank) & (best[g[wanted]] == rank)]
    faces[f[won]] = np.stack([a[won], d[won], c[won]], axis=1)
    faces[g[won]] = np.stack([d[won], b[won], c[won]], axis=1)
    return len(won), np.concatenate([x[wanted] for x in (a, b, c, d)])


def _gain(a: NDArray, b: NDArray, c: NDArray, d: NDArray, q: NDArray) -> NDArray[np.float64]:
    """(N,) how many times better the worse of two triangles gets if (a, b, c) and (b, a, d) become
    (a, d, c) and (d, b, c); 0 if that moved the surface away from the original, by the quadrics
    ``q`` (N, 10) of all four corners, or turned a triangle over."""
    crosses = np.cross(b - a, c - a), np.cross(a - b, d - b)
    size = np.linalg.norm(crosses[0] + crosses[1], axis=1)
    middle = unit(crosses[0] + crosses[1])
    on_old, on_new = _nearest(a, b, c, d)
    apart = np.linalg.norm(on_new - on_old, axis=1)
    height = np.minimum.reduce(
        [_height(x, y, z) for x, y, z in ((a, b, c), (b, a, d), (a, d, c), (d, b, c))]
    )
    flat = apart <= FLAT * np.sqrt(size / 2)
    near = (apart <= THIN * height) & (quadrics.evaluate(q, on_new) <= quadrics.evaluate(q, on_old))
    widest = np.minimum(*(np.sum(unit(cross) * middle, axis=1) for cross in crosses))
    for x, y, z in ((a, d, c), (d, b, c)):
        cosine = np.sum(unit(np.cross(y - x, z - x)) * middle, axis=1)
        flat &= cosine > 0.5
        near &= (cosine > 0.5) & (cosine >= widest)
    before = np.minimum(quality(a, b, c), quality(b, a, d))
    return np.where(
        flat | near, np.minimum(quality(a, d, c), quality(d, b, c)) / np.maximum(before, 1e-12), 0.0
    )


def _height(a: NDArray, b: NDArray, c: NDArray) -> NDArray[np.float64]:
    """(N,) least height of triangles."""
    longest = np.maximum.reduce([np.sum((x - y) ** 2, axis=1) for x, y in ((a, b), (b, c), (c, a))])
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / np.sqrt(np.maximum(longest, 1e-300))


def _nearest(a: NDArray, b: NDArray, c: NDArray, d: NDArray) -> tuple[NDArray, NDArray]:
    """((N, 3) on the lines from a to b, (N, 3) on those from c to d): where they are nearest to one
    another, within the ends."""
    u, v, w = b - a, d - c, c - a
    uu, vv, uv, uw, vw = (
        np.sum(x * y, axis=1) for x, y in ((u, u), (v, v), (u, v), (u, w), (v, w))
    )
    determinant = np.maximum(uu * vv - uv * uv, 1e-300)
    s = np.clip((uw * vv - vw * uv) / determinant, 0, 1)
    t = np.clip((uv * uw - uu * vw) / determinant, 0, 1)
    return a + s[:, None] * u, c + t[:, None] * v
