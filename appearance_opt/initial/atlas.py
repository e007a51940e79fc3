"""A new UV atlas for a welded mesh (xatlas)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from appearance_opt.latent.latent import LatentMesh

GUTTER = 4
"""Empty texels between charts. The packer may end up with a somewhat larger image than asked for, which is
then scaled down: three texels or more are left, enough for one mip level and its bilinear lookups."""


def unwrap(
    positions: NDArray, faces: NDArray, resolution: int, gutter: int = GUTTER, tight: bool = False
) -> LatentMesh:
    """Charts for all faces, packed into the unit square for a texture of ``resolution`` texels, ``gutter``
    of them empty between charts. ``tight`` searches all places for each chart: up to a quarter more texels
    per area, for one or two seconds.

    glTF convention (v downward). Render vertices are also split where a vertex lies on charts of both
    handednesses, so that each has one tangent frame.
    """
    import xatlas

    # xatlas welds and measures with absolute thresholds: give it a unit-sized object
    centre = (positions.min(axis=0) + positions.max(axis=0)) / 2
    scale = max(float(np.ptp(positions, axis=0).max()), 1e-300)
    atlas = xatlas.Atlas()
    unit = ((positions - centre) / scale).astype(np.float32)
    atlas.add_mesh(np.ascontiguousarray(unit), np.ascontiguousarray(faces, np.uint32))
    chart = xatlas.ChartOptions()
    chart.max_iterations = 2
    pack = xatlas.PackOptions()
    pack.resolution = resolution
    pack.padding = gutter
    pack.bilinear = True
    pack.bruteForce = tight
    atlas.generate(chart_options=chart, pack_options=pack)
    vertex, frames, uvs = atlas[0]
    uvs = np.asarray(uvs, np.float32)
    return LatentMesh(
        positions=np.asarray(positions, np.float32),
        faces=np.asarray(faces, np.int32),
        frame_vertex=np.asarray(vertex, np.int32),
        frame_faces=np.asarray(frames, np.int32),
        uvs=uvs,
    )
