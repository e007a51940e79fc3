"""What is wrong with an asset: counted, repaired where harmless, refused where not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.alpha import separate_opaque
from appearance_opt.asset.batch import WIDTHS, Batch
from appearance_opt.asset.normals import apart, unit, vertex_normals, weld
from appearance_opt.asset.notes import Notes
from appearance_opt.asset.rows import count_unique_rows
from appearance_opt.asset.types import Asset, Mesh
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Material

MAX_UV = 65536.0
"""Texture coordinates farther from the unit square than this have no fraction left in single
precision that could address a texel."""

LIMITS: dict[str, tuple[float, float]] = {"uvs": (-MAX_UV, MAX_UV), "colors": (0.0, 1.0)}
"""Least and greatest values of attributes that mean something."""

REASONS = 5
"""Notes that an error repeats."""

FILLED: dict[str, tuple[float, str]] = {
    "uvs": (0.0, "texture coordinates"),
    "colors": (1.0, "vertex colours"),
}
"""What stands for numbers that are none, and how notes call the attributes."""

BAND = 1 << 18
"""Faces looked at at once: more take no less time, and memory."""


@dataclass(frozen=True)
class Validation:
    """Counts over all meshes of an asset. Edges and parts are counted on the welded positions of
    each mesh."""

    triangles: int = 0
    non_finite_positions: int = 0
    indices_out_of_range: int = 0
    degenerate_faces: int = 0
    duplicate_faces: int = 0
    unreferenced_vertices: int = 0
    meshes_without_uvs: int = 0
    boundary_edges: int = 0
    non_manifold_edges: int = 0
    connected_parts: int = 0
    reversed_normals: int = 0
    """Faces whose winding disagrees with the normals of their vertices."""


def repair_and_count(asset: Asset, path: str) -> tuple[Validation, Asset]:
    """(counts, the asset after ``repair``): of what that mends as it is in the file, of all else as
    it is left."""
    mended = repair(asset, path)
    found, left = validate(asset), mended.meshes
    if len(left) < len(asset.meshes) or any(
        _reshaped(m, n) for m, n in zip(asset.meshes, left, strict=True)
    ):
        found = replace(validate(mended), **{name: getattr(found, name) for name in _MENDED})
    return found, mended


def _reshaped(mesh: Mesh, mended: Mesh) -> bool:
    return any(
        getattr(mesh, name) is not getattr(mended, name) for name in ("positions", "faces", "uvs")
    )


_MENDED = (
    "non_finite_positions",
    "indices_out_of_range",
    "degenerate_faces",
    "unreferenced_vertices",
)


def validate(asset: Asset) -> Validation:
    """Count what is wrong. Changes nothing."""
    batch = Batch(asset.meshes)
    positions = batch.joined("positions")
    bad_index = (batch.own_faces < 0) | (
        batch.own_faces >= batch.vertex_counts[batch.mesh_of_face][:, None]
    )
    faces = batch.faces[~bad_index.any(axis=1)]
    used = np.zeros(len(positions), bool)
    used[faces] = True
    # vertices of different meshes stay apart
    first, place = weld(apart(positions, batch.mesh_of_vertex))
    welded = place[faces]
    edges, uses = _counted(
        np.sort(welded[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), len(first)
    )
    return Validation(
        triangles=len(batch.own_faces),
        non_finite_positions=int((~np.isfinite(positions).all(axis=1)).sum()),
        indices_out_of_range=int(bad_index.sum()),
        degenerate_faces=int(_degenerate(positions, faces).sum()),
        duplicate_faces=len(welded) - count_unique_rows(np.sort(welded, axis=1)),
        unreferenced_vertices=int((~used).sum()),
        meshes_without_uvs=int((~batch.have("uvs")).sum()),
        boundary_edges=int((uses == 1).sum()),
        non_manifold_edges=int((uses > 2).sum()),
        connected_parts=_parts(edges, welded, len(first)),
        reversed_normals=_reversed(batch, faces),
    )


def _reversed(batch: Batch, faces: NDArray) -> int:
    if not batch.have("normals").any():
        return 0
    positions, normals, count = batch.joined("positions"), batch.joined("normals"), 0
    for start in range(0, len(faces), BAND):
        corners = faces[start : start + BAND].T
        (a, b, c), summed = positions[corners].astype(np.float64), normals[corners].sum(axis=0)
        with np.errstate(invalid="ignore", over="ignore"):
            count += int((np.sum(np.cross(b - a, c - a) * summed, axis=1) < 0).sum())
    return count


def _counted(edges: NDArray, vertices: int) -> tuple[NDArray, NDArray]:
    """(edges (E, 2) between two vertices, each once; how often each is there)."""
    edges = edges[edges[:, 0] != edges[:, 1]]
    keys, uses = np.unique(edges[:, 0] * vertices + edges[:, 1], return_counts=True)
    return np.stack(np.divmod(keys, max(vertices, 1)), axis=1), uses


def _parts(edges: NDArray, faces: NDArray, vertices: int) -> int:
    """How many connected parts the faces make."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(faces):
        return 0
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (vertices, vertices))
    return len(np.unique(connected_components(graph, directed=False)[1][faces]))


def repair(asset: Asset, source: str) -> Asset:
    """The asset with harmless faults mended, and a note for each kind. ``source`` names it in
    errors.

    Dropped: degenerate faces, unreferenced vertices, empty meshes. Recomputed: normals that are not
    finite or zero. Clamped: texture coordinates, colours and factors beyond their range. Opaque:
    what only speaks of transparency (``alpha.separate_opaque``). Raises InputError for positions,
    texture coordinates or factors that are not finite, attributes that do not fit the positions,
    indices out of range, and when no face is left.
    """
    notes = Notes()
    found = zip(asset.meshes, _suspects(asset.meshes), strict=True)
    meshes = [_repair(mesh, source, notes) if suspect else mesh for mesh, suspect in found]
    meshes = [m for m in meshes if len(m.faces)]
    if not meshes:
        reasons = "; ".join((*asset.notes, *notes.lines())[:REASONS])
        raise InputError(f"{source}: there are no triangles in it{reasons and f' ({reasons})'}")
    # meshes that shared a material go on sharing it
    materials = {id(m.material): m.material for m in meshes}
    mended = {key: repair_material(m, source, notes) for key, m in materials.items()}
    new = [mended[id(m.material)] for m in meshes]
    meshes = [
        m if m.material is n else replace(m, material=n) for m, n in zip(meshes, new, strict=True)
    ]
    return separate_opaque(replace(asset, meshes=tuple(meshes), notes=asset.notes + notes.lines()))


def _suspects(meshes: Sequence[Mesh]) -> NDArray[np.bool_]:
    """(M,) which meshes may have a fault that ``_repair`` looks for? Asked of all at once: most
    have none."""
    unfit = np.array([_misshapen(m) for m in meshes], bool)
    fit = np.flatnonzero(~unfit)
    batch = Batch([meshes[k] for k in fit.tolist()])
    out_of_range = (batch.own_faces < 0) | (
        batch.own_faces >= batch.vertex_counts[batch.mesh_of_face][:, None]
    )
    unfit[fit[batch.mesh_of_face[out_of_range.any(axis=1)]]] = True
    fit = np.flatnonzero(~unfit)
    batch = Batch([meshes[k] for k in fit.tolist()])
    positions = batch.joined("positions")
    used = np.zeros(len(positions), bool)
    used[batch.faces] = True
    wrong = ~used | ~np.isfinite(positions).all(axis=1)
    for name, (low, high) in LIMITS.items():
        values = batch.joined(name)
        wrong |= ~((values >= low) & (values <= high)).all(axis=1)
    lengths = {"normals": np.linalg.norm(batch.joined("normals"), axis=1)}
    lengths["tangents"] = np.linalg.norm(batch.joined("tangents")[:, :3], axis=1)
    for name, length in lengths.items():
        close = (
            np.abs(length - 1) <= 1e-3
            if name == "normals"
            else (length >= 1e-6) & np.isfinite(length)
        )
        wrong |= ~close & batch.have(name)[batch.mesh_of_vertex]
    unfit[fit[batch.mesh_of_vertex[wrong]]] = True
    unfit[fit[batch.mesh_of_face[_degenerate(positions, batch.faces)]]] = True
    return unfit


def _misshapen(mesh: Mesh) -> bool:
    """Has a mesh attributes that do not fit its positions, or tangents without normals?"""
    count = len(mesh.positions)
    given = ((getattr(mesh, name), widths) for name, widths in WIDTHS.items())
    fits = all(
        v is None or (v.ndim == 2 and len(v) == count and v.shape[1] in widths)
        for v, widths in given
    )
    return not fits or (mesh.tangents is not None and mesh.normals is None)


def _repair(mesh: Mesh, source: str, notes: Notes) -> Mesh:
    bad = int(((mesh.faces < 0) | (mesh.faces >= len(mesh.positions))).any(axis=1).sum())
    if bad:
        raise InputError(
            f"{source}, mesh '{mesh.name}': {bad} faces refer to vertices that do not exist "
            f"(there are {len(mesh.positions)}); export it again"
        )
    for name, widths in WIDTHS.items():
        values = getattr(mesh, name)
        if values is not None and values.shape not in [
            (len(mesh.positions), width) for width in widths
        ]:
            raise InputError(
                f"{source}, mesh '{mesh.name}': its {name} are {values.shape} numbers for {len(mesh.positions)} "
                "positions; export it again"
            )
    used = np.unique(mesh.faces)
    broken = int((~np.isfinite(mesh.positions[used])).any(axis=1).sum())
    if broken:
        raise InputError(
            f"{source}, mesh '{mesh.name}': {broken} positions are NaN or infinite; export it again"
        )
    for name, (value, what) in FILLED.items():
        given = getattr(mesh, name)
        if given is None or np.isfinite(given).all():
            continue
        lost = ~np.isfinite(given).all(axis=1)
        if lost[used].all():
            raise InputError(
                f"{source}, mesh '{mesh.name}': its {what} are NaN or infinite; export it again"
            )
        if lost[used].any():
            notes(
                f"mesh '{mesh.name}': {int(lost[used].sum())} {what} that are no numbers set to {value:g}"
            )
        mended = np.where(lost[:, None], np.float32(value), given)
        mesh = replace(mesh, **{name: mended})  # type: ignore[arg-type]
    degenerate = _degenerate(mesh.positions, mesh.faces)
    if degenerate.any():
        notes(f"mesh '{mesh.name}': {int(degenerate.sum())} degenerate faces dropped")
        mesh = replace(mesh, faces=mesh.faces[~degenerate])
        used = np.unique(mesh.faces)
    if len(used) < len(mesh.positions):
        notes(
            f"mesh '{mesh.name}': {len(mesh.positions) - len(used)} unreferenced vertices dropped"
        )
        mesh = _compact(mesh, used)
    return _repair_normals(_repair_ranges(mesh, notes), notes)


def _repair_ranges(mesh: Mesh, notes: Notes) -> Mesh:
    """Texture coordinates and colours brought to where they mean something."""
    for name, (low, high) in LIMITS.items():
        values = getattr(mesh, name)
        if values is not None and len(values) and (values.min() < low or values.max() > high):
            notes(f"mesh '{mesh.name}': {name} outside of {low:g} to {high:g} clamped")
            mesh = replace(mesh, **{name: np.clip(values, low, high)})
    return mesh


def repair_material(material: Material, source: str, notes: Notes) -> Material:
    """The material with factors and float texels within [0, 1], and a note if they were not. Raises
    InputError for factors that are not numbers."""
    factors = (
        *material.base_color,
        material.roughness,
        material.metalness,
        material.opacity,
        material.transmission,
    )
    others: tuple[float, ...] = (
        material.normal_scale,
        *material.emission,
        material.alpha_cutoff,
        material.ior,
    )
    unknown = False
    if material.volume is not None:
        others = (*others, material.volume.thickness, *material.volume.attenuation_color)
        unknown = np.isnan(material.volume.attenuation_distance)  # infinite without attenuation
    if unknown or not np.isfinite((*factors, *others)).all():
        raise InputError(
            f"{source}, material '{material.name}': a factor is NaN or infinite; set it to a number from 0 to 1"
        )
    if min(material.emission) < 0:
        notes(f"material '{material.name}': negative emission set to 0")
        red, green, blue = (max(x, 0.0) for x in material.emission)
        material = replace(material, emission=(red, green, blue))
    if min(factors) < 0 or max(factors) > 1:
        notes(f"material '{material.name}': factors outside of 0 to 1 clamped")
        r, g, b, roughness, metalness, opacity, through = (min(max(f, 0.0), 1.0) for f in factors)
        material = replace(material, base_color=(r, g, b), roughness=roughness, metalness=metalness)
        material = replace(material, opacity=opacity, transmission=through)
    for name in (
        "base_color_texture",
        "orm_texture",
        "normal_texture",
        "transmission_texture",
        "thickness_texture",
    ):
        texture = getattr(material, name)
        if texture is None or texture.pixels.dtype.kind != "f":
            continue
        if texture.pixels.min() < 0 or texture.pixels.max() > 1:
            notes(f"material '{material.name}': values of its {name} outside of 0 to 1 clamped")
            material = replace(
                material, **{name: replace(texture, pixels=np.clip(texture.pixels, 0, 1))}
            )
    return material


def _repair_normals(mesh: Mesh, notes: Notes) -> Mesh:
    if mesh.normals is None:
        return replace(mesh, tangents=None)
    length = np.linalg.norm(mesh.normals, axis=1)
    bad = ~np.isfinite(length) | (length < 1e-6)
    if bad.any():
        notes(f"mesh '{mesh.name}': {int(bad.sum())} normals recomputed")
        normals = np.where(bad[:, None], vertex_normals(mesh.positions, mesh.faces), mesh.normals)
        mesh = replace(mesh, normals=normals.astype(np.float32))
    if mesh.normals is not None and np.abs(length[~bad] - 1).max(initial=0) > 1e-3:
        mesh = replace(mesh, normals=unit(mesh.normals))
    if mesh.tangents is not None:
        size = np.linalg.norm(mesh.tangents[:, :3], axis=1)
        if not np.isfinite(size).all() or (size < 1e-6).any():
            notes(f"mesh '{mesh.name}': unusable tangents recomputed")
            mesh = replace(mesh, tangents=None)
    return mesh


def _compact(mesh: Mesh, used: NDArray) -> Mesh:
    new = np.full(len(mesh.positions), -1, np.int32)
    new[used] = np.arange(len(used), dtype=np.int32)
    return mesh.take(used, new[mesh.faces])


def _degenerate(positions: NDArray, faces: NDArray) -> NDArray[np.bool_]:
    """(F,) faces with two corners at the same place, or without area in double precision."""
    out = np.empty(len(faces), bool)
    for start in range(0, len(faces), BAND):
        a, b, c = positions[faces[start : start + BAND].T].astype(np.float64)
        with np.errstate(invalid="ignore", over="ignore"):
            (ux, uy, uz), (vx, vy, vz) = (b - a).T, (c - a).T
            flat = (uy * vz == uz * vy) & (uz * vx == ux * vz) & (ux * vy == uy * vx)
        out[start : start + BAND] = flat
    return out
