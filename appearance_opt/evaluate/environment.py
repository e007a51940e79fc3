"""A simple environment for looking at things: a sky over a ground, a large warm lamp, and a small
one behind. An analytic function of the direction, so that every renderer can have the same."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset, Material
    from appearance_opt.reference.mesh import MeshReference
    from appearance_opt.views import Views

GROUND, HORIZON, ZENITH = (0.16, 0.145, 0.13), (0.50, 0.51, 0.53), (0.34, 0.42, 0.55)
"""Linear radiance of the gradient from below over the horizon to above."""

LAMPS = (
    ((0.55, 0.62, 0.56), (5.2, 4.7, 4.0), 24.0),
    ((-0.75, 0.35, 0.25), (0.9, 1.0, 1.15), 8.0),
    ((-0.30, 0.85, -0.45), (1.6, 1.75, 2.0), 16.0),
)
"""(direction, radiance at its middle, sharpness) of spherical Gaussians: key, fill and rim."""

LIGHTS = 32
"""Point lights that stand for the environment where a renderer knows no other."""

FAR = 100.0
"""Their distance, where the object's radius is 1."""


def radiance(direction: NDArray) -> NDArray[np.float32]:
    """Linear RGB (..., 3) that comes from unit directions (..., 3), +Y up."""
    d = np.asarray(direction, np.float64)
    up = d[..., 1:2]
    toward = np.where(up > 0, np.array(ZENITH), np.array(GROUND))
    share = np.minimum(np.abs(up) * np.where(up > 0, 1.0, 4.0), 1.0) ** 0.7
    out = (1 - share) * np.array(HORIZON) + share * toward
    for axis, color, sharpness in LAMPS:
        unit = np.array(axis) / np.linalg.norm(axis)
        out = out + np.exp(sharpness * (d @ unit - 1))[..., None] * np.array(color)
    return out.astype(np.float32)


def panorama(height: int = 128) -> NDArray[np.float32]:
    """(height, 2 height, 3) linear radiance: row 0 shows what is above, the middle column -Z, and
    columns to the right of it +X."""
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth = ((np.arange(2 * height) + 0.5) / height - 1) * np.pi
    return radiance(_directions(polar[:, None], azimuth[None]))


def _directions(polar: NDArray, azimuth: NDArray) -> NDArray:
    """Unit vectors by the angle from +Y and that about it from -Z to +X."""
    polar, azimuth = np.broadcast_arrays(polar, azimuth)
    sine = np.sin(polar)
    return np.stack([sine * np.sin(azimuth), np.cos(polar), -sine * np.cos(azimuth)], axis=-1)


@dataclass(frozen=True)
class DistantLights:
    """What stands for an environment: unit ``directions`` (K, 3) towards lights, and the
    ``irradiance`` (K, 3) that each casts on a surface that faces it."""

    directions: NDArray[np.float64]
    irradiance: NDArray[np.float64]


def distant_lights(count: int = LIGHTS) -> DistantLights:
    """Lights that together are as bright as the environment. The sphere is split into cells that
    are equally bright: where it is bright, lights lie close."""
    height = 64
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth = ((np.arange(2 * height) + 0.5) / height - 1) * np.pi
    directions = _directions(polar[:, None], azimuth[None]).reshape(-1, 3)
    solid_angle = np.repeat(np.sin(polar), 2 * height) * (np.pi / height) ** 2
    power = radiance(directions).astype(np.float64) * solid_angle[:, None]
    weight = power.sum(axis=1)
    cells = _split(directions, weight, np.arange(len(weight)), count)
    irradiance = np.stack([power[c].sum(axis=0) for c in cells])
    middles = np.stack([(directions[c] * weight[c, None]).sum(axis=0) for c in cells])
    return DistantLights(middles / np.linalg.norm(middles, axis=1, keepdims=True), irradiance)


def _split(
    points: NDArray, weight: NDArray, chosen: NDArray[np.int64], count: int
) -> list[NDArray[np.int64]]:
    """``chosen`` points in ``count`` groups of about equal weight (median cut: the longest axis is
    halved again and again)."""
    if count == 1:
        return [chosen]
    own = points[chosen]
    axis = int(np.argmax(own.max(axis=0) - own.min(axis=0)))
    order = chosen[np.argsort(own[:, axis], kind="stable")]
    total = np.cumsum(weight[order])
    first = count // 2
    cut = int(np.searchsorted(total, total[-1] * first / count))
    cut = min(max(cut, first), len(order) - (count - first))
    return [
        *_split(points, weight, order[:cut], first),
        *_split(points, weight, order[cut:], count - first),
    ]


def render_environment(
    asset: Asset, views: Views, resolution: int, lights: DistantLights
) -> NDArray[np.float32]:
    """Images (B, H, W, 4) of an asset under distant lights, by our own renderer (see
    ``Reference``): light adds up. There are no shadows but the surface's own. The lights of
    ``views`` are not used.

    Every light has one ray in each pixel, at a place of its own, so that outlines are smooth.
    Roughness is widened by the size of the light's part of the sky, as if it shone from all of it
    (after Karis, "Real Shading in Unreal Engine 4", 2013, on area lights)."""
    from appearance_opt.reference.mesh import MAX_PIXELS, MeshReference

    reference = MeshReference(_widened(asset, (2 / len(lights.directions)) ** 0.5 / 2))
    # what shows its colour whatever the light must not be counted once per light
    some_unlit = any(m.material.unlit for m in asset.meshes)
    step = max(1, MAX_PIXELS // resolution**2)
    parts = [views[k : k + step] for k in range(0, len(views), step)]
    return np.concatenate([_lit(reference, p, resolution, lights, some_unlit) for p in parts])


def _lit(
    reference: MeshReference,
    views: Views,
    resolution: int,
    lights: DistantLights,
    some_unlit: bool,
) -> NDArray[np.float32]:
    import drjit as dr
    import mitsuba as mi

    from appearance_opt.backend import to_device
    from appearance_opt.render.pixels import Batch, Grid

    grid, count = Grid(len(views), resolution), len(lights.directions)
    total = dr.zeros(mi.Float, grid.pixels * 4)

    def add(view: Views, weight: NDArray) -> None:
        nonlocal total
        image = reference.render_device(Batch(view.records(), grid), 1, 0.0)
        total += image * dr.tile(to_device(weight), grid.pixels)
        dr.eval(total)

    for k in range(count):
        shift = _place(k, count) * 2 / resolution
        forward = views.forward + views.right * shift[0] + views.down * shift[1]
        lamp = (lights.directions[k] * FAR).astype(np.float32)
        lit = replace(
            views,
            forward=forward.astype(np.float32),
            light=np.broadcast_to(lamp, views.light.shape),
            intensity=np.full_like(views.intensity, FAR**2),
        )
        weight = lights.irradiance[k]
        add(lit, np.append(weight, 1 / count))
        if some_unlit:
            dark = replace(lit, intensity=np.zeros_like(lit.intensity))
            add(dark, np.append(1 / count - weight, 0.0))
    return np.array(total).reshape(len(views), resolution, resolution, 4)


def _place(index: int, count: int) -> NDArray[np.float64]:
    """Offset (2,) from the middle of a pixel, in pixels: points of an additive sequence of low
    discrepancy (Roberts 2018, "The unreasonable effectiveness of quasirandom sequences")."""
    plastic = 1.32471795724474602596
    return (0.5 + (index + 0.5) * np.array([1 / plastic, 1 / plastic**2])) % 1 - 0.5


def _widened(asset: Asset, angle: float) -> Asset:
    """The asset with rougher materials: the width of its highlights and an ``angle`` in radians,
    added as variances are."""
    found: dict[int, Material] = {}
    for m in asset.meshes:
        if id(m.material) not in found:
            found[id(m.material)] = _rougher(m.material, angle)
    meshes = tuple(replace(m, material=found[id(m.material)]) for m in asset.meshes)
    return replace(asset, meshes=meshes)


def _rougher(m: Material, angle: float) -> Material:
    def widen(roughness: NDArray) -> NDArray:
        return np.minimum((np.asarray(roughness) ** 4 + angle**2) ** 0.25, 1.0)

    texture = m.orm_texture
    if texture is None or texture.pixels.shape[2] < 2:
        return replace(m, roughness=float(widen(np.array(m.roughness))))
    pixels = texture.pixels.copy()
    if pixels.dtype.kind == "u":
        top = np.iinfo(pixels.dtype).max
        table = widen(np.arange(top + 1) / top * m.roughness) * top + 0.5
        pixels[..., 1] = table.astype(pixels.dtype)[pixels[..., 1]]
    else:
        pixels[..., 1] = widen(pixels[..., 1] * m.roughness)
    return replace(m, roughness=1.0, orm_texture=replace(texture, pixels=pixels))
