"""A scan-like asset: a lumpy bust with fine noise, cut off flat at its foot, in greys by vertex, as
scanners write them."""

from __future__ import annotations

import numpy as np

from appearance_opt.asset import Asset, Material, Mesh
from appearance_opt.asset.normals import vertex_normals
from scenes.noise import fractal_noise, lattice_noise


def bust(rings: int = 226) -> Asset:
    """About 2 * rings^2 triangles. The radius is a sum of noises over a ball."""
    u, s = np.arange(rings) / rings, (np.arange(rings) + 0.5) / rings
    height, azimuth = np.cos(np.pi * s)[:, None], 2 * np.pi * u[None]
    ring = np.sqrt(1 - height**2)
    calm = ring**2  # all directions meet at the poles
    radius = 0.8 + 0.22 * calm * fractal_noise(u, s, (4, 3), 3, 1)
    radius += 0.03 * calm * np.sin(20 * s[:, None] + 2 * lattice_noise(u, s, (3, 3), 2))
    radius += 0.004 * calm * lattice_noise(u, s, (120, 80), 3)
    grid = np.stack(
        [radius * ring * np.sin(azimuth), 1.5 * radius * height, radius * ring * np.cos(azimuth)],
        axis=-1,
    )
    grid[..., 1] = np.maximum(grid[..., 1], -0.7)
    ends = np.array([[0, grid[0, :, 1].mean(), 0], [0, -0.7, 0]])
    points = np.concatenate([grid.reshape(-1, 3), ends]).astype(np.float32)
    i, j = np.arange(rings - 1)[:, None] * rings, np.arange(rings)[None]
    a, b = i + j, i + (j + 1) % rings
    quads = [np.stack([a, a + rings, b], -1), np.stack([b, a + rings, b + rings], -1)]
    first, last = j[0], (rings - 1) * rings + j[0]
    caps = [
        np.stack([np.full(rings, len(points) - 2), first, (first + 1) % rings], -1),
        np.stack([np.full(rings, len(points) - 1), np.roll(last, -1), last], -1),
    ]
    faces = np.concatenate([x.reshape(-1, 3) for x in (*quads, *caps)]).astype(np.int32)
    grey = np.clip(0.45 + 0.15 * fractal_noise(u, s, (12, 9), 3, 4), 0.1, 0.9).ravel()
    colors = np.repeat(np.append(grey, [0.45, 0.45])[:, None], 3, axis=1).astype(np.float32)
    mesh = Mesh(
        points,
        faces,
        vertex_normals(points, faces, welded=True),
        colors=colors,
        material=Material("scan", roughness=0.7),
        name="bust",
    )
    return Asset((mesh,), "bust")
