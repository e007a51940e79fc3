"""Surfaces of MaterialX networks as metallic-roughness materials.

An input that depends on nodes that are not read (``materialx_nodes``) keeps its default, with a
note that names them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.materialx_nodes import (
    Missing,
    NotUnderstood,
    Value,
    combine,
    evaluate,
    normal_map,
)
from appearance_opt.asset.packing import pack_orm, with_alpha
from appearance_opt.asset.types import Material

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from appearance_opt.asset.materialx_nodes import Node
    from appearance_opt.asset.types import AlphaMode
    from appearance_opt.asset.uv_transforms import Place


@dataclass(frozen=True)
class Surface:
    """Names and defaults of what a surface shader says of metallic-roughness; "" for what it does
    not have. ``ignored``: weights of lobes that are not drawn."""

    color: tuple[str, float]
    roughness: tuple[str, float]
    metalness: tuple[str, float]
    normal: str
    glow: tuple[str, float]
    opacity: str
    weight: tuple[str, float] = ("", 1.0)
    glow_weight: tuple[str, float] = ("", 1.0)
    transmission: str = ""
    ignored: tuple[str, ...] = ()


SURFACES = {
    "standard_surface": Surface(
        ("base_color", 0.8), ("specular_roughness", 0.2), ("metalness", 0.0), "normal", ("emission_color", 1.0),
        "opacity", ("base", 1.0), ("emission", 0.0), "transmission",
        ("subsurface", "sheen", "coat", "thin_film_thickness"),
    ),
    "open_pbr_surface": Surface(
        ("base_color", 0.8), ("specular_roughness", 0.3), ("base_metalness", 0.0), "geometry_normal",
        ("emission_color", 1.0), "geometry_opacity", ("base_weight", 1.0), ("emission_luminance", 0.0),
        "transmission_weight", ("subsurface_weight", "fuzz_weight", "coat_weight", "thin_film_weight"),
    ),
    "gltf_pbr": Surface(
        ("base_color", 1.0), ("roughness", 1.0), ("metallic", 1.0), "normal", ("emissive", 0.0), "alpha",
        glow_weight=("emissive_strength", 1.0), transmission="transmission",
        ignored=("clearcoat", "sheen_color", "iridescence"),
    ),
    "UsdPreviewSurface": Surface(
        ("diffuseColor", 0.18), ("roughness", 0.5), ("metallic", 0.0), "normal", ("emissiveColor", 0.0), "opacity",
        ignored=("clearcoat", "useSpecularWorkflow"),
    ),
    "disney_principled": Surface(
        ("baseColor", 0.16), ("roughness", 0.5), ("metallic", 0.0), "normal", ("", 0.0), "",
        transmission="specTrans", ignored=("subsurface", "sheen", "clearcoat"),
    ),
}  # fmt: skip
"""Defaults are those of the node definitions that come with MaterialX."""


def read_surface(
    surface: Node, name: str, note: Callable[[str], None]
) -> tuple[Material, Mapping[str, Place]] | None:
    """(the material of a surface shader, where each of its textures reads, by field name); None,
    with a note, if the shader is none of ``SURFACES``. Raises what reading its pictures raises."""
    shader = SURFACES.get(surface.category)
    if shader is None:
        note(
            f"material '{name}': the MaterialX surface '{surface.category}' is not understood: a default one is used"
        )
        return None
    return _SurfaceReader(surface, shader, name, note).material()


class _SurfaceReader:
    def __init__(
        self, surface: Node, shader: Surface, name: str, note: Callable[[str], None]
    ) -> None:
        self.surface, self.shader, self.name = surface, shader, name
        self.note = lambda text: note(f"material '{name}': {text}")

    def material(self) -> tuple[Material, dict[str, Place]]:
        shader = self.shader
        base = self._weighted(shader.color, shader.weight)
        rough, metal = self._value(*shader.roughness, 1), self._value(*shader.metalness, 1)
        glow = self._weighted(shader.glow, shader.glow_weight)
        normal, strength = self._normal()
        opacity = self._value(shader.opacity, 1.0, 1)
        places = {
            "base_color_texture": base,
            "orm_texture": rough if rough.texture else metal,
            "normal_texture": normal,
            "emission_texture": glow,
        }
        orm = None
        if rough.texture or metal.texture:
            orm = pack_orm(rough.texture, metal.texture)
            if rough.texture and metal.texture and not rough.place.equals(metal.place):
                self.note(
                    "roughness and metalness differ in transform: the first one's is used for both"
                )
        color = base.texture
        mode, cutoff = self._alpha_mode(opacity)
        if opacity.texture is not None and mode != "opaque":
            if color is not None and not base.place.equals(opacity.place):
                self.note(
                    "colour and opacity differ in transform: the first one's is used for both"
                )
            places["base_color_texture"] = base if color is not None else opacity
            color = with_alpha(color, opacity.texture)
        self._note_what_is_ignored()
        material = Material(
            name=self.name,
            base_color=_three(base.factor),
            roughness=float(rough.factor[0]),
            metalness=float(metal.factor[0]),
            normal_scale=strength,
            base_color_texture=color,
            orm_texture=orm,
            normal_texture=None if normal is None else normal.texture,
            opacity=float(opacity.factor[0]),
            alpha_mode=mode,
            alpha_cutoff=cutoff,
            emission=_three(glow.factor),
            emission_texture=glow.texture if glow.factor.any() else None,
            transmission=self._transmission(),
        )
        return material, {
            n: v.place for n, v in places.items() if v is not None and v.texture is not None
        }

    def _weighted(self, color: tuple[str, float], weight: tuple[str, float]) -> Value:
        """A colour times its weight."""
        values = [self._value(*weight, 1), self._value(*color, 3)]
        if values[0].texture is None and not values[0].factor.any():
            return Value(np.zeros(3, np.float32))
        return self._or_default(
            color[0], values[1], lambda: combine(np.multiply, values, True).adapted(3)
        )

    def _value(self, name: str, default: float, width: int) -> Value:
        given = self.surface.input(name) if name else None
        constant = Value(np.full(width, default, np.float32))
        if given is None:
            return constant
        return self._or_default(name, constant, lambda: evaluate(given, width))

    def _or_default(self, name: str, default: Value, get: Callable[[], Value]) -> Value:
        try:
            return get()
        except NotUnderstood as error:
            self.note(
                f"{name}: {error}: {', '.join(f'{x:g}' for x in default.factor)} stands for it"
            )
        except Missing:
            pass
        return default

    def _normal(self) -> tuple[Value | None, float]:
        """(normal map stored as (n + 1) / 2, strength)."""
        given = self.surface.input(self.shader.normal)
        if given is None or given.node is None:
            return None, 1.0
        try:
            value, strength = normal_map(given)
        except NotUnderstood as error:
            self.note(f"{self.shader.normal}: {error}: ignored")
            return None, 1.0
        except Missing:
            return None, 1.0
        return (value, strength) if value.texture is not None else (None, 1.0)

    def _alpha_mode(self, opacity: Value) -> tuple[AlphaMode, float]:
        if self.surface.category == "gltf_pbr":
            mode, cutoff = (
                self._value(n, d, 1).factor[0]
                for n, d in (("alpha_mode", 0.0), ("alpha_cutoff", 0.5))
            )
            return ("opaque", "mask", "blend")[int(np.clip(mode, 0, 2))], float(cutoff)  # type: ignore[return-value]
        threshold = 0.0
        if self.surface.category == "UsdPreviewSurface":
            threshold = float(self._value("opacityThreshold", 0.0, 1).factor[0])
        if opacity.texture is None and opacity.factor[0] >= 1:
            return "opaque", 0.5
        return ("mask", threshold) if threshold > 0 else ("blend", 0.5)

    def _transmission(self) -> float:
        share = self._value(self.shader.transmission, 0.0, 1)
        if share.texture is not None:
            self.note(
                f"the picture of {self.shader.transmission} is ignored: its factor alone counts"
            )
        return float(share.factor[0])

    def _note_what_is_ignored(self) -> None:
        inputs = ((n, self.surface.input(n)) for n in self.shader.ignored)
        weights = [n for n, i in inputs if i is not None and (i.node is not None or _any(i.value))]
        if weights:
            self.note(f"{', '.join(weights)} ignored")


def _any(value: Any) -> bool:
    return not isinstance(value, str) and value is not None and any(value)


def _three(factor: NDArray) -> tuple[float, float, float]:
    r, g, b = (float(x) for x in factor[:3])
    return r, g, b
