"""How large an asset is: in triangles, in a file, in memory, in calls of an engine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from appearance_opt.asset.types import Asset, Material, Texture


@dataclass(frozen=True)
class MapSize:
    """A texture: what it is for, pixels, channels and bits of each."""

    name: str
    width: int
    height: int
    channels: int
    bits: int


@dataclass(frozen=True)
class Sizes:
    """``draw_calls``: meshes, as an engine draws each with one material by one call; ``texture_bytes``:
    of all textures in a graphics card's memory, four bytes per texel and mip levels; ``file_bytes``:
    of the file and what it refers to, None if not known."""

    triangles: int
    vertices: int
    draw_calls: int
    materials: int
    maps: tuple[MapSize, ...]
    texture_bytes: int
    file_bytes: int | None


def sizes_of(asset: Asset, files: Iterable[Path] = ()) -> Sizes:
    """The sizes of an asset; ``files``: those that hold it. What has vanished counts for nothing."""
    materials = list({id(m.material): m.material for m in asset.meshes}.values())
    textures: dict[int, tuple[str, Texture]] = {}
    for material in materials:
        for name, texture in _maps(material):
            textures.setdefault(id(texture.pixels), (name, texture))
    maps = tuple(
        MapSize(
            name, t.pixels.shape[1], t.pixels.shape[0], t.pixels.shape[2], 8 * t.pixels.itemsize
        )
        for name, t in textures.values()
    )
    found = [path.stat().st_size for path in set(files) if path.is_file()]
    return Sizes(
        triangles=asset.triangle_count,
        vertices=sum(len(m.positions) for m in asset.meshes),
        draw_calls=sum(len(m.faces) > 0 for m in asset.meshes),
        materials=len(materials),
        maps=maps,
        texture_bytes=sum(4 * m.width * m.height * 4 // 3 for m in maps),
        file_bytes=sum(found) or None,
    )


def _maps(m: Material) -> list[tuple[str, Texture]]:
    named = (
        ("base colour", m.base_color_texture),
        ("roughness, metalness", m.orm_texture),
        ("normal", m.normal_texture),
        ("displacement", None if m.displacement is None else m.displacement.texture),
        ("emission", m.emission_texture),
        ("transmission", m.transmission_texture),
        ("thickness", m.thickness_texture),
    )
    return [(name, texture) for name, texture in named if texture is not None]


def in_bytes(count: int) -> str:
    """12 bytes, 3.4 kB, 560 kB, 1.2 MB: powers of a thousand, as shops and web pages count."""
    if count < 1000:
        return f"{count} bytes"
    for unit in ("kB", "MB", "GB"):
        count_in = count / 1000 ** ("kB", "MB", "GB").index(unit) / 1000
        if count_in < 999.5 or unit == "GB":
            return f"{count_in:.1f} {unit}" if count_in < 9.95 else f"{count_in:.0f} {unit}"
    raise AssertionError
