"""The maps of a result: textures, and a displacement of a tessellated mesh."""

from __future__ import annotations

from dataclasses import dataclass

from appearance_opt.options.option import Record, levels, option, require

MAX_SUBDIVISION, DEFAULT_SUBDIVISION = 4, 3


@dataclass(frozen=True)
class TextureOptions(Record):
    """``size``: texels per side of the new maps. ``normal_map``: make one at all."""

    size: int = option(
        1024,
        "Texels per side of the maps: a power of two.",
        panel="Output",
        key="texture_size",
        choices=tuple(2**k for k in range(4, 14)),
        expected="a power of two from 16 to 8192",
        metavar="16..8192",
    )
    normal_map: bool = option(True, "Make a normal map at all.", panel="Output")


@dataclass(frozen=True)
class DisplacementOptions(Record):
    """``fitted``: fit a displacement map, on the mesh tessellated to the levels of ``subdivision``
    (none given: 3). ``write_tessellated``: write those meshes, too."""

    fitted: bool = option(
        False, "Fit a displacement map.", panel="Displacement", key="displacement",
        flag="--displacement",
    )  # fmt: skip
    subdivision: tuple[int, ...] = option(
        (),
        "Tessellation levels: 3, or 1,2,3 for all of them.",
        panel="Displacement",
        low=0,
        high=MAX_SUBDIVISION,
        automatic=str(DEFAULT_SUBDIVISION),
        metavar="LEVELS",
        parse=levels,
    )
    rate: float | None = option(
        None,
        "Learning rate of the displacement, in units of the finest edge length.",
        panel="Displacement",
        key="displacement_rate",
        low=0,
        high=1,
        automatic="by the start",
    )
    write_tessellated: bool = option(
        False,
        "Also write the displaced mesh of each level.",
        panel="Displacement",
        flag="--write-tessellated",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.fitted:
            together = "given together with --displacement"
            require(not self.subdivision, "subdivision", self.subdivision, together)
            require(not self.write_tessellated, "write-tessellated", "", together)
            require(self.rate is None, "displacement-rate", self.rate, together)

    def levels(self) -> tuple[int, ...]:
        """Levels at which the mesh is drawn, in ascending order."""
        if not self.fitted:
            return (0,)
        return tuple(sorted(set(self.subdivision))) or (DEFAULT_SUBDIVISION,)
