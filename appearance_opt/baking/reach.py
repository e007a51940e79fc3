"""How far rays go from a simple mesh in search of the heavy one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.render import upload
from appearance_opt.render.passing import meet

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.reference.survey import Survey

REACH = 4.0
"""How far rays go, in units of the distance within which nearly all of the reference lies."""

QUANTILE = 0.999

LEAST = 1e-3
"""Rays go at least this share of the reference's size, for meshes that coincide."""

POINTS = 50_000
"""Points of the reference whose distance is measured, about."""


def automatic_reach(survey: Survey, positions: NDArray, faces: NDArray) -> float:
    """The automatic cage: ``REACH`` times the distance within which nearly all of the reference
    lies."""
    diagonal = float(np.linalg.norm(np.ptp(survey.bounds, axis=0)))
    return max(REACH * deviation(survey, positions, faces), LEAST * diagonal)


def deviation(survey: Survey, positions: NDArray, faces: NDArray) -> float:
    """Distance within which nearly all of the reference (its quantile ``QUANTILE``) lies from the
    simple mesh, ``positions`` (V, 3) and ``faces`` (F, 3), measured along the reference's normals."""
    p, normals = survey.spread(POINTS)
    scene = upload.scene_of(positions, faces)
    position, normal = mi.Point3f(p.T), mi.Vector3f(normals.T)
    out, back = (meet(scene, mi.Ray3f(position, n)).t for n in (normal, -normal))
    nearest = np.array(dr.fmin(out, back))
    nearest = nearest[np.isfinite(nearest)]
    diagonal = float(np.linalg.norm(np.ptp(survey.bounds, axis=0)))
    if not len(nearest):
        return 0.02 * diagonal
    # rays that find nothing near hit the far side of the object: they say nothing about the
    # distance
    near = nearest[nearest < 0.05 * diagonal]
    return float(np.quantile(near, QUANTILE)) if len(near) else 0.02 * diagonal
