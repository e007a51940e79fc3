"""What jobs with a displacement map share: its size, its closed-form start, memory, and what is
written."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import median_filter

from appearance_opt import memory
from appearance_opt.baking.closed_form import Settings, bake
from appearance_opt.errors import InputError
from appearance_opt.initial.atlas import GUTTER
from appearance_opt.latent.displacement import DISPLACEMENT, Tessellator, footprint
from appearance_opt.latent.subdivision import tessellate
from appearance_opt.latent.texels import TexelCodec

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.config import CommonOptions
    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.reference.survey import Survey

FILLED = 0.6
"""Share of an atlas that its charts cover, about."""

MAX_GUTTER = 16

SAMPLES = 4  # docs/trials.md: displacement
"""Rays per texel of the closed-form displacement. Hits on walls that are steep to the ray are kept."""

REACH = 0.5
"""How far a decimated mesh is displaced at most, in its own median edges: farther away lies another
part."""

AROUND, OUTLIER = 5, 0.5  # docs/trials.md: displacement
"""A displacement that differs from the median of a square of ``AROUND`` texels by more than
``OUTLIER`` tessellated edges is a ray that met another part, where surfaces lie close together; the
median takes its place."""

BYTES_PER_TRIANGLE = 700
"""Memory of a fit for each tessellated triangle, all levels together (docs/displacement.md);
gradients have a copy for each thread."""

BYTES_AT_LEAST = 1 << 29
"""What a job takes apart from that: libraries, kernels, maps, images."""


def require_memory(triangles: int, options: CommonOptions) -> None:
    """Raise InputError with the numbers if tessellating ``triangles`` would exceed the memory that
    is free."""
    free = memory.available_memory()
    if not options.displacement.fitted or free is None:
        return
    counts = {level: triangles * 4**level for level in options.levels()}
    need = BYTES_AT_LEAST + BYTES_PER_TRIANGLE * sum(counts.values())
    if need > free:
        finest = max(counts)
        raise InputError(
            f"--subdivision {finest}: {triangles} triangles become {counts[finest]}, which takes about "
            f"{need / 2**30:.1f} GiB, and {free / 2**30:.1f} GiB are free; choose a lower level or fewer --triangles"
        )


def gutter(triangles: int, options: CommonOptions) -> int:
    """Texels between the charts of a new atlas: two edges of the finest tessellation, for a vertex
    on the rim of a chart reads its displacement from texels on both sides, in coarser mip levels
    where its edges are longer."""
    if not options.displacement.fitted:
        return GUTTER
    area = FILLED * options.texture.size**2 / (triangles * 4 ** max(options.levels()))
    return int(np.clip(np.ceil(2 * np.sqrt(area * 4 / 3**0.5)), GUTTER, MAX_GUTTER))


def map_size(mesh: LatentMesh, options: CommonOptions) -> int:
    """Texels per side of the displacement map: the power of two at which a texel is just not longer
    than half an edge of the finest tessellation, which is what its vertices read."""
    half_edge = float(np.sqrt(np.median(footprint(tessellate(mesh, max(options.levels())).mesh))))
    return int(np.clip(2 ** np.ceil(np.log2(1 / max(half_edge, 1e-6))), 16, options.texture.size))


def flat_map(mesh: LatentMesh, options: CommonOptions) -> NDArray[np.float32]:
    """No displacement."""
    size = map_size(mesh, options)
    return np.zeros((size, size), np.float32)


def bake_displacement(
    survey: Survey, mesh: LatentMesh, options: CommonOptions, reach: float | None = None
) -> tuple[LatentMesh, dict[str, NDArray[np.float32]]]:
    """Closed form: the displacement map that rays along the interpolated normals find within
    ``reach`` (None: the automatic cage), and the mesh that it makes at the finest level, to whose
    tangent bases the other maps belong."""
    size, level = map_size(mesh, options), max(options.levels())
    settings = Settings(size, (DISPLACEMENT,), samples=SAMPLES, reach=reach)
    found = bake(survey, mesh, settings).maps[DISPLACEMENT]
    found = without_outliers(found, OUTLIER * median_edge(mesh) / 2**level)
    with dr.suspend_grad():
        tessellator = Tessellator(mesh, level)
        codec = TexelCodec((DISPLACEMENT,), size)
        layer = codec.layer(codec.encode({DISPLACEMENT: found}))
        flat = mi.Float(np.ascontiguousarray(mesh.positions, np.float32).ravel())
        positions = np.array(tessellator(flat, layer)).reshape(-1, 3)
    return replace(tessellator.mesh, positions=positions), {DISPLACEMENT: found}


def median_edge(mesh: LatentMesh) -> float:
    """Median length of the edges of the base mesh."""
    corners = mesh.positions[mesh.faces].astype(np.float64)
    return float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)))


def without_outliers(heights: NDArray[np.float32], tolerance: float) -> NDArray[np.float32]:
    """Heights of which none differs from the median around it by more than ``tolerance``; those
    that did become that median."""
    middle = median_filter(heights, AROUND)
    return np.where(np.abs(heights - middle) > tolerance, middle, heights).astype(np.float32)
