"""Small scenes whose answers can be worked out on paper, and one sphere of any number of triangles.

All are about one to two metres wide, centred on the origin, +Y up. Every function returns an Asset.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset import Asset, Material, Mesh, Texture
from appearance_opt.asset.normals import vertex_normals
from appearance_opt.errors import InputError

WHITE = Material("white", (1.0, 1.0, 1.0), roughness=1.0)
CLAY = Material("clay", (0.5, 0.5, 0.5), roughness=0.6)
GOLD = Material("gold", (1.0, 0.766, 0.336), roughness=0.3, metalness=1.0)
BLUE = Material("blue", (0.05, 0.15, 0.60), roughness=0.4)
RED = Material("red", (0.60, 0.08, 0.05), roughness=0.4)
CHECKER_LEVELS = (64, 224)
"""sRGB bytes of the checker's two greys; the field at the top left has the first."""


def furnace(triangles: int = 20_000) -> Asset:
    """Unit sphere, white and rough. Its area tends to 4 pi, its volume to 4 pi / 3; under a uniform
    white environment a Lambert surface of albedo 1 vanishes before its background."""
    return Asset((sphere_mesh(triangles, WHITE),), name="furnace")


def checker(triangles: int = 2, texture_size: int = 256, fields: int = 8) -> Asset:
    """The square [-1, 1]^2 at z = 0, facing +Z, with ``fields`` x ``fields`` squares of two known
    greys. Lambert: a pixel's radiance is the grey's linear value times the irradiance over pi."""
    mesh = _square(
        triangles,
        0.0,
        Material("checker", roughness=1.0, base_color_texture=_checker(texture_size, fields)),
    )
    return Asset((mesh,), name="checker")


def torus(triangles: int = 20_000, major: float = 0.75, minor: float = 0.25) -> Asset:
    """Torus about +Y: area 4 pi^2 R r, volume 2 pi^2 R r^2 in the limit; Euler characteristic 0."""
    return Asset((torus_mesh(triangles, major, minor, CLAY),), name="torus")


def two_materials(triangles: int = 20_000) -> Asset:
    """A blue dielectric sphere of radius 0.5 in a gold ring: two meshes that do not touch."""
    half = max(8, triangles // 2)
    return Asset(
        (sphere_mesh(half, BLUE, 0.5, "sphere"), torus_mesh(half, 0.8, 0.12, GOLD)),
        name="two_materials",
    )


def double_sheet(triangles: int = 4_000, gap: float = 0.002) -> Asset:
    """Two squares ``gap`` metres apart, red towards +Z and blue towards -Z: what one side shows
    must never bleed to the other."""
    front = _square(max(2, triangles // 2), gap / 2, RED, "front")
    turned = front.positions * np.array((-1, 1, -1), np.float32)
    back = Mesh(
        turned, front.faces, _constant(turned, (0, 0, -1)), front.uvs, material=BLUE, name="back"
    )
    return Asset((front, back), name="double_sheet")


def bumpy_sphere(triangles: int = 100_000, texture_size: int = 1024) -> Asset:
    """A sphere with waves, for timing at any size: the same shape and maps whatever the count."""
    positions, uvs, faces = _octahedral_grid(triangles)
    positions = (positions * bumps(positions)[:, None]).astype(np.float32)
    material = _spotted(texture_size)
    mesh = Mesh(
        positions,
        faces,
        vertex_normals(positions, faces),
        uvs,
        material=material,
        name="bumpy_sphere",
    )
    return Asset((mesh,), name="bumpy_sphere")


def sphere_mesh(
    triangles: int, material: Material, radius: float = 1.0, name: str = "sphere"
) -> Mesh:
    """Sphere about the origin of 8 n^2 triangles, the nearest such count, with exact normals and an
    octahedral UV map."""
    unit, uvs, faces = _octahedral_grid(triangles)
    positions = (unit * radius).astype(np.float32)
    return Mesh(positions, faces, unit.astype(np.float32), uvs, material=material, name=name)


def torus_mesh(triangles: int, major: float, minor: float, material: Material) -> Mesh:
    """Torus about +Y with radii in metres, of 2 rows x columns triangles, near ``triangles``."""
    columns = max(3, round(float(np.sqrt(triangles / 2 * major / minor))))
    rows = max(3, round(triangles / 2 / columns))
    u, v = np.meshgrid(np.arange(columns + 1) / columns, np.arange(rows + 1) / rows)
    around = 2 * np.pi * (np.arange(columns + 1) % columns) / columns  # the seam repeats exactly
    across = -2 * np.pi * (np.arange(rows + 1) % rows) / rows
    a, b = np.meshgrid(around, across)
    normals = np.stack([np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a)], axis=-1).reshape(
        -1, 3
    )
    ring = np.stack([np.sin(a), 0 * a, np.cos(a)], axis=-1).reshape(-1, 3)
    positions = (major * ring + minor * normals).astype(np.float32)
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32)
    return Mesh(
        positions,
        _quads(rows, columns),
        normals.astype(np.float32),
        uvs,
        material=material,
        name="torus",
    )


def _octahedral_grid(
    triangles: int,
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int32]]:
    """Unit vectors (V, 3), uvs and faces (8 n^2, 3): a square grid folded to an octahedron (Praun
    and Hoppe 2003), blown up to the sphere. Points that meet at the fold are bit-identical, as they
    come from the same integers."""
    n = max(1, round(float(np.sqrt(triangles / 8))))
    side = 2 * n
    b, a = np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1), indexing="ij")
    y = n - abs(a) - abs(b)
    folded = y < 0
    x = np.where(folded, np.sign(a) * (n - abs(b)), a)
    z = np.where(folded, np.sign(b) * (n - abs(a)), b)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float64)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    uvs = np.stack([(a + n) / side, (b + n) / side], axis=-1).reshape(-1, 2).astype(np.float32)
    # the diagonal of every quad follows the fold lines |a| + |b| = const
    j, i = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    p = j * (side + 1) + i
    q, r, s = p + 1, p + side + 2, p + side + 1
    rising = ((i < n) == (j < n))[..., None]
    first = np.where(rising, np.stack([p, s, q], -1), np.stack([p, s, r], -1))
    second = np.where(rising, np.stack([q, s, r], -1), np.stack([p, r, q], -1))
    return (
        points,
        uvs,
        np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)]).astype(np.int32),
    )


def bumps(direction: NDArray) -> NDArray[np.float64]:
    """Radius by unit direction (V, 3): a few waves along fixed axes (the bumpy sphere's height
    field)."""
    axes = np.random.default_rng(5).standard_normal((9, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    frequency = np.array((3, 4, 5, 7, 9, 12, 16, 21, 28), np.float64)
    return 1.0 + np.sum(
        0.16 / frequency * np.sin(direction @ axes.T * frequency + np.arange(9)), axis=1
    )


def _spotted(size: int) -> Material:
    """Base colour and ORM textures: gold spots on blue, in texture space."""
    x = (np.arange(size) + 0.5) / size * 16 % 1.0 - 0.5
    inside = (np.hypot(x[None], x[:, None]) < 0.3)[..., None]
    color = np.where(inside, (235, 190, 110), (30, 70, 160)).astype(np.uint8)
    orm = np.where(inside, (255, 80, 255), (255, 128, 0)).astype(np.uint8)
    return Material(
        "spotted",
        metalness=1.0,
        base_color_texture=Texture(color, "srgb"),
        orm_texture=Texture(orm),
    )


def _checker(size: int, fields: int) -> Texture:
    if size % fields:
        raise InputError(
            f"checker: a texture of {size} texels does not split into {fields} fields; use a multiple"
        )
    index = np.arange(size) * fields // size
    levels = np.array(CHECKER_LEVELS, np.uint8)[(index[:, None] + index[None]) % 2]
    return Texture(np.repeat(levels[..., None], 3, axis=2), "srgb", ("clamp", "clamp"))


def _square(triangles: int, z: float, material: Material, name: str = "square") -> Mesh:
    """[-1, 1]^2 at height z, facing +Z; (0, 0) of the texture is the top left corner."""
    n = max(1, round(float(np.sqrt(triangles / 2))))
    u, v = np.meshgrid(np.arange(n + 1) / n, np.arange(n + 1) / n)
    positions = (
        np.stack([2 * u - 1, 1 - 2 * v, np.full_like(u, z)], axis=-1)
        .reshape(-1, 3)
        .astype(np.float32)
    )
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32)
    return Mesh(
        positions, _quads(n, n), _constant(positions, (0, 0, 1)), uvs, material=material, name=name
    )


def _quads(rows: int, columns: int) -> NDArray[np.int32]:
    """Two counter-clockwise triangles per cell of a grid whose rows run downward: (2 rows columns,
    3)."""
    j, i = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    p = (j * (columns + 1) + i).ravel()
    below = p + columns + 1
    return np.concatenate(
        [np.stack([p, below, below + 1], 1), np.stack([p, below + 1, p + 1], 1)]
    ).astype(np.int32)


def _constant(positions: NDArray, normal: tuple[float, float, float]) -> NDArray[np.float32]:
    return np.broadcast_to(np.asarray(normal, np.float32), positions.shape).copy()
