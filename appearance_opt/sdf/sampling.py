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
    onto the surface. Raises InputError if scikit-image is missing, or nothing is found."""
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
    return settle(distance, p, lattice.cell), faces


def march(values: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """The zero level of values on a lattice, in units of its cells. Raises InputError if
    scikit-image is missing."""
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise InputError(
            "--init marching-cubes needs scikit-image: pip install 'appearance-opt[convert]', or "
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
