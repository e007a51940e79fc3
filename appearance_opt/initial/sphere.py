"""A start that knows nothing: a sphere with random or constant maps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from appearance_opt.initial.atlas import unwrap
from appearance_opt.latent.mesh import LatentMesh

SMALLEST = 12
"""Triangles of the coarsest sphere, a cube."""


def sphere(
    triangles: int, centre: tuple[float, float, float], radius: float, size: int
) -> LatentMesh:
    """A sphere of at most ``triangles`` triangles, evenly spread: a cube-sphere of six n x n grids,
    12 n^2 triangles, with an atlas for ``size`` texels."""
    n = max(1, int(np.sqrt(triangles / 12)))
    positions, faces = _cube(n)
    positions /= np.linalg.norm(positions, axis=1, keepdims=True)
    return unwrap(positions * radius + np.asarray(centre), faces, size)


def random_maps(size: int, seed: int, with_normals: bool) -> dict[str, NDArray]:
    """Uniform random base colour, roughness and metalness; flat normals."""
    rng = np.random.default_rng([seed, 11])
    maps = {c: rng.random((size, size)).astype(np.float32) for c in ("red", "green", "blue")}
    maps["roughness"] = rng.uniform(0.3, 0.9, (size, size)).astype(np.float32)
    maps["metalness"] = rng.uniform(0.0, 0.2, (size, size)).astype(np.float32)
    if with_normals:
        flat = np.zeros((size, size), np.float32)
        maps.update(normal_x=flat, normal_y=flat.copy(), normal_z=flat + 1)
    return maps


def _cube(n: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Welded grid on the surface of a cube, spaced by equal angles."""
    # equal angles instead of equal lengths: triangles on the sphere differ less in size
    t = np.tan(np.linspace(-np.pi / 4, np.pi / 4, n + 1))
    u, v = (x.ravel() for x in np.meshgrid(t, t, indexing="ij"))
    one = np.ones_like(u)
    sides = [(one, u, v), (-one, v, u), (v, one, u), (u, -one, v), (u, v, one), (v, u, -one)]
    points = np.concatenate([np.stack(s, axis=1) for s in sides])
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    a = i * (n + 1) + j
    b, c, d = a + n + 1, a + n + 2, a + 1
    quads = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    faces = np.concatenate([quads + k * (n + 1) ** 2 for k in range(6)])
    unique, place = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    return unique, place.ravel()[faces].astype(np.int32)
