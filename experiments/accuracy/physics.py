"""Energy, reciprocity and normalisation of the BRDF, and the tone map at its corners."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from appearance_opt.optimize.losses import tone_map
from appearance_opt.render import brdf
from appearance_opt.render.brdf import MaterialSample


def hemisphere(count: int, power: float = 1.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(directions (N, 3), solid angles (N,)): midpoints of a grid, denser towards the pole for
    larger ``power``."""
    edges = np.linspace(0, 1, count + 1) ** power
    z_edges = np.cos(edges * np.pi / 2)
    middle, width = (z_edges[1:] + z_edges[:-1]) / 2, z_edges[:-1] - z_edges[1:]
    azimuth = (np.arange(2 * count) + 0.5) * np.pi / count
    z, a = (x.ravel() for x in np.meshgrid(middle, azimuth, indexing="ij"))
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(a), r * np.sin(a), z], 1), np.repeat(
        width * np.pi / count, 2 * count
    )


def reflect(
    base: float, roughness: float, metalness: float, n: NDArray, v: NDArray, light: NDArray
) -> NDArray:
    """Our BRDF times the cosine (red) for (N, 3) arrays that broadcast."""
    n, v, light = np.broadcast_arrays(n, v, light)
    to = lambda a: mi.Vector3f(np.ascontiguousarray(a.T, np.float32))  # noqa: E731
    material = MaterialSample(mi.Color3f(base), mi.Float(roughness), mi.Float(metalness))
    return np.array(brdf.reflect(material, to(n), to(v), to(light)).x).astype(np.float64)


def albedo(
    base: float, roughness: float, metalness: float, cosine: float, count: int = 400
) -> float:
    """Share of the light that leaves, for a viewer at the given cosine: white furnace of one
    point."""
    v = np.array([[np.sqrt(1 - cosine**2), 0, cosine]])
    # the grid is turned so that its dense pole is the mirror direction
    mirror = np.array([-v[0, 0], 0, cosine])
    z, x = mirror, np.cross([0, 1, 0], mirror)
    x = x / np.linalg.norm(x)
    turned, weight = hemisphere(count, 3.0)
    both = np.concatenate([turned, turned * [1, 1, -1]])
    world = both @ np.stack([x, np.cross(z, x), z])
    return float(
        np.sum(
            reflect(base, roughness, metalness, np.array([[0, 0, 1.0]]), v, world)
            * np.tile(weight, 2)
        )
    )


def reciprocity() -> float:
    """Largest relative difference of f(v, l) and f(l, v) over random directions at least 1 degree
    high."""
    rng = np.random.default_rng(0)
    worst = 0.0
    for roughness, metalness in ((0.08, 0.0), (0.08, 1.0), (0.5, 0.3), (1.0, 0.0)):
        z = rng.uniform(0.0175, 1, (2, 100_000))
        a = rng.uniform(0, 2 * np.pi, z.shape)
        v, light = np.stack([np.sqrt(1 - z**2) * np.cos(a), np.sqrt(1 - z**2) * np.sin(a), z], -1)
        n = np.array([[0, 0, 1.0]])
        f = reflect(0.7, roughness, metalness, n, v, light) / light[:, 2]
        g = reflect(0.7, roughness, metalness, n, light, v) / v[:, 2]
        worst = max(worst, float(np.max(np.abs(f - g) / np.maximum(f, 1e-6))))
    return worst


def normalisation(roughness: float, count: int = 1000) -> float:
    """Integral of D(h) n.h over all h, which must be 1. With viewer and light at h the Fresnel term
    of a white metal is 1 and D is the reflected light over the Smith term and the cosine."""
    h, solid_angle = hemisphere(count, 4.0)
    c = h[:, 2]
    alpha2 = max(roughness, brdf.ROUGHNESS_FLOOR) ** 4
    value = reflect(1.0, roughness, 1.0, np.array([[0, 0, 1.0]]), h, h)
    view = np.maximum(c, 1e-3)
    smith = c * np.sqrt(view**2 * (1 - alpha2) + alpha2) + view * np.sqrt(
        c**2 * (1 - alpha2) + alpha2
    )
    return float(np.sum(value * 2 * smith * solid_angle))


def tone_map_corners() -> list[tuple[float, float, float]]:
    """(x, ours, exact) at zero, around the knee, and far up."""
    x = np.array([0.0, 1e-8, 0.003, 0.0031357, 0.0031358, 0.0032, 1.0, 1e6])
    ours = np.array(tone_map(mi.Color3f(mi.Float(x.astype(np.float32)))).x)
    y = np.log1p(x.astype(np.float32).astype(np.float64))
    exact = np.where(
        y <= 0.0031308, 12.92 * y, 1.055 * np.maximum(y, 0.0031308) ** (1 / 2.4) - 0.055
    )
    return list(zip(x.tolist(), ours.tolist(), exact.tolist(), strict=True))
