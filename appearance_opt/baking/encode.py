"""From baked maps to what is stored: textures of the result's materials, and loose image files."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset import images
from appearance_opt.asset.height import displacement_of, height_exr, height_png
from appearance_opt.asset.packing import EMISSION, pack_emission
from appearance_opt.asset.types import Material, Texture, Wrap, linear_to_srgb

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

    from appearance_opt.options.baking import BakingOptions

CLAMP: tuple[Wrap, Wrap] = ("clamp", "clamp")

CURVATURE_QUANTILE = 0.99
"""Share of the texels whose curvature must not clip."""


def stack_maps(maps: Mapping[str, NDArray], *names: str) -> NDArray[np.float32]:
    """(H, W, C) of some channels."""
    return np.stack([maps[n] for n in names], axis=-1).astype(np.float32)


def quantise(values: NDArray, bits: int) -> NDArray:
    """[0, 1] to uint8 or uint16."""
    top, kind = (255, np.uint8) if bits == 8 else (65535, np.uint16)
    return (np.clip(values, 0, 1) * top + 0.5).astype(kind)


def normal_image(
    maps: Mapping[str, NDArray], prefix: str = "normal", flip_green: bool = False
) -> NDArray[np.float32]:
    """(H, W, 3) unit normals as (n + 1) / 2."""
    n = stack_maps(maps, *(f"{prefix}_{axis}" for axis in "xyz"))
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-6)
    if flip_green:
        n[..., 1] *= -1
    return n * 0.5 + 0.5


def orm_image(maps: Mapping[str, NDArray]) -> NDArray[np.float32]:
    """(H, W, 3) occlusion (1 where it was not baked), roughness, metalness."""
    occlusion = maps.get("occlusion", np.ones_like(maps["roughness"]))
    return np.stack([occlusion, maps["roughness"], maps["metalness"]], axis=-1)


def curvature_scale(maps: Mapping[str, NDArray], covered: NDArray) -> float:
    """Curvature that is stored as white; minus it as black, 0.5 is flat."""
    values = np.abs(maps["curvature"][covered])
    return max(float(np.quantile(values, CURVATURE_QUANTILE)) if len(values) else 0.0, 1e-12)


def material_change(
    maps: Mapping[str, NDArray], options: BakingOptions, unlit: bool = False
) -> Callable[[Material], Material]:
    """A function from LOW's materials to those of the result: what was baked replaces what was
    there. ``unlit``: is HIGH?"""
    new: dict[str, Any] = {}
    if options.wants("base-color"):
        color = linear_to_srgb(np.clip(stack_maps(maps, "red", "green", "blue"), 0, 1))
        texture = Texture(quantise(color, 8), "srgb", CLAMP)
        new |= {"base_color": (1.0, 1.0, 1.0), "base_color_texture": texture, "unlit": unlit}
    if options.wants("orm"):
        orm = Texture(quantise(orm_image(maps), 8), "linear", CLAMP)
        new |= {
            "roughness": 1.0,
            "metalness": 1.0,
            "orm_texture": orm,
            "has_occlusion": "occlusion" in maps,
        }
    if options.wants("normal"):
        new |= {
            "normal_scale": 1.0,
            "normal_texture": Texture(quantise(normal_image(maps), options.bits), "linear", CLAMP),
        }
    if EMISSION[0] in maps:
        emission, glow = pack_emission(stack_maps(maps, *EMISSION))
        new |= {"emission": emission, "emission_texture": glow}
    if options.wants("displacement"):
        new["displacement"] = displacement_of(maps["displacement"])

    def change(material: Material) -> Material:
        return replace(material, **new)

    return change


@dataclass(frozen=True)
class LooseMap:
    """A map as a file of its own: ``pixels`` (H, W, C) in [0, 1] (``srgb``: linear ones that a PNG
    shall encode), and ``facts`` for the list of maps."""

    name: str
    pixels: NDArray[np.float32]
    srgb: bool = False
    facts: dict[str, Any] = field(default_factory=dict)

    def encoded(self, suffix: str, bits: int) -> bytes:
        """The file."""
        if suffix == "exr":
            return images.encode_exr(self.pixels)
        shown = linear_to_srgb(np.clip(self.pixels, 0, 1)) if self.srgb else self.pixels
        return images.encode_png(quantise(shown, bits))


def loose_files(
    maps: Mapping[str, NDArray],
    covered: NDArray,
    missed: NDArray,
    options: BakingOptions,
    stem: str,
) -> dict[str, bytes]:
    """Image files by name, and ``<stem>_maps.json``, which says what each holds: encoding, and for
    displacement and curvature the scale and the mid-level. Lengths in metres."""
    files: dict[str, bytes] = {}
    listed: dict[str, dict[str, Any]] = {}
    suffix = options.texture_format
    for loose in _loose_maps(maps, covered, options):
        file = f"{stem}_{loose.name.replace('-', '_')}.{suffix}"
        files[file] = loose.encoded(suffix, options.bits)
        space = "srgb" if loose.srgb and suffix == "png" else "linear"
        listed[loose.name] = {"file": file, "color_space": space, **loose.facts}
    if options.wants("displacement"):
        d = displacement_of(maps["displacement"])
        common = {"color_space": "linear", "unit": "metre", "value": HEIGHT}
        for name, data, scale, mid in (
            (f"{stem}_displacement.png", height_png(d), d.scale, d.mid),
            (f"{stem}_displacement.exr", height_exr(maps["displacement"]), 1.0, 0.0),
        ):
            files[name] = data
            key = "displacement" if name.endswith("png") else "displacement-exr"
            listed[key] = {"file": name, "scale": scale, "mid_level": mid, **common}
    coverage = f"{stem}_coverage.png"
    files[coverage] = images.encode_png(coverage_picture(covered, missed))
    listed["coverage"] = {
        "file": coverage,
        "encoding": "white: found; red: missed, filled; black: outside of charts",
    }
    files[f"{stem}_maps.json"] = json.dumps(
        {"texels": list(covered.shape), "maps": listed}, indent=1
    ).encode()
    return files


HEIGHT = "scale * (texel - mid_level)"


def _loose_maps(
    maps: Mapping[str, NDArray], covered: NDArray, options: BakingOptions
) -> Iterator[LooseMap]:
    """The maps asked for, but the displacement."""
    if options.wants("base-color"):
        yield LooseMap("base-color", stack_maps(maps, "red", "green", "blue"), srgb=True)
    if options.wants("orm"):
        yield LooseMap(
            "orm", orm_image(maps), facts={"channels": "occlusion, roughness, metalness"}
        )
    unit = {"encoding": "(n + 1) / 2"}
    if options.wants("normal"):
        pixels = normal_image(maps, flip_green=options.green == "directx")
        yield LooseMap(
            "normal",
            pixels,
            facts={"space": "tangent (MikkTSpace)", "green": options.green, **unit},
        )
    if options.wants("object-normal"):
        yield LooseMap(
            "object-normal", normal_image(maps, "object"), facts={"space": "object, +Y up", **unit}
        )
    if EMISSION[0] in maps:
        pixels = stack_maps(maps, *EMISSION)
        yield LooseMap("emission", pixels, srgb=True)
    if options.wants("ao"):
        yield LooseMap(
            "ao", stack_maps(maps, "occlusion"), facts={"encoding": "1: open, 0: occluded"}
        )
    if options.wants("curvature"):
        exr = options.texture_format == "exr"
        scale, mid = (1.0, 0.0) if exr else (2 * curvature_scale(maps, covered), 0.5)
        facts = {"unit": "1 / metre", "value": HEIGHT, "scale": scale, "mid_level": mid}
        yield LooseMap(
            "curvature",
            stack_maps(maps, "curvature") / np.float32(scale) + np.float32(mid),
            facts=facts,
        )


def coverage_picture(covered: NDArray, missed: NDArray) -> NDArray[np.uint8]:
    """(H, W, 3): white where a ray found the heavy mesh, red where it missed, black outside of the
    charts."""
    out = np.zeros((*covered.shape, 3), np.uint8)
    out[covered] = 255
    out[missed] = (255, 0, 0)
    return out
