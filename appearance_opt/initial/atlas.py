"""A new UV atlas for a welded mesh (xatlas): charts, then their places in one square texture."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from appearance_opt.asset.normals import summed_normals
from appearance_opt.initial.sheets import separate
from appearance_opt.initial.vertex_normals import VertexNormals
from appearance_opt.initial.workers import atlas_at_rest
from appearance_opt.latent.mesh import LatentMesh

if TYPE_CHECKING:
    import xatlas
    from numpy.typing import NDArray

    from appearance_opt.initial.vertex_normals import Follow

ALWAYS = 1001.0
"""Weight of a seam that no chart runs across."""

GUTTER = 4  # docs/trials.md: texels
"""Empty texels between charts, enough for one mip level and its bilinear lookups."""

FLATTEST = 1e-2
"""Height of the chart of a single thin face at the least, as a part of its longest side."""

FILLED, TRIES, SMALLEST = 0.6, 3, 0.5
"""First guess at the share of a texture that charts fill, how often the length of texels that
follows from it is corrected, and down to which part of it. Beyond that the gutters become
narrower."""


def unwrap(
    positions: NDArray,
    faces: NDArray,
    resolution: int,
    gutter: int = GUTTER,
    single: NDArray | None = None,
    follow: Follow | None = None,
) -> LatentMesh:
    """Charts for all faces, with equally many texels per area, packed for a texture of
    ``resolution`` texels. ``follow``: see ``make_charts``."""
    return pack_charts(
        make_charts(positions, faces, single, follow), np.ones(len(faces)), resolution, gutter
    )


def make_charts(
    positions: NDArray,
    faces: NDArray,
    single: NDArray | None = None,
    follow: Follow | None = None,
) -> LatentMesh:
    """Charts for all faces. UVs are as long as what they stand for (in units of the longest side of
    the mesh's box), and charts lie side by side, anywhere. ``single`` (F,): faces that are seen
    from their front only, None for none; where such sheets lie back to back, each side gets
    vertices and charts of its own (see ``sheets``). ``follow`` gives its vertex normals to the mesh
    (positions and faces); charts end at its creases.

    glTF convention (v downward). Render vertices are also split where a vertex lies on charts of
    both handednesses, so that each has one tangent basis.
    """
    import xatlas

    # xatlas welds and measures with absolute thresholds: give it a unit-sized object
    centre = (positions.min(axis=0) + positions.max(axis=0)) / 2
    scale = max(float(np.ptp(positions, axis=0).max()), 1e-300)
    sheets = separate(positions, faces, single)
    normals = VertexNormals() if follow is None else follow(sheets.positions, sheets.faces)
    unit = ((sheets.positions - centre) / scale).astype(np.float32)
    corners, directions = sheets.faces, None
    if normals.faces is not None:
        # to xatlas vertices at one place that have different normals are a seam
        unit, corners = unit[normals.vertex], normals.faces
        directions = summed_normals(unit, corners, welded=True)
    # vertices at one place are one to xatlas: what lies back to back is a mesh of its own
    parts = [np.flatnonzero(~sheets.behind), np.flatnonzero(sheets.behind)]
    parts = [own for own in parts if len(own)]
    chart = xatlas.ChartOptions()
    chart.max_iterations = 2
    chart.normal_seam_weight = ALWAYS
    with atlas_at_rest() as atlas:
        for own in parts:
            indices = np.ascontiguousarray(corners[own], np.uint32)
            atlas.add_mesh(np.ascontiguousarray(unit), indices, directions)
        atlas.generate(chart_options=chart, pack_options=_pack_options(1024, GUTTER, 0.0))
    vertex, frames, uvs = _join(atlas, parts)
    if normals.vertex is not None:
        vertex = normals.vertex[vertex]
    # xatlas stretches the texture, which is as wide and high as it likes, to the unit square
    side = np.array([atlas.width, atlas.height], np.float32) / np.float32(
        max(atlas.texels_per_unit, 1e-30)
    )
    charts = LatentMesh(
        positions=np.asarray(sheets.positions, np.float32),
        faces=np.asarray(sheets.faces, np.int32),
        frame_vertex=np.asarray(vertex, np.int32),
        frame_faces=np.asarray(frames, np.int32),
        uvs=np.nan_to_num(np.asarray(uvs, np.float32)) * side,
        single=single if single is not None and single.any() else None,
        normal_vertex=normals.vertex,
        normal_faces=normals.faces,
        normal_local=normals.local,
        normal_edge=normals.edge,
    )
    left = uv_areas(charts) <= 0
    if left.any():
        charts = _with_single_faces(charts, left, (sheets.positions - centre) / scale)
    return _split_at_creases(charts)


def _split_at_creases(mesh: LatentMesh) -> LatentMesh:
    """The mesh with a render vertex for each normal that is met at one: where a crease ends within
    a chart."""
    if mesh.normal_faces is None:
        return mesh
    normal, frame = mesh.normal_faces.ravel().astype(np.int64), mesh.frame_faces.ravel()
    pairs, faces = np.unique(frame * (normal.max() + 1) + normal, return_inverse=True)
    first = pairs // (normal.max() + 1)
    return replace(
        mesh,
        frame_vertex=mesh.frame_vertex[first],
        frame_faces=faces.reshape(-1, 3).astype(np.int32),
        uvs=mesh.uvs[first],
    )


def _with_single_faces(
    charts: LatentMesh, left: NDArray[np.bool_], positions: NDArray
) -> LatentMesh:
    """The charts, and one for each of the faces that are ``left``: xatlas gives none to faces whose
    area it takes for nothing. ``positions`` (V, 3) in the units of the charts."""
    corners = charts.faces[left]
    # with the longest side first, and no lower than ``FLATTEST`` of it
    p = positions[corners]
    longest = np.argmax(np.linalg.norm(np.roll(p, -1, axis=1) - p, axis=2), axis=1)
    order = (longest[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(p, order[..., None], axis=1), 1, 0)
    base = np.maximum(np.linalg.norm(b - a, axis=1), 1e-12)
    along = np.sum((c - a) * (b - a), axis=1) / base
    height = np.sqrt(np.maximum(np.sum((c - a) ** 2, axis=1) - along**2, 0))
    flat = np.zeros((len(p), 3, 2))
    flat[:, 1, 0], flat[:, 2, 0] = base, np.clip(along, 0, base)
    flat[:, 2, 1] = np.maximum(height, FLATTEST * base)
    # side by side, beyond the others: charts that meet in UV space are one to the packer
    flat[..., 0] += (charts.uvs.max(initial=0) + 2 * np.cumsum(base) - base)[:, None]
    number = len(charts.uvs) + np.arange(3 * len(p)).reshape(-1, 3)
    frames = charts.frame_faces.copy()
    frames[left] = np.take_along_axis(number, np.argsort(order, axis=1), axis=1)
    vertex = np.take_along_axis(corners, order, axis=1).ravel()
    return replace(
        charts,
        frame_vertex=np.concatenate([charts.frame_vertex, vertex]).astype(np.int32),
        frame_faces=frames.astype(np.int32),
        uvs=np.concatenate([charts.uvs, flat.reshape(-1, 2)]).astype(np.float32),
    )


def _join(atlas: xatlas.Atlas, parts: list[NDArray]) -> tuple[NDArray, NDArray, NDArray]:
    """(vertex of each render vertex, faces, UVs) of all meshes of an atlas, the faces at the
    numbers ``parts``."""
    if len(parts) == 1:
        return atlas[0]
    meshes = [atlas[k] for k in range(len(parts))]
    start = np.cumsum([0] + [len(m[0]) for m in meshes[:-1]])
    faces = np.empty((sum(len(p) for p in parts), 3), np.int64)
    for own, mesh, first in zip(parts, meshes, start, strict=True):
        faces[own] = np.asarray(mesh[1], np.int64) + first
    return np.concatenate([m[0] for m in meshes]), faces, np.concatenate([m[2] for m in meshes])


def pack_charts(
    charts: LatentMesh, scale: NDArray, resolution: int, gutter: int = GUTTER, tight: bool = False
) -> LatentMesh:
    """What ``make_charts`` made, packed into the unit square for a texture of ``resolution``
    texels, ``gutter`` of them empty between charts. ``scale`` (F,): how long and wide each face is
    to be relative to the others; the same for all faces of a chart. Charts are turned, and may be
    mirrored. ``tight`` searches all places for each chart: up to a quarter more texels per area,
    for one or two seconds."""
    size = np.ones(len(charts.uvs), np.float32)
    size[charts.frame_faces.ravel()] = np.repeat(scale, 3)
    scaled = replace(charts, uvs=charts.uvs * size[:, None])
    # the packer has absolute thresholds, too: give it charts of unit area in all
    area = float(uv_areas(scaled).sum())
    scaled = replace(scaled, uvs=(scaled.uvs / max(area, 1e-30) ** 0.5).astype(np.float32))
    guess = texels = resolution * FILLED**0.5
    for _ in range(TRIES):
        # the packer keeps lengths and makes the texture as large as it has to, which is then scaled
        atlas = _pack(scaled, _pack_options(resolution, gutter, texels))
        # with more charts than a small texture has room for, gutters have to yield, too
        texels = max(texels * resolution / (atlas.width * atlas.height) ** 0.5, SMALLEST * guess)
    atlas = _pack(scaled, _pack_options(resolution, gutter, texels, tight))
    vertex, faces, uvs = atlas[0]
    packed = replace(
        charts,
        frame_vertex=charts.frame_vertex[np.asarray(vertex)],
        frame_faces=np.asarray(faces, np.int32),
        uvs=np.asarray(uvs, np.float32),
    )
    return _split_at_creases(packed)


def _pack(charts: LatentMesh, options: xatlas.PackOptions) -> xatlas.Atlas:
    with atlas_at_rest() as atlas:
        atlas.add_uv_mesh(
            np.ascontiguousarray(charts.uvs), np.ascontiguousarray(charts.frame_faces, np.uint32)
        )
        atlas.generate(pack_options=options)
    return atlas


def charts_of(mesh: LatentMesh) -> NDArray[np.int32]:
    """(F,) the chart of each face, numbered from 0: faces that share a render vertex lie in one
    chart."""
    f, n = mesh.frame_faces, len(mesh.uvs)
    start, end = f[:, [0, 1]].ravel(), f[:, [1, 2]].ravel()
    _, label = connected_components(
        coo_matrix((np.ones(len(start)), (start, end)), shape=(n, n)), directed=False
    )
    return np.unique(label[f[:, 0]], return_inverse=True)[1].astype(np.int32)


def uv_areas(mesh: LatentMesh) -> NDArray[np.float64]:
    """(F,) area of each face in UV space."""
    corner = mesh.uvs.astype(np.float64)[mesh.frame_faces]
    a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


def _pack_options(
    resolution: int, gutter: int, texels: float, tight: bool = False
) -> xatlas.PackOptions:
    """``texels`` per unit of length; 0: about as many as fill the texture."""
    import xatlas

    options = xatlas.PackOptions()
    # on each side of a chart; with "bilinear" there would be two texels more between charts
    options.padding = (gutter + 1) // 2
    options.bilinear = False
    options.bruteForce = tight
    if texels:
        options.texels_per_unit = texels
    else:
        options.resolution = resolution
    return options
