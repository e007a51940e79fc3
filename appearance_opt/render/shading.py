"""The colour of samples: attributes -> material -> light.

Differentiable in the surface's buffers and the texels; visibility is not (see ``boundary`` for its
derivative).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render import brdf, material
from appearance_opt.render.camera import camera_of
from appearance_opt.render.math import at_least
from appearance_opt.render.surface import interpolate

if TYPE_CHECKING:
    from appearance_opt.render.camera import Camera
    from appearance_opt.render.drawn import Shown
    from appearance_opt.render.pixels import Batch
    from appearance_opt.render.samples import Samples
    from appearance_opt.render.surface import Hit

NEAREST_LIGHT = 1e-3
"""Distance below which a light gets no brighter (the object's radius is 1 in a fit): a point light
that touches a surface is infinitely bright there."""


def shade(shown: Shown, batch: Batch, samples: Samples, width: mi.Float) -> mi.Color3f:
    """Return the radiance towards the camera at each sample (all must be hits). Linear RGB.
    ``width``: width of a sample in pixels, which selects the mip level."""
    camera = camera_of(batch.records, samples.view)
    return _radiance(
        shown, camera, interpolate(shown.surface, camera, samples, batch.grid.size, width)
    )


def shade_layer(
    shown: Shown, batch: Batch, samples: Samples, width: mi.Float
) -> tuple[mi.Color3f, mi.Float]:
    """Return the same, and the share in [0, 1] that the surface keeps back of the light behind
    it."""
    camera = camera_of(batch.records, samples.view)
    hit = interpolate(shown.surface, camera, samples, batch.grid.size, width)
    coverage = shown.maps.coverage
    return _radiance(shown, camera, hit), mi.Float(1) if coverage is None else coverage.at(hit)


def _radiance(shown: Shown, camera: Camera, hit: Hit) -> mi.Color3f:
    """The radiance of a surface towards the camera at hits."""
    sample = material.evaluate(shown.maps, hit)
    if sample.unlit is True:
        return sample.base_color
    normal = material.shading_normal(hit, sample)
    lit = illuminate(sample, normal, hit.position, hit.to_viewer, camera)
    return lit if sample.unlit is False else dr.select(sample.unlit, sample.base_color, lit)


def illuminate(
    sample: brdf.MaterialSample,
    normal: mi.Vector3f,
    position: mi.Point3f,
    to_viewer: mi.Vector3f,
    camera: Camera,
) -> mi.Color3f:
    """Return what surfaces reflect of the light of their view: unit ``normal`` that they are shaded
    with, unit direction ``to_viewer``. Linear RGB."""
    to_light = camera.light - position
    squared_distance = at_least(dr.squared_norm(to_light), NEAREST_LIGHT**2)
    to_light *= dr.rsqrt(squared_distance)
    irradiance = camera.intensity / squared_distance
    return brdf.reflect(sample, normal, to_viewer, to_light) * irradiance
