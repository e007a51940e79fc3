"""The light mesh of a bake: taken as it is, with its own normals, topology and texture
coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.hierarchy import owners
from appearance_opt.asset.normals import vertex_normals, weld
from appearance_opt.asset.sides import single_sided
from appearance_opt.asset.tangents import split_and_tangents
from appearance_opt.asset.types import Asset, Material
from appearance_opt.initial.sheets import separate
from appearance_opt.latent.mesh import LatentMesh

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True)
class Low:
    """``asset``: the meshes as they are written, normals and, where no vertex must be split for
    them, tangents completed. ``mesh``: all of them as one latent with fixed tangents."""

    asset: Asset
    mesh: LatentMesh


def prepare(asset: Asset) -> Low:
    """Complete and merge the meshes, all of which need texture coordinates.

    A mesh keeps the normals and tangents of its file; what is missing is computed: angle-weighted
    normals, MikkTSpace's tangents. Positions, faces and texture coordinates are never touched.
    """
    meshes, parts = [], []
    for mesh in asset.meshes:
        normals = (
            vertex_normals(mesh.positions, mesh.faces) if mesh.normals is None else mesh.normals
        )
        mesh = replace(mesh, normals=normals)
        index, faces = np.arange(len(mesh.positions)), mesh.faces
        uvs, tangents = mesh.uvs, mesh.tangents
        assert uvs is not None
        if tangents is None:
            index, faces, tangents = split_and_tangents(mesh.positions, normals, uvs, mesh.faces)
            if np.array_equal(faces, mesh.faces):
                mesh = replace(mesh, tangents=tangents)
        meshes.append(mesh)
        parts.append((mesh.positions[index], faces, uvs[index], normals[index], tangents))
    start = np.cumsum([0] + [len(p[0]) for p in parts[:-1]])
    positions, uvs, normals, tangents = (
        np.concatenate([p[k] for p in parts]) for k in (0, 2, 3, 4)
    )
    faces = np.concatenate([p[1] + s for p, s in zip(parts, start, strict=True)]).astype(np.int32)
    latent = LatentMesh(
        positions, faces, np.arange(len(positions), dtype=np.int32), faces, uvs, normals, tangents
    )
    latent = replace(latent, single=single_sided(asset.meshes), owner=owners(asset))
    return Low(replace(asset, meshes=tuple(meshes)), latent)


def movable(mesh: LatentMesh) -> LatentMesh:
    """The mesh with its vertices joined wherever they lie at the same place, so that its shape can
    be fitted and no seam opens; those of sheets back to back are not, unless the mesh itself joins
    them. Faces and texture coordinates stay; normals follow from the shape from now on."""
    first, place = weld(mesh.positions)
    welded = place[mesh.faces].astype(np.int32)
    sheets = separate(mesh.positions[first], welded, mesh.single)
    positions, faces, vertex = (
        sheets.positions,
        sheets.faces,
        place[mesh.frame_vertex].astype(np.int32),
    )
    vertex[mesh.frame_faces] = faces
    if not np.array_equal(vertex[mesh.frame_faces], faces):
        positions, faces, vertex = (
            mesh.positions[first],
            welded,
            place[mesh.frame_vertex].astype(np.int32),
        )
    return LatentMesh(
        positions=positions,
        faces=faces,
        frame_vertex=vertex,
        frame_faces=mesh.frame_faces,
        uvs=mesh.uvs,
        single=mesh.single,
        owner=mesh.owner,
    )


def unwrap_asset(asset: Asset, size: int) -> Asset:
    """The asset with new texture coordinates: charts of all meshes packed into one square for
    ``size`` texels. Vertices are split at chart borders; faces and normals stay."""
    from appearance_opt.initial.atlas import unwrap

    start = np.cumsum([0] + [len(m.positions) for m in asset.meshes])
    positions = np.concatenate([m.positions for m in asset.meshes])
    faces = np.concatenate([m.faces + s for m, s in zip(asset.meshes, start, strict=False)])
    latent = unwrap(positions, faces, size, single=single_sided(asset.meshes))
    meshes, first = [], 0
    for k, mesh in enumerate(asset.meshes):
        corner = latent.frame_faces[first : first + len(mesh.faces)]
        first += len(mesh.faces)
        used, local = np.unique(corner, return_inverse=True)
        vertex = latent.frame_vertex[used] - start[k]
        attributes = {n: getattr(mesh, n) for n in ("positions", "normals", "colors")}
        kept = {n: v[vertex] for n, v in attributes.items() if v is not None}
        new = local.reshape(-1, 3).astype(np.int32)
        meshes.append(replace(mesh, faces=new, uvs=latent.uvs[used], tangents=None, **kept))
    return replace(asset, meshes=tuple(meshes))


def with_material(asset: Asset, change: Callable[[Material], Material]) -> Asset:
    """The asset with ``change(material)`` for each material."""
    new: dict[int, Material] = {}
    for mesh in asset.meshes:
        if id(mesh.material) not in new:
            new[id(mesh.material)] = change(mesh.material)
    return replace(
        asset, meshes=tuple(replace(m, material=new[id(m.material)]) for m in asset.meshes)
    )
