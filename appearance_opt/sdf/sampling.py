"""Fields at the points of a lattice, and the mesh of their surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.errors import InputError
from appearance_opt.sdf.normals import differences

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

MOST_POINTS = 320**3
"""Points of a lattice: they and the mesh of their surface take about half a gigabyte."""


@dataclass(frozen=True)
class Lattice:
    """Points at ``low`` + ``cell`` * (i, j, k), ``shape`` of them."""

    low: tuple[float, float, float]
    cell: float
    shape: tuple[int, int, int]

    @classmethod
    def within(cls, bounds: NDArray, cells: float, margin: float = 0.0) -> Lattice:
        """``cells`` along the longest side of a box (2, 3), whose lower faces are on the lattice
        and whose upper ones are reached, and ``margin`` cells beyond."""
        low, high = np.asarray(bounds, np.float64)
        cell = float((high - low).max()) / cells
        low, high = low - margin * cell, high + margin * cell
        nx, ny, nz = (np.ceil((high - low) / cell - 1e-6).astype(int) + 1).tolist()
        return cls((float(low[0]), float(low[1]), float(low[2])), cell, (nx, ny, nz))

    def points(self, chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(N, 3) points at which a mask of the lattice's shape holds."""
        return np.argwhere(chosen) * self.cell + np.array(self.low)


def sample(distance: Callable[[mi.Point3f], mi.Float], lattice: Lattice) -> NDArray[np.float32]:
    """A field at all points of a lattice, of its shape."""
    _, ny, nz = lattice.shape
    with dr.suspend_grad():
        i = dr.arange(mi.UInt32, int(np.prod(lattice.shape)))
        row = i // nz
        x, y, z = row // ny, row % ny, i % nz
        cell = dr.opaque(mi.Float, lattice.cell)
        at = mi.Point3f(*(mi.Float(n) for n in (x, y, z))) * cell + mi.Point3f(*lattice.low)
        values = mi.Float(distance(at)) + dr.zeros(mi.Float, dr.width(i))
        return np.array(values).reshape(lattice.shape)


def isosurface(
    distance: Callable[[mi.Point3f], mi.Float], bounds: NDArray, triangles: int
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """(positions (V, 3), faces (F, 3), counterclockwise from outside) of the surface in a box, of
    about so many triangles: marching cubes (scikit-image), whose vertices Newton's steps then bring
    onto the surface, and those beside an edge or a corner onto that. Raises InputError if
    scikit-image is missing, or nothing is found."""
    cells = 64.0
    values = sample(distance, Lattice.within(bounds, cells, 1.5))
    crossed = sum(int((np.diff(values < 0, axis=k)).sum()) for k in range(3))
    # a vertex for every edge of the lattice that crosses the surface, two triangles for a vertex
    cells *= (triangles / (2 * max(crossed, 100))) ** 0.5
    side = np.asarray(bounds, np.float64)[1] - np.asarray(bounds, np.float64)[0]
    most = (MOST_POINTS / np.prod(np.maximum(side / side.max(), 0.05))) ** (1 / 3)
    lattice = Lattice.within(bounds, float(np.clip(cells, 24, most)), 1.5)
    values = sample(distance, lattice)
    if not (values < 0).any() or not (values > 0).any():
        raise InputError("the surface is too thin for a lattice: start from a sphere")
    p, faces = march(values)
    p = p * lattice.cell + np.array(lattice.low)
    settled = settle(distance, p, lattice.cell)
    return sharpen(distance, settled, faces, lattice.cell), faces


def march(values: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """The zero level of values on a lattice, in units of its cells. Raises InputError if
    scikit-image is missing."""
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise InputError(
            "the first shape needs scikit-image: pip install 'appearance-opt[convert]', or "
            "start from a sphere"
        ) from error
    p, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
    return p.astype(np.float64), faces.astype(np.int32)


def settle(
    distance: Callable[[mi.Point3f], mi.Float], positions: NDArray, cell: float, rounds: int = 3
) -> NDArray[np.float32]:
    """Vertices (V, 3) moved onto the surface along its gradient, by at most half a cell each
    round."""
    with dr.suspend_grad():
        p = mi.Point3f(np.ascontiguousarray(positions.T, np.float32))
        for _ in range(rounds):
            slope = differences(distance, p)
            step = distance(p) / dr.fmax(dr.squared_norm(slope), 0.25)
            p = p - slope * dr.fmin(dr.fmax(step, -cell / 2), cell / 2)
            dr.eval(p)
        return np.ascontiguousarray(np.array(p).T)


SHARP = 0.8
"""Cosine between the normals of a vertex and one of its neighbours up to which something sharp lies
between them."""


def sharpen(
    distance: Callable[[mi.Point3f], mi.Float],
    positions: NDArray[np.float32],
    faces: NDArray[np.int32],
    cell: float,
) -> NDArray[np.float32]:
    """Vertices (V, 3) on the surface, of which those beside an edge or a corner are moved onto it:
    to where the planes of a vertex and of its neighbours meet (the quadric of Ju, Losasso, Schaefer
    and Warren 2002, "Dual Contouring of Hermite Data"; here after marching cubes, which cut edges
    off)."""
    with dr.suspend_grad():
        slope = np.array(differences(distance, mi.Point3f(np.ascontiguousarray(positions.T)))).T
    normal = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    one, two = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    apart = np.sum(normal[one] * normal[two], axis=1) < SHARP
    chosen = np.unique(np.concatenate([one[apart], two[apart]]))
    if not len(chosen):
        return positions
    place = np.full(len(positions), -1)
    place[chosen] = np.arange(len(chosen))
    of, plane = np.concatenate([one, two, chosen]), np.concatenate([two, one, chosen])
    asked = place[of] >= 0
    of, plane = place[of[asked]], plane[asked]
    n = normal[plane].astype(np.float64)
    there = np.sum(n * (positions[plane] - positions[chosen[of]]), axis=1)
    matrix, right = np.zeros((len(chosen), 3, 3)), np.zeros((len(chosen), 3))
    np.add.at(matrix, of, n[:, :, None] * n[:, None, :])
    np.add.at(right, of, n * there[:, None])
    values, vectors = np.linalg.eigh(matrix)
    kept = values > 0.05 * values[:, -1:]
    along = np.einsum("vij,vi->vj", vectors, right)
    step = np.where(kept, along / np.where(kept, values, 1), 0)
    moved = positions[chosen] + np.einsum("vij,vj->vi", vectors, step)
    with dr.suspend_grad():
        off = abs(np.array(distance(mi.Point3f(np.ascontiguousarray(moved.T, np.float32)))))
    good = (off < 0.05 * cell) & (np.linalg.norm(moved - positions[chosen], axis=1) < 1.5 * cell)
    out = positions.copy()
    out[chosen[good]] = moved[good]
    return out
