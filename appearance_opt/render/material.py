"""From packed texels to material parameters.

The layers of a ``MaterialMaps`` name the channels of their texels; what is not among them is a
constant of the job: it has no texture, no gradient and no lookup.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render.brdf import MaterialSample
from appearance_opt.render.math import unit

# not only for the type checker: Dr.Jit resolves the annotations of data classes when it looks for
# arrays
from appearance_opt.render.texture import Pyramid

if TYPE_CHECKING:
    from appearance_opt.render.surface import Hit

UNLIT = "unlit"
"""The constant of maps whose surface shows its base colour whatever the light."""

COLORS = ("red", "green", "blue")

CHANNELS = ("red", "green", "blue", "roughness", "metalness", "normal_x", "normal_y", "normal_z")
"""Every channel a material can have. Colours are linear, normals in [-1, 1], all three of their
channels or none."""

DEFAULTS = {"red": 0.5, "green": 0.5, "blue": 0.5, "roughness": 0.5, "metalness": 0.0}
"""What a channel is that a material does not have."""


@dataclass(frozen=True)
class TexelLayer:
    """Packed maps in one pyramid. ``channels``: the name of each channel of its texels, in order
    (padding has no name)."""

    channels: tuple[str, ...]
    pyramid: Pyramid

    def with_texels(self, texels: mi.Float) -> TexelLayer:
        """Return the same layer around other texels."""
        return TexelLayer(self.channels, self.pyramid.with_texels(texels))

    def at(self, hit: Hit) -> list:
        """Look up the values of all channels at each hit, padding included."""
        material = hit.material if len(self.pyramid.layout.sizes) > 1 else None
        return self.pyramid.lookup(material, hit.uv, hit.footprint)


@dataclass(frozen=True)
class Coverage:
    """The share that each material keeps back of the light behind it: the first channel of
    ``layer``. A second one is a cutoff that the share is tested against where it is not
    negative."""

    layer: TexelLayer

    def at(self, hit: Hit) -> mi.Float:
        """Return the share in [0, 1] at each hit."""
        values = self.layer.at(hit)
        share = values[0] if hit.alpha is None else values[0] * hit.alpha
        if len(self.layer.channels) == 1:
            return share
        cutoff = values[1]
        return dr.select(cutoff < 0, share, dr.select(share >= cutoff, mi.Float(1), mi.Float(0)))


@dataclass(frozen=True)
class MaterialMaps:
    """Everything that is known of the materials of a surface: ``layers`` of maps (a fit keeps the
    maps that move and those that do not in different layers) and ``constants`` for the channels
    without one. ``unlit``: which of several materials are shown without light, None if none is; all
    of them are with the constant ``UNLIT``. ``coverage``: what they keep back of the light behind
    them, where a fit draws them layer by layer; None if all of it."""

    layers: tuple[TexelLayer, ...] = ()
    constants: Mapping[str, float] = field(default_factory=dict)
    unlit: mi.Bool | None = None
    coverage: Coverage | None = None

    @property
    def has_normal_map(self) -> bool:
        return any("normal_x" in layer.channels for layer in self.layers)


def evaluate(maps: MaterialMaps, hit: Hit) -> MaterialSample:
    """Look up the material at each hit."""
    value: dict[str, mi.Float] = {k: mi.Float(v) for k, v in {**DEFAULTS, **maps.constants}.items()}
    for layer in maps.layers:
        value.update(zip(layer.channels, layer.at(hit), strict=False))
    base = mi.Color3f(value["red"], value["green"], value["blue"])
    if hit.color is not None:
        base *= hit.color
    normal = None
    if maps.has_normal_map:
        normal = mi.Vector3f(value["normal_x"], value["normal_y"], value["normal_z"])
    unlit: mi.Bool | bool = UNLIT in maps.constants
    if maps.unlit is not None:
        unlit = dr.gather(mi.Bool, maps.unlit, hit.material)
    return MaterialSample(base, value["roughness"], value["metalness"], normal, unlit)


def shading_normal(hit: Hit, sample: MaterialSample) -> mi.Vector3f:
    """Return the world-space shading normal: the normal map in the hit's interpolated tangent basis
    (glTF 2.0, 3.9.3)."""
    if sample.normal is None or hit.tangent is None:
        return hit.normal
    bitangent = dr.cross(hit.normal, hit.tangent) * hit.handedness
    t = sample.normal
    return unit(hit.tangent * t.x + bitangent * t.y + hit.normal * t.z)
