"""How maps are baked from one mesh to another."""

from __future__ import annotations

from dataclasses import dataclass

from appearance_opt.options.option import Record, names_for, option

MAPS = (
    "normal",
    "material",
    "base-color",
    "orm",
    "displacement",
    "object-normal",
    "ao",
    "curvature",
    "emission",
)
HITS = ("nearest", "outermost")
GREENS = ("opengl", "directx")
TEXTURE_FORMATS = ("png", "exr")


@dataclass(frozen=True)
class BakingOptions(Record):
    """``maps``: any of ``MAPS``; "material" is base-color, orm and, if HIGH emits any, emission.
    ``samples``: rays per texel; ``cage``: how far they go outward and inward (metres), by default
    from the two meshes; ``hit``: which surface that faces the texel's way. ``bits``: of normal maps
    and of loose maps. ``ao_distance``: in metres."""

    maps: tuple[str, ...] = option(
        ("normal", "material"), "Maps to make.", panel="Output", choices=MAPS,
        parse=names_for("maps"),
    )  # fmt: skip
    closed_form: bool = option(
        False, "Rays alone, no fit: seconds.", panel="Baking", flag="--closed-form"
    )
    samples: int = option(4, "Rays per texel.", panel="Baking", low=1, high=64)
    cage: float | None = option(
        None,
        "How far rays go outward and inward, metres.",
        panel="Baking",
        above=0,
        expected="a positive distance in metres",
        automatic="from the two meshes",
    )
    hit: str = option("nearest", "Which surface rays take.", panel="Baking", choices=HITS)
    ao_rays: int = option(
        64, "Rays per sample of ambient occlusion.", panel="Baking", low=1, high=4096
    )
    ao_distance: float | None = option(
        None, "Reach of ambient occlusion, metres.", panel="Baking", above=0, automatic="any"
    )
    unwrap: bool = option(False, "Make a new atlas for LOW.", panel="Input", flag="--unwrap")
    align: bool = option(
        False, "Fit HIGH to LOW by translation and scale.", panel="Input", flag="--align"
    )
    green: str = option(
        "opengl", "Green channel of loose normal maps.", panel="Output", choices=GREENS
    )
    bits: int = option(
        8, "Of normal maps and loose maps.", panel="Output", choices=(8, 16), expected="8 or 16"
    )
    texture_format: str = option("png", "Of loose maps.", panel="Output", choices=TEXTURE_FORMATS)

    def wants(self, name: str) -> bool:
        """Is a map asked for? "material" is base-color, orm and emission."""
        return name in self.maps or (
            "material" in self.maps and name in ("base-color", "orm", "emission")
        )
