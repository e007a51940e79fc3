"""The same surface, light and camera in Mitsuba's own terms, for comparisons with its
integrators."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from appearance_opt.render import brdf
from appearance_opt.render.brdf import MaterialSample

if TYPE_CHECKING:
    from appearance_opt.views import Views

BSDF_NAME = "appearance_opt_brdf"


def register() -> None:
    """Make our BRDF known to Mitsuba under ``BSDF_NAME``: textures ``base_color``, ``roughness``,
    ``metalness``.

    It is evaluated for a given light and never sampled: under point lights there is nothing to
    sample, and an emitting backdrop lights nothing.
    """

    class Reflection(mi.BSDF):  # type: ignore[misc, valid-type]
        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.maps = {k: props[k] for k in ("base_color", "roughness", "metalness")}
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components = [flags]
            self.m_flags = flags

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            del ctx, sample1, sample2, active
            return dr.zeros(mi.BSDFSample3f, dr.width(si.p)), dr.zeros(mi.Color3f, dr.width(si.p))

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            del ctx
            here = MaterialSample(
                mi.Color3f(self.maps["base_color"].eval(si, active)),
                self.maps["roughness"].eval_1(si, active),
                self.maps["metalness"].eval_1(si, active),
            )
            return brdf.reflect(here, mi.Vector3f(0, 0, 1), si.wi, wo) & active

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            del ctx, si, active
            return dr.zeros(mi.Float, dr.width(wo))

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def traverse(self, callback: Any) -> None:
            for name, texture in self.maps.items():
                callback.put(name, texture, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return BSDF_NAME

    mi.register_bsdf(BSDF_NAME, Reflection)


def mesh(
    name: str, positions: NDArray, faces: NDArray, bsdf: Any, **attributes: NDArray
) -> mi.Mesh:
    """Mitsuba mesh with smooth (angle-weighted) normals. ``attributes``: ``normals`` (V, 3) and
    ``uvs`` (V, 2) if given, and any per-vertex attribute by its Mitsuba name, e.g. ``vertex_color``
    (V, 3)."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf) if isinstance(bsdf, dict) else bsdf
    uvs = attributes.pop("uvs", None)
    normals = attributes.pop("normals", None)
    out = mi.Mesh(
        name,
        len(positions),
        len(faces),
        props=props,
        has_vertex_normals=True,
        has_vertex_texcoords=uvs is not None,
    )
    for key, value in attributes.items():
        out.add_attribute(key, value.shape[1], np.ascontiguousarray(value, np.float32).ravel())
    parameters = mi.traverse(out)
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel())
    parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(positions, np.float32).ravel())
    if uvs is not None:
        parameters["vertex_texcoords"] = mi.Float(np.ascontiguousarray(uvs, np.float32).ravel())
    parameters.update()
    if normals is not None:
        parameters["vertex_normals"] = mi.Float(np.ascontiguousarray(normals, np.float32).ravel())
        parameters.update()
    return out


def sensor(views: Views, k: int, resolution: int) -> mi.Sensor:
    """Camera ``k`` of the views, with a box filter."""
    eye, forward, down = (
        np.asarray(a[k], np.float64) for a in (views.eye, views.forward, views.down)
    )
    half = float(np.linalg.norm(views.right[k]))
    film = {
        "type": "hdrfilm",
        "width": resolution,
        "height": resolution,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": 2 * np.degrees(np.arctan(half)),
            "near_clip": 1e-2,
            "far_clip": 1e4,
            "to_world": mi.ScalarTransform4f().look_at(
                list(eye), list(eye + forward), list(-down / np.linalg.norm(down))
            ),
            "film": film,
        }
    )


def light(views: Views, k: int) -> dict:
    """Point light ``k`` of the views."""
    return {
        "type": "point",
        "position": [float(x) for x in views.light[k]],
        "intensity": {"type": "rgb", "value": float(views.intensity[k])},
    }


def backdrop(
    views: Views, k: int, color: tuple[float, float, float], distance: float = 50.0
) -> dict:
    """A wall of the given radiance behind everything that view ``k`` sees; it is never sampled as a
    light."""
    eye, forward = (np.asarray(a[k], np.float64) for a in (views.eye, views.forward))
    centre = eye + forward * distance
    up = [0, 1, 0] if abs(forward[1]) < 0.9 else [1, 0, 0]
    place = mi.ScalarTransform4f().look_at(
        list(centre), list(eye), up
    ) @ mi.ScalarTransform4f().scale(2 * distance)
    return {
        "type": "rectangle",
        "to_world": place,
        "emitter": {
            "type": "area",
            "sampling_weight": 0.0,
            "radiance": {"type": "rgb", "value": list(color)},
        },
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
    }
