"""From a fitted latent back to an asset."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from appearance_opt.asset.normals import (
    edge_basis,
    split_where_cancelled,
    summed_normals,
    unit,
)
from appearance_opt.asset.packing import EMISSION, pack_emission
from appearance_opt.asset.tangents import split_and_tangents
from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.initial.fill import fill
from appearance_opt.latent.texels import OPACITY
from appearance_opt.render.material import DEFAULTS, UNLIT

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from appearance_opt.asset.rig import Skin
    from appearance_opt.latent.mesh import LatentMesh


def to_asset(
    mesh: LatentMesh,
    positions: NDArray,
    maps: Mapping[str, NDArray | float],
    name: str,
    skin: Skin | None = None,
    alpha: Literal["mask", "blend"] = "blend",
) -> Asset:
    """One mesh for each node that faces belong to, and one material; two, with the same textures,
    where some faces are seen from both sides and others from their front only. ``positions`` (V,
    3); ``maps``: natural values by channel name, images or numbers. Normals are angle weighted and
    tangents MikkTSpace's: what the renderer of the fit uses, so that the maps mean the same in
    another one. ``skin``: of the welded vertices. ``alpha``: how an opacity among the maps is
    written; with "mask" the surface is there where it reaches the ``coverage_cutoff``."""
    p, tangents = positions[mesh.frame_vertex], None
    normals = shading_normals(mesh, positions)[mesh.frame_normal]
    index, faces, n = split_where_cancelled(p, mesh.frame_faces, normals)
    p, uv, vertex = p[index], mesh.uvs[index], mesh.frame_vertex[index]
    if np.ndim(maps.get("normal_x", 0.0)):
        index, faces, tangents = split_and_tangents(p, n, uv, faces)
        p, n, uv, vertex = p[index], n[index], uv[index], vertex[index]
    whole = Mesh(
        positions=np.ascontiguousarray(p, np.float32),
        faces=np.ascontiguousarray(faces, np.int32),
        normals=n,
        uvs=uv,
        tangents=tangents,
        material=_material(maps, name, alpha),
        name=name,
        skin=None if skin is None else skin.take(vertex),
    )
    parts = _by_owner(whole, mesh.owner)
    if mesh.single is None or not mesh.single.any():
        return Asset(tuple(part for part, _ in parts), name)
    one_way = replace(whole.material, double_sided=False)
    return Asset(
        tuple(p for part, of in parts for p in _by_side(part, mesh.single[of], one_way)), name
    )


def _by_owner(mesh: Mesh, owner: NDArray[np.int32] | None) -> list[tuple[Mesh, NDArray]]:
    """(the mesh of each node that owns faces, numbers of its faces in the whole)."""
    if owner is None:
        return [(mesh, np.arange(len(mesh.faces)))]
    out = []
    for node in np.unique(owner).tolist():
        own = np.flatnonzero(owner == node)
        part = mesh if len(own) == len(owner) else _part(mesh, own)
        out.append((replace(part, node=None if node < 0 else node), own))
    return out


def shading_normals(mesh: LatentMesh, positions: NDArray) -> NDArray[np.float32]:
    """(G, 3) the vertex normals of a latent at ``positions`` (V, 3), zero where there are none."""
    out = summed_normals(positions[mesh.shading_vertex], mesh.shading_faces, welded=True)
    if mesh.normal_local is None or mesh.normal_edge is None:
        return out
    x, y = edge_basis(out, positions[mesh.normal_edge] - positions[mesh.shading_vertex])
    c = mesh.normal_local.astype(np.float64)
    return unit(x * c[:, :1] + y * c[:, 1:2] + out * c[:, 2:]).astype(np.float32)


def _by_side(mesh: Mesh, single: NDArray[np.bool_], one_way: Material) -> tuple[Mesh, ...]:
    """A mesh whose material is double-sided, or what is so of it, and those of its faces
    (``single`` (F,)) that are seen from their front only, of the material ``one_way``."""
    if not single.any():
        return (mesh,)
    if single.all():
        return (replace(mesh, material=one_way),)
    return _part(mesh, ~single), replace(
        _part(mesh, single), material=one_way, name=f"{mesh.name}_single_sided"
    )


def _part(mesh: Mesh, faces: NDArray) -> Mesh:
    """Some faces of a mesh (a mask, or numbers), with the vertices that they use."""
    used, corners = np.unique(mesh.faces[faces], return_inverse=True)
    return mesh.take(used, corners.reshape(-1, 3))


def coverage_cutoff(opacity: NDArray[np.float32]) -> float:
    """The cutoff at which as many texels pass the test as their opacities (H, W) amount to, so that
    what is cut out covers as much as what is blended (Castano 2010). At least a step of eight
    bits: what is not there at all never passes."""
    return max(float(np.quantile(opacity, 1 - float(opacity.mean()))), 1 / 255)


def _material(
    maps: Mapping[str, NDArray | float], name: str, alpha: Literal["mask", "blend"]
) -> Material:
    def stacked(*names: str) -> NDArray | None:
        values = [np.asarray(maps.get(n, 0.0), np.float32) for n in names]
        shapes = [v.shape for v in values if v.ndim]
        return (
            np.stack([np.broadcast_to(v, shapes[0]) for v in values], axis=-1) if shapes else None
        )

    def numbers(*names: str) -> tuple[float, float, float]:
        r, g, b = (float(maps.get(n, 0.0)) for n in names)
        return r, g, b

    def constant(channel: str) -> float:
        return float(maps.get(channel, DEFAULTS[channel]))

    base = stacked("red", "green", "blue")
    rough_metal = stacked("roughness", "metalness")
    normal = stacked("normal_x", "normal_y", "normal_z")
    orm = None
    if rough_metal is not None:
        orm = np.concatenate(
            [np.ones((*rough_metal.shape[:2], 1), np.float32), rough_metal], axis=-1
        )
    if normal is not None:
        normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    emitted = stacked(*EMISSION)
    emission, emission_texture = (
        pack_emission(emitted) if emitted is not None else (numbers(*EMISSION), None)
    )
    color = tuple(constant(c) if base is None else 1.0 for c in ("red", "green", "blue"))
    kept_back = stacked(OPACITY)
    pixels = None if base is None else _srgb8(base)
    if kept_back is not None:
        pixels = _with_alpha(base, kept_back)
    clamp = ("clamp", "clamp")
    return Material(
        name=name,
        base_color=color,  # type: ignore[arg-type]
        roughness=1.0 if orm is not None else constant("roughness"),
        metalness=1.0 if orm is not None else constant("metalness"),
        base_color_texture=None if pixels is None else Texture(pixels, "srgb", clamp),  # type: ignore[arg-type]
        orm_texture=None if orm is None else Texture(_8(orm), "linear", clamp),  # type: ignore[arg-type]
        normal_texture=None if normal is None else Texture(_8(normal * 0.5 + 0.5), "linear", clamp),  # type: ignore[arg-type]
        alpha_mode="opaque" if kept_back is None else alpha,
        alpha_cutoff=0.5 if kept_back is None else coverage_cutoff(kept_back),
        unlit=UNLIT in maps,
        emission=emission,
        emission_texture=emission_texture,
    )


def _with_alpha(base: NDArray | None, opacity: NDArray) -> NDArray[np.uint8]:
    """RGBA of eight bits. Under an alpha of 0 lie the colours around: filters and mip levels of
    engines mix them in."""
    alpha = _8(opacity)
    color = np.ones((*opacity.shape[:2], 3), np.float32) if base is None else base
    return np.concatenate([_srgb8(fill(color, alpha[..., 0] > 0)), alpha], axis=-1)


def _8(x: NDArray) -> NDArray[np.uint8]:
    return (np.clip(x, 0, 1) * 255 + 0.5).astype(np.uint8)


def _srgb8(x: NDArray) -> NDArray[np.uint8]:
    from appearance_opt.asset.types import linear_to_srgb

    return _8(linear_to_srgb(np.clip(x, 0, 1)))
