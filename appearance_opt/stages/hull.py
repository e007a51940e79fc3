"""A first shape from silhouettes: the visual hull of a reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.errors import InputError
from appearance_opt.initial.atlas import unwrap
from appearance_opt.initial.decimate import decimate
from appearance_opt.reference.pool import check_images
from appearance_opt.reference.silhouettes import Silhouettes
from appearance_opt.sdf.sampling import march

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.reference.subject import Subject

VIEWS, RESOLUTION, SAMPLES = 24, 192, 4
"""Of the silhouettes; of a list of views all are taken."""

CELLS = 64
"""Of the grid along the longest side of the object."""


def hull_mesh(subject: Subject, triangles: int, texture: int) -> LatentMesh:
    """The hull with at most ``triangles``, in local coordinates, on an atlas of ``texture`` texels.
    Raises InputError if there is none."""
    surface = hull_surface(silhouettes_of(subject), subject.reference.bounds)
    return unwrap(*decimate(*surface, triangles), texture)


def silhouettes_of(subject: Subject) -> Silhouettes:
    """Those of the first views that a fit sees."""
    sampler = subject.sampler
    count = VIEWS if sampler.listed is None else min(sampler.listed, 3 * VIEWS)
    views = sampler.draw(0, count)
    images = subject.reference.render(views, RESOLUTION, SAMPLES)
    return Silhouettes.of(views, check_images(images, count, RESOLUTION, "silhouettes"))


def hull_surface(
    silhouettes: Silhouettes, bounds: NDArray, cells: int = CELLS
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """(positions (V, 3), faces (F, 3), counter-clockwise seen from outside) of the hull within
    ``bounds`` (2, 3). Raises InputError if it is empty."""
    low, high = np.asarray(bounds, np.float64)
    cell = float((high - low).max()) / cells
    low = low - 2 * cell
    x, y, z = (int(n) for n in np.ceil((high - low) / cell).astype(int) + 3)
    distance = silhouettes.distances(low, cell, (x, y, z))
    # what lies at the border of the grid is outside: the surface closes there
    for axis in range(3):
        for end in (0, -1):
            distance[(slice(None),) * axis + (end,)] = -cell
    if not (distance > 0).any():
        raise InputError(
            "--init hull: the silhouettes leave nothing of the object; images and cameras do not "
            "belong together, or it is too thin: start from a sphere"
        )
    positions, faces = march(-distance)
    return (positions * cell + low).astype(np.float32), faces
