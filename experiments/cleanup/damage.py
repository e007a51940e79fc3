"""Meshes as other tools spoil them: procedural damage to a simplified mesh, each kind by itself or
all together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from appearance_opt.asset.normals import vertex_normals, weld
from appearance_opt.asset.types import Asset, Mesh, Texture

DAMAGES = ("volume", "detached", "texture", "intersections")


def damaged(asset: Asset, kinds: tuple[str, ...] = DAMAGES, seed: int = 0) -> Asset:
    """The asset (one mesh) with some of ``DAMAGES``. "volume": smoothed until it has shrunk.
    "detached": three patches moved off by a few percent of the size. "texture": base colour shifted
    and scrambled in blocks. "intersections": patches pushed through the surface."""
    rng = np.random.default_rng(seed)
    mesh = asset.meshes[0]
    first, place = weld(mesh.positions)
    p, faces = mesh.positions[first].astype(np.float64), place[mesh.faces]
    size = float(np.linalg.norm(np.ptp(p, axis=0)))
    if "volume" in kinds:
        p = _smoothed(p, faces, 6)
    if "intersections" in kinds:
        normals = vertex_normals(p, faces, welded=True)
        for _ in range(4):
            near = _patch(p, rng, 0.06 * size)
            p[near] -= normals[near] * 0.05 * size
    if "detached" in kinds:
        p, place, mesh = _detached(p, place, mesh, rng, size)
    positions = p[place].astype(np.float32)
    mesh = replace(
        mesh, positions=positions, normals=vertex_normals(positions, mesh.faces), tangents=None
    )
    if "texture" in kinds:
        mesh = _retextured(mesh, rng)
    return replace(asset, meshes=(mesh,), name=f"{asset.name}_damaged")


VOLUME_POINTS = 2000


def volume(asset: Asset, box: tuple[NDArray, NDArray]) -> float:
    """Share of a box that the surface encloses: random points, the same for all, whose winding
    number (solid angle over 4 pi, van Oosterom and Strackee 1983) is above 1/2 in magnitude. What
    two overlapping parts enclose counts once, and small gaps matter little, unlike for the
    divergence theorem."""
    low, high = box
    points = (low + (high - low) * np.random.default_rng(0).random((VOLUME_POINTS, 3))).astype(
        np.float32
    )
    corners = np.concatenate([m.positions[m.faces] for m in asset.meshes]).astype(np.float32)
    inside = 0
    for part in np.array_split(points, 50):
        a, b, c = (corners[None, :, k] - part[:, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
        triple = np.einsum("ijk,ijk->ij", a, np.cross(b, c))
        dots = [np.einsum("ijk,ijk->ij", x, y) for x, y in ((a, b), (b, c), (c, a))]
        solid = 2 * np.arctan2(triple, la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb)
        inside += int((np.abs(solid.sum(axis=1)) > 2 * np.pi).sum())
    return inside / VOLUME_POINTS


def _smoothed(p: NDArray, faces: NDArray, rounds: int) -> NDArray:
    """Uniform Laplacian smoothing, which shrinks."""
    i, j = np.concatenate(
        [faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2))]
    ).T
    adjacency = coo_matrix((np.ones(len(i)), (i, j)), shape=(len(p), len(p))).tocsr()
    adjacency.data[:] = 1
    degree = np.maximum(np.asarray(adjacency.sum(axis=1)), 1)
    for _ in range(rounds):
        p = 0.5 * p + 0.5 * (adjacency @ p) / degree
    return p


def _patch(p: NDArray, rng: np.random.Generator, radius: float) -> NDArray[np.bool_]:
    return np.linalg.norm(p - p[rng.integers(len(p))], axis=1) < radius


def _detached(
    p: NDArray, place: NDArray, mesh: Mesh, rng: np.random.Generator, size: float
) -> tuple[NDArray, NDArray, Mesh]:
    """Patches of faces cut out and moved off. ``place``: the point of ``p`` of each vertex of the
    file; vertices on a cut are doubled. Returns both and the mesh with the new vertices, whose
    positions are still to be set."""
    centres = p[place[mesh.faces]].mean(axis=1)
    for _ in range(3):
        near = np.linalg.norm(centres - centres[rng.integers(len(centres))], axis=1) < 0.12 * size
        shift = rng.normal(size=3)
        inside, local = np.unique(mesh.faces[near], return_inverse=True)
        faces = mesh.faces.copy()
        faces[near] = (len(place) + local.reshape(-1, 3)).astype(np.int32)
        assert mesh.uvs is not None
        index = np.concatenate([np.arange(len(place)), inside])
        mesh = replace(mesh, positions=mesh.positions[index], faces=faces, uvs=mesh.uvs[index])
        points, joined = np.unique(place[inside], return_inverse=True)
        place = np.concatenate([place, len(p) + joined])
        p = np.concatenate([p, p[points] + shift / np.linalg.norm(shift) * 0.04 * size])
    return p, place, mesh


def _retextured(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    texture = mesh.material.base_color_texture
    assert texture is not None
    pixels = np.roll(
        texture.pixels, (texture.pixels.shape[0] // 16, texture.pixels.shape[1] // 16), (0, 1)
    ).copy()
    block = max(pixels.shape[0] // 8, 1)
    for _ in range(12):
        (y, x), (v, u) = rng.integers(0, pixels.shape[0] - block, (2, 2))
        pixels[y : y + block, x : x + block] = pixels[v : v + block, u : u + block].copy()
    return replace(
        mesh,
        material=replace(mesh.material, base_color_texture=Texture(pixels, "srgb", texture.wrap)),
    )


def pieces(asset: Asset) -> int:
    """Connected pieces of the welded mesh."""
    p = np.concatenate([m.positions for m in asset.meshes])
    start = np.cumsum([0] + [len(m.positions) for m in asset.meshes[:-1]])
    faces = weld(p)[1][
        np.concatenate([m.faces + s for m, s in zip(asset.meshes, start, strict=True)])
    ]
    i, j = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    n = int(faces.max()) + 1
    labels = connected_components(coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n)), False)[1]
    return len(np.unique(labels[faces.ravel()]))
