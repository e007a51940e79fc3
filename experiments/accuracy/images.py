"""Our image against Mitsuba's ``direct`` integrator: same surface, BRDF, light and camera, on real
models."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset import Asset, load
from appearance_opt.asset.types import Mesh, Texture, linear_to_srgb
from appearance_opt.placement import Placement
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.stages.parts import split
from appearance_opt.views import Views, ViewSampler
from experiments import mitsuba_peer

SAMPLES = 64


@dataclass(frozen=True)
class Comparison:
    """PSNR (dB) of display values over black, and the share of pixels that differ by more than 2 /
    255."""

    psnr: float
    differing: float
    ours: NDArray[np.float32]
    theirs: NDArray[np.float32]


def compare(path: Path, resolution: int = 256, normal_maps: bool = False) -> Comparison:
    """One view of a model, lit from the eye (Mitsuba traces shadows). ``normal_maps``: with them,
    by Mitsuba's own BSDF ``normalmap``, which builds frames from the texture coordinates of each
    triangle, where glTF has MikkTSpace's smooth tangents. Its frames are right-handed: faces with
    mirrored coordinates get a map with the green turned over."""
    asset = split(load(path), str(path), "compare").fitted  # the peer draws no transparency
    asset = Placement.around(asset.points()).local(asset)
    if not normal_maps:
        asset = _plain(asset)
    views = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=3, light="headlight").draw(0, 1)
    return compare_asset(asset, views, resolution)


def compare_asset(asset: Asset, views: Views, resolution: int) -> Comparison:
    """The first of the views. ``mitsuba_peer.register`` comes before."""
    # textures unfiltered on both sides: the samples are the filter
    batch = Batch(views.records(), Grid(1, resolution))
    flat = MeshReference(asset).render_device(batch, SAMPLES, 1e-3)
    ours = np.array(flat).reshape(resolution, resolution, 4)[..., :3]
    scene = {"type": "scene", "light": mitsuba_peer.light(views, 0)}
    for k, mesh in enumerate(asset.meshes):
        attributes = {"normals": mesh.normals, "uvs": mesh.uvs}
        attributes = {n: a for n, a in attributes.items() if a is not None}
        for part, (faces, mirrored) in enumerate(_by_handedness(mesh)):
            bsdf = _bsdf(mesh) if mesh.material.normal_texture is None else _mapped(mesh, mirrored)
            name = f"mesh{k}_{part}"
            scene[name] = mitsuba_peer.mesh(name, mesh.positions, faces, bsdf, **attributes)
    integrator = mi.load_dict({"type": "direct"})
    sensor = mitsuba_peer.sensor(views, 0, resolution)
    theirs = np.array(
        mi.render(mi.load_dict(scene), sensor=sensor, integrator=integrator, spp=SAMPLES)
    )
    a, b = (linear_to_srgb(np.clip(i, 0, 1).astype(np.float32)) for i in (ours, theirs))
    differing = float(np.mean(np.abs(a - b).max(-1) > 2 / 255))
    return Comparison(float(-10 * np.log10(np.mean((a - b) ** 2))), differing, a, b)


def _by_handedness(mesh: Mesh) -> list[tuple[NDArray, bool]]:
    """(faces, are their texture coordinates mirrored?): one part without a normal map, else up to
    two."""
    if mesh.material.normal_texture is None or mesh.uvs is None:
        return [(mesh.faces, False)]
    uv = mesh.uvs[mesh.faces].astype(np.float64)
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    # v grows downward: a plain mapping turns the other way round
    mirrored = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0
    return [
        (mesh.faces[mirrored == side], side) for side in (False, True) if (mirrored == side).any()
    ]


def _mapped(mesh: Mesh, mirrored: bool) -> dict:
    """The BRDF under Mitsuba's normal map."""
    texture = mesh.material.normal_texture
    assert texture is not None
    pixels = texture.linear()[..., :3].copy()
    if mirrored:
        pixels[..., 1] = 1 - pixels[..., 1]
    return {"type": "normalmap", "normalmap": _bitmap(pixels, texture), "nested": _bsdf(mesh)}


def _plain(asset: Asset) -> Asset:
    meshes = tuple(
        replace(m, material=replace(m.material, normal_texture=None)) for m in asset.meshes
    )
    return replace(asset, meshes=meshes)


def _bsdf(mesh: Mesh) -> dict:
    m = mesh.material
    one = lambda x: {"type": "uniform", "value": float(x)}  # noqa: E731
    base = {"type": "rgb", "value": [float(x) for x in m.base_color]}
    out = {
        "type": mitsuba_peer.BSDF_NAME,
        "base_color": base,
        "roughness": one(m.roughness),
        "metalness": one(m.metalness),
    }
    if m.base_color_texture is not None:
        out["base_color"] = _bitmap(
            m.base_color_texture.linear()[..., :3] * np.array(m.base_color), m.base_color_texture
        )
    if m.orm_texture is not None:
        orm = m.orm_texture.linear()
        out["roughness"] = _bitmap(orm[..., 1:2] * m.roughness, m.orm_texture)
        out["metalness"] = _bitmap(orm[..., 2:3] * m.metalness, m.orm_texture)
    return out


def _bitmap(pixels: NDArray, texture: Texture) -> dict:
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(pixels, np.float32)),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": texture.wrap[0],
    }
