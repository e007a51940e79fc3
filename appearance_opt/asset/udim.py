"""Textures in tiles, one file for each unit square of the texture coordinates.

The name of such a texture holds ``<UDIM>``, which stands for 1001 + column + 10 * row, counted from
the lower left square, ten to a row, or ``<UVTILE>``, for ``u<column + 1>_v<row + 1>`` (MaterialX
specification, "Filename Substitutions"). Here each tile that faces lie on becomes a material of its
own, and the meshes are taken apart along the tiles, which faces do not cross: nothing is resampled.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING
from urllib.parse import unquote

import numpy as np

from appearance_opt.asset.types import Texture, linear_to_srgb
from appearance_opt.errors import InputError, MissingFileError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, MutableMapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from appearance_opt.asset.companions import Companions
    from appearance_opt.asset.types import Material, Mesh
    from appearance_opt.asset.uv_transforms import UvTransform

FIRST, COLUMNS = 1001, 10
MAX_ROWS = 899  # 1001 to 9990

MAX_TEXELS = 1 << 26
"""Texels of all tiles of a texture at most: four times 4096 x 4096. More tiles are read at a half,
a third ... of their size."""

CROSSING = 1e-3
"""How far a face may reach into the next tile without being counted as one that crosses."""

_TOKEN = re.compile("<(UDIM|UVTILE)>", re.IGNORECASE)


@dataclass(frozen=True)
class Tile:
    """``number``: as in names with ``<UDIM>``; ``texels``: those that each texture may have
    there."""

    number: int
    texels: int


def is_tiled(name: str) -> bool:
    """Does the name of a file stand for those of several tiles?"""
    return bool(_TOKEN.search(unquote(name)))


def tile_name(name: str, number: int) -> str:
    """The name of one of them."""
    row, column = divmod(number - FIRST, COLUMNS)
    return _TOKEN.sub(
        lambda m: str(number) if m[1].upper() == "UDIM" else f"u{column + 1}_v{row + 1}",
        unquote(name),
    )


def read_tile(
    name: str,
    tile: Tile,
    owner: Path,
    companions: Companions,
    read: Callable[[str], NDArray],
    found: bool = False,
) -> NDArray | None:
    """Pixels of a tile, as ``read`` reads the file of a name; None, with a note, if it is missing
    among others. ``found``: is it known that there are any? None at all is a missing texture as any
    other. Raises InputError."""
    file = tile_name(name, tile.number)
    try:
        return read(file)
    except MissingFileError:
        if not found and not _any_tile(name, owner):
            missing = MissingFileError(f"{owner}: refers to '{name}', of which there is no tile")
            return companions.read(partial(_raise, missing))
    except InputError as error:
        return companions.read(partial(_raise, error))
    companions.note(f"'{file}' does not exist: the material's constants stand alone there")
    return None


def _raise(error: Exception) -> NDArray:
    raise error


def _any_tile(name: str, owner: Path) -> bool:
    path = owner.resolve().parent / unquote(name).replace("\\", "/")
    pattern = (
        re.escape(path.name.lower()).replace("<udim>", r"\d{4}").replace("<uvtile>", r"u\d+_v\d+")
    )
    folders = {path.parent, owner.resolve().parent}
    names = (f.name.lower() for folder in folders if folder.is_dir() for f in folder.iterdir())
    return any(re.fullmatch(pattern, n) for n in names)


def fit_to_tile(texture: Texture, tile: Tile, companions: Companions) -> Texture:
    """A tile's texture at a half, a third ... of its size, as means of linear values, so that it
    has no more texels than it may; it ends at its edge. ``note`` is told."""
    texture = replace(texture, wrap=("clamp", "clamp"))
    height, width, channels = texture.pixels.shape
    step = next(
        k for k in range(1, height * width + 1) if (height // k) * (width // k) <= tile.texels
    )
    step = min(step, height, width)
    if step == 1:
        return texture
    companions.note(
        f"tiles of textures of {width} x {height} texels are read at 1/{step} of their size: there are many"
    )
    bytes_per_texel = channels * texture.pixels.dtype.itemsize
    rows, columns = height // step, width // step
    companions.budget.give_back_picture(width, height, bytes_per_texel)
    companions.budget.take_picture(columns, rows, bytes_per_texel, "tiles")
    blocks = texture.linear()[: rows * step, : columns * step].reshape(
        rows, step, columns, step, channels
    )
    means = blocks.mean(axis=(1, 3), dtype=np.float32)
    if texture.pixels.dtype.kind == "f":
        return replace(texture, pixels=means, color_space="linear")
    if texture.color_space == "srgb":
        means[..., :3] = linear_to_srgb(means[..., :3])
    whole = np.iinfo(texture.pixels.dtype).max
    return replace(texture, pixels=np.rint(means * np.float32(whole)).astype(texture.pixels.dtype))


def split(
    meshes: Sequence[Mesh],
    readers: Mapping[int, Callable[[Tile], Material]],
    transforms_of: MutableMapping[int, dict[str, UvTransform]],
    note: Callable[[str], None],
) -> list[Mesh]:
    """The meshes, those whose material is in ``readers`` (by ``id``) taken apart into their tiles.

    ``readers`` read the material of a tile. ``transforms_of``: by ``id`` of a material, where its
    textures read (``uv_unification.unify``); for the tiles' materials, which ``readers`` put there,
    it is moved to their unit squares.
    """
    tiles = {k: _tiles(m, next(iter(transforms_of[id(m.material)].values()))) for k, m in enumerate(meshes)
             if id(m.material) in readers and m.uvs is not None}  # fmt: skip
    used: dict[int, set[int]] = {}
    for k, (tile, _) in tiles.items():
        used.setdefault(id(meshes[k].material), set()).update(np.unique(tile[tile > 0]).tolist())
    materials: dict[tuple[int, int], Material] = {}
    out: list[Mesh] = []
    crossing: dict[str, int] = {}
    for k, mesh in enumerate(meshes):
        if k not in tiles:
            out.append(mesh)
            continue
        tile, crosses = tiles[k]
        crossing[mesh.material.name] = crossing.get(mesh.material.name, 0) + crosses
        for number in np.unique(tile).tolist():
            key = (id(mesh.material), number)
            if key not in materials:
                materials[key] = mesh.material
                if number:
                    materials[key] = readers[key[0]](Tile(number, MAX_TEXELS // len(used[key[0]])))
                    _move(transforms_of[id(materials[key])], number)
            part = _part(mesh, tile == number)
            out.append(
                replace(
                    part,
                    material=materials[key],
                    name=f"{mesh.name}.{number}" if number else mesh.name,
                )
            )
    for name, count in crossing.items():
        if count:
            note(
                f"material '{name}': {count} faces cross the border of a tile: the tile of their middle is taken"
            )
    return out


def _tiles(mesh: Mesh, transform: UvTransform) -> tuple[NDArray[np.int64], int]:
    """(the tile of each face, 0 outside of all; how many faces cross a border)."""
    uvs = transform.of(np.asarray(mesh.uvs, np.float64))
    inside = np.asarray(
        ((mesh.faces >= 0) & (mesh.faces < len(uvs))).all(axis=1)
    )  # the rest is for ``repair``
    corners = uvs[np.where(inside[:, None], mesh.faces, 0)]
    corners = np.stack([corners[..., 0], 1 - corners[..., 1]], axis=-1)
    with np.errstate(invalid="ignore"):
        at = np.floor(corners.mean(axis=1))
        inside &= ((at >= 0) & (at < (COLUMNS, MAX_ROWS))).all(axis=1)
        beyond = np.maximum(at - corners.min(axis=1), corners.max(axis=1) - at - 1)
    at = np.where(inside[:, None], at, 0).astype(np.int64)
    crosses = inside & (beyond.max(axis=1) > CROSSING)
    return np.where(inside, FIRST + at[:, 0] + COLUMNS * at[:, 1], 0), int(crosses.sum())


def _move(transforms: dict[str, UvTransform], tile: int) -> None:
    """Move where textures read from a tile to the unit square; v counts downward here, tiles
    upward."""
    row, column = divmod(tile - FIRST, COLUMNS)
    for name, transform in transforms.items():
        matrix = transform.matrix.copy()
        matrix[:, 2] += (-column, row)
        transforms[name] = replace(transform, matrix=matrix)


def _part(mesh: Mesh, chosen: NDArray) -> Mesh:
    """Some faces of a mesh, and the vertices that they use."""
    faces = mesh.faces[chosen]
    inside = np.unique(faces[(faces >= 0) & (faces < len(mesh.positions))])
    number = np.full(len(mesh.positions) + 1, -1, np.int64)
    number[inside] = np.arange(len(inside))
    faces = np.where(
        (faces >= 0) & (faces < len(mesh.positions)),
        number[np.clip(faces, 0, len(number) - 1)],
        faces,
    )

    return mesh.take(inside, faces)
