"""The start of a displacement map: how far along its normal each point of a mesh lies from the reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.bake.points import TexelPoints
from appearance_opt.bake.search import REACH, deviation, find
from appearance_opt.initial.fill import fill
from appearance_opt.render.rays import sub_pixel_offsets
from appearance_opt.render.surface import face_normal

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.bake.points import Points
    from appearance_opt.latent.latent import LatentMesh
    from appearance_opt.reference.mesh import MeshReference

SAMPLES = 4
"""Rays per texel."""

STEEPEST = 0.3
"""Least cosine between a ray and the normal of what it hits. A surface that is steeper than that (73 degrees) cannot be
reached by displacement without a step: such hits are mostly of another part, and become spikes."""


def relief(reference: MeshReference, mesh: LatentMesh, size: int) -> NDArray[np.float32]:
    """(size, size) signed distance to the nearest part of the reference that faces the same way, along the
    interpolated normal, positive outward, in the units of the positions. Texels whose rays found nothing, or only
    walls (see ``STEEPEST``), are filled smoothly from the others."""
    with dr.suspend_grad():
        points = TexelPoints(mesh, size, SAMPLES)
        reach = dr.opaque(mi.Float, REACH * deviation(reference, mesh))
        bands = []
        for row in range(0, size, points.rows):
            total = dr.zeros(mi.Float, points.rows * size * 2)
            for dx, dy in sub_pixel_offsets(SAMPLES):
                here = points.band(row, float(dx), float(dy))
                if here is not None:
                    _add(total, reference, here, reach)
            bands.append(np.array(total).reshape(points.rows, size, 2)[: size - row])
        sums = np.concatenate(bands)
    hits = sums[..., 1]
    return fill(sums[..., :1] / np.maximum(hits, 1)[..., None], hits > 0)[..., 0]


def _add(total: mi.Float, reference: MeshReference, points: Points, reach: mi.Float) -> None:
    """Add one sample of each texel: distance and count of the trustworthy hits."""
    found = find(reference, points, reach)
    normal = face_normal(reference.surface, found.triangle, found.valid)
    cosine = dr.dot(normal, points.along) * dr.rsqrt(dr.fmax(dr.squared_norm(normal), 1e-30))
    good = found.valid & (cosine > STEEPEST)
    value = mi.ArrayXf([dr.select(good, found.distance, 0), dr.select(good, mi.Float(1), 0)])
    dr.scatter_reduce(dr.ReduceOp.Add, total, value, points.texel, mode=dr.ReduceMode.NoConflicts)
    dr.eval(total)
