"""A second opinion: an asset drawn by Mitsuba's own path tracer, with its own plugins.

Nothing of our renderer takes part: meshes with vertex normals, ``principled`` with textures,
``normalmap``, ``mask``; a ``point`` light for each view or an ``envmap``; ``path``. Shadows and
interreflection are there, and light is judged by geometry as path tracers judge it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np

from appearance_opt.asset.alpha import coverage, kind_of
from appearance_opt.asset.batch import fill_normals
from appearance_opt.asset.packing import resize
from appearance_opt.evaluate.environment import panorama
from appearance_opt.reference.plugins import check_compiler, sensor_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset, Material, Mesh, Texture
    from appearance_opt.views import Views

DEPTH = 6
"""Vertices of a path: enough for light that is reflected four times."""


class PathTraced:
    """An asset, ready to be drawn from views (see ``Reference``): ``render`` returns premultiplied
    linear radiance and coverage.

    Lit by the light of each view, or by the environment (``environment``). ``notes``: what it draws
    otherwise than the rest of the package: faces are seen from both sides whatever the material
    says, and blended surfaces cover as much as their alpha says. Textures are read bilinearly,
    without mip levels: use many samples.
    """

    def __init__(self, asset: Asset, environment: bool = False, depth: int = DEPTH) -> None:
        """Raises BackendError where Mitsuba's plugins do not run."""
        check_compiler()
        self.environment = environment
        self.notes: tuple[str, ...] = ()
        scene: dict[str, Any] = {"type": "scene"}
        scene["integrator"] = {"type": "path", "max_depth": depth, "hide_emitters": True}
        if environment:
            scene["light"] = _environment()
        else:
            scene["light"] = {"type": "point", "position": [0.0, 0.0, 0.0]}
        bsdfs: dict[tuple[int, bool, bool], Any] = {}
        colored = []
        for k, mesh in enumerate(fill_normals(asset.meshes)):
            for mirrored, part in _by_handedness(mesh):
                key = id(mesh.material), mirrored, mesh.colors is not None
                if key not in bsdfs:
                    bsdfs[key] = mi.load_dict(_bsdf(mesh, mirrored))
                scene[f"mesh{k}_{int(mirrored)}"] = _shape(part, bsdfs[key], mirrored)
            if mesh.colors is not None and mesh.material.base_color_texture is not None:
                colored.append(mesh.name)
        if colored:
            self.notes += (
                "the path tracer leaves out vertex colours that lie over a texture: "
                f"{', '.join(dict.fromkeys(colored))}",
            )
        self.scene = mi.load_dict(scene)

    def render(self, views: Views, resolution: int, samples: int = 64) -> NDArray[np.float32]:
        """Images (B, resolution, resolution, 4). Noise is the same in every run. ``samples``: at
        least so many, as they lie on a grid in the pixel."""
        columns = math.isqrt(samples)
        samples = columns * -(-samples // columns)
        images = []
        for k in range(len(views)):
            if not self.environment:
                self._place_light(views, k)
            sensor = mi.load_dict(sensor_of(views, k, resolution))
            image = mi.render(self.scene, sensor=sensor, spp=samples, seed=k)
            images.append(np.array(image, np.float32))
        return np.stack(images)

    def _place_light(self, views: Views, k: int) -> None:
        """Move the point light to where view ``k`` has it."""
        params = mi.traverse(self.scene)
        params["light.position"] = mi.Point3f([float(x) for x in views.light[k]])
        params["light.intensity.value"] = type(params["light.intensity.value"])(
            float(views.intensity[k])
        )
        params.update()


def _environment() -> dict[str, Any]:
    """The environment as a Mitsuba emitter, whose panorama has -Z in the middle, too."""
    return {"type": "envmap", "bitmap": mi.Bitmap(panorama())}


def _by_handedness(mesh: Mesh) -> list[tuple[bool, Mesh]]:
    """(mirrored?, faces whose texture is mirrored or not) of a mesh. Mitsuba knows no tangents: it
    takes the direction of u for x, and for y what is to the left of it. Where the texture is
    mirrored u has to run the other way."""
    if mesh.material.normal_texture is None or mesh.uvs is None or mesh.normals is None:
        return [(False, mesh)]
    p, uv = mesh.positions[mesh.faces].astype(np.float64), mesh.uvs[mesh.faces].astype(np.float64)
    (du1, dv1), (du2, dv2) = ((uv[:, k] - uv[:, 0]).T for k in (1, 2))
    outward = np.sum(
        np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]) * mesh.normals[mesh.faces].sum(axis=1), 1
    )
    # v runs downward: a picture that is not mirrored turns the other way than its face
    mirrored = (du1 * dv2 - du2 * dv1) * np.where(outward < 0, -1, 1) > 0
    parts = [(side, replace(mesh, faces=mesh.faces[mirrored == side])) for side in (False, True)]
    return [(side, part) for side, part in parts if len(part.faces)]


def _shape(mesh: Mesh, bsdf: Any, mirrored: bool) -> Any:
    """A Mitsuba mesh with one material."""
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    if mesh.material.unlit:
        properties["emitter"] = mi.load_dict(
            {"type": "area", "radiance": _color(mesh.material, mirrored)}
        )
    used, index = np.unique(mesh.faces, return_inverse=True)
    shape = mi.Mesh(
        mesh.name,
        len(used),
        len(mesh.faces),
        properties,
        has_vertex_normals=True,
        has_vertex_texcoords=mesh.uvs is not None,
    )
    if mesh.colors is not None:
        shape.add_attribute("vertex_color", 3, _flat(mesh.colors[used, :3]))
    params = mi.traverse(shape)
    params["vertex_positions"] = _flat(mesh.positions[used])
    assert mesh.normals is not None
    params["vertex_normals"] = _flat(mesh.normals[used])
    if mesh.uvs is not None:
        uvs = mesh.uvs[used].copy()
        if mirrored:
            uvs[:, 0] = 1 - uvs[:, 0]
        params["vertex_texcoords"] = _flat(uvs)
    params["faces"] = mi.UInt32(index.ravel().astype(np.uint32))
    params.update()
    return shape


def _flat(array: NDArray) -> mi.Float:
    return mi.Float(np.ascontiguousarray(array, np.float32).ravel())


def _bsdf(mesh: Mesh, mirrored: bool) -> dict[str, Any]:
    """A material as Mitsuba knows it. Diffuse light is Disney's, not Lambert's: both assets of a
    comparison have the same."""
    m = mesh.material
    if m.unlit:
        out: dict[str, Any] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    else:
        color = _color(m, mirrored)
        if mesh.colors is not None and m.base_color_texture is None:
            color = {"type": "mesh_attribute", "name": "vertex_color"}
        out = {
            "type": "principled",
            "base_color": color,
            "roughness": _channel(m.orm_texture, 1, m.roughness, mirrored),
            "metallic": _channel(m.orm_texture, 2, m.metalness, mirrored),
            "specular": 0.5,
        }
        if m.normal_texture is not None and mesh.uvs is not None:
            out = {"type": "normalmap", "normalmap": _normals(m, mirrored), "nested": out}
    out = {"type": "twosided", "nested": out}
    if kind_of(m) == "opaque":
        return out
    factor, texture = coverage(m)
    opacity = _channel(
        texture, 0, factor, mirrored, m.alpha_cutoff if kind_of(m) == "mask" else None
    )
    return {"type": "mask", "opacity": opacity, "nested": out}


def _color(m: Material, mirrored: bool) -> dict[str, Any]:
    texture = m.base_color_texture
    if texture is None:
        return {"type": "rgb", "value": [float(x) for x in m.base_color]}
    if m.base_color == (1.0, 1.0, 1.0) and texture.pixels.dtype == np.uint8:
        # as it is stored: an eighth of the memory of floats
        stored = np.ascontiguousarray(_rgb(texture.pixels))
        return _bitmap(stored, texture, mirrored, raw=texture.color_space == "linear")
    linear = _rgb(texture.linear()) * np.array(m.base_color, np.float32)
    return _bitmap(np.ascontiguousarray(linear), texture, mirrored)


def _rgb(pixels: NDArray) -> NDArray:
    return pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, axis=2)


def _channel(
    texture: Texture | None,
    channel: int,
    factor: float,
    mirrored: bool,
    cutoff: float | None = None,
) -> dict[str, Any] | float:
    """One channel of a linear texture times a factor; all or nothing at the ``cutoff``."""
    if texture is None:
        return float(factor if cutoff is None else factor >= cutoff)
    pixels = texture.pixels
    if pixels.shape[2] <= channel:
        channel = 0
    values = texture.linear()[..., channel : channel + 1] * np.float32(factor)
    if cutoff is not None:
        values = (values >= cutoff).astype(np.float32)
    return _bitmap(np.ascontiguousarray(values), texture, mirrored)


def _normals(m: Material, mirrored: bool) -> dict[str, Any]:
    """A normal map whose x and y are scaled; in parts whose texture is mirrored x points the other
    way."""
    assert m.normal_texture is not None
    n = m.normal_texture.linear()[..., :3] * 2 - 1
    n[..., :2] *= m.normal_scale
    if mirrored:
        n[..., 0] *= -1
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-6)
    return _bitmap(np.ascontiguousarray((n + 1) / 2, np.float32), m.normal_texture, mirrored)


def _bitmap(pixels: NDArray, texture: Texture, mirrored: bool, raw: bool = True) -> dict[str, Any]:
    """A texture; ``raw``: of linear values. Mitsuba has one way to go on beyond the borders in both
    directions: the horizontal one."""
    if min(pixels.shape[:2]) < 2:  # Mitsuba interpolates between two texels at least
        pixels = resize(pixels.astype(np.float32), *(max(s, 2) for s in pixels.shape[:2]))
    out: dict[str, Any] = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(pixels),
        "raw": raw,
        "wrap_mode": texture.wrap[0],
    }
    if mirrored:
        out["to_uv"] = mi.ScalarTransform3f([[-1, 0, 1], [0, 1, 0], [0, 0, 1]])
    return out
