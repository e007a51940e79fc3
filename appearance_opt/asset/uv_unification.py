"""Textures of one material under transforms or wrap modes that differ, resampled so that they share
them.

A material here has one set of texture coordinates, one transform and one wrap mode. Where a file
says otherwise, each texture is drawn into an image that spans the coordinates which the meshes use,
and the coordinates are moved there. ``uv_sets`` does this for textures that read different sets of
coordinates.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset import udim
from appearance_opt.asset.resampling import BAND, MAX_TEXELS, Resampled, bilinear, bilinear_grid
from appearance_opt.asset.uv_sets import under_one_set
from appearance_opt.asset.uv_transforms import affine, apply, compose

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Material, Mesh, Texture
    from appearance_opt.asset.udim import Tile
    from appearance_opt.asset.uv_transforms import UvTransform

ASSET_TEXELS = 1 << 27
"""Texels of all resampled textures of an asset at most: a small picture, repeated often, may stand
for any number."""


def apply_all(
    meshes: Sequence[Mesh],
    transforms_of: dict[int, dict[str, UvTransform]],
    note: Callable[[str], None],
    tiles: Mapping[int, Callable[[Tile], Material]],
    keep_layout: bool,
) -> list[Mesh]:
    """What a reader's meshes become: taken apart into the ``tiles`` of their textures
    (``udim.split``), then ``unify``; or all as it is (``keep_layout``: see ``asset.load``)."""
    if keep_layout:
        return keep_first_sets(meshes, transforms_of, note)
    return unify(
        udim.split(meshes, tiles, transforms_of, note) if tiles else meshes, transforms_of, note
    )


def unify(
    meshes: Sequence[Mesh],
    transforms_of: Mapping[int, Mapping[str, UvTransform]],
    note: Callable[[str], None],
) -> list[Mesh]:
    """The meshes with the transforms of their textures applied, and textures brought under one set
    of coordinates, one transform and one wrap mode where they differ. ``transforms_of``: by ``id``
    of a material, the transform of each of its textures by field name; materials that are not there
    stay. ``note``: told what was resampled."""
    out, left = list(meshes), ASSET_TEXELS
    for own in _by_material(meshes):
        material = meshes[own[0]].material
        transforms = {
            n: f
            for n, f in transforms_of.get(id(material), {}).items()
            if getattr(material, n) is not None
        }
        if not transforms:
            for k in own:
                out[k] = _first_set(meshes[k])
            continue
        textures = {n: getattr(material, n) for n in transforms}
        uvs = [np.asarray(meshes[k].uvs) for k in own]
        transforms = _where_sets_differ(uvs, transforms)
        first = next(iter(transforms.values()))
        placed, new, differ = [first.of(uv).astype(np.float32) for uv in uvs], material, ""
        own_tangents = True
        if any(f.coordinates != first.coordinates for f in transforms.values()):
            differ = "texture coordinates"
        elif not alike(uvs, textures, transforms):
            differ = "transform or wrap mode"
        if differ:
            told = f"material '{material.name}': its textures differ in {differ}"
            found = _resample_alike(
                told, [meshes[k] for k in own], textures, transforms, left, note
            )
            if found is not None:
                left -= sum(t.pixels.shape[0] * t.pixels.shape[1] for t in found.textures.values())
                placed, new = found.uvs, replace(material, **found.textures)  # type: ignore[arg-type]
                own_tangents = found.keeps_tangents
        for k, uv in zip(own, placed, strict=True):
            tangents = meshes[k].tangents if own_tangents else None
            out[k] = replace(meshes[k], uvs=uv, tangents=tangents, material=new)
    return out


def _by_material(meshes: Sequence[Mesh]) -> list[list[int]]:
    """Numbers of the meshes with texture coordinates, those of one material together."""
    out: dict[int, list[int]] = {}
    for k, mesh in enumerate(meshes):
        if mesh.uvs is not None:
            out.setdefault(id(mesh.material), []).append(k)
    return list(out.values())


def _first_set(mesh: Mesh) -> Mesh:
    return (
        mesh if mesh.uvs is None or mesh.uvs.shape[1] == 2 else replace(mesh, uvs=mesh.uvs[:, :2])
    )


def _where_sets_differ(
    uvs: Sequence[NDArray], transforms: Mapping[str, UvTransform]
) -> dict[str, UvTransform]:
    """The transforms, on as few sets as there are different ones: many files repeat their only
    set."""
    used = list(dict.fromkeys(f.coordinates for f in transforms.values()))
    same: dict[int, int] = {}
    for k in used:
        equal = (j for j in used[: used.index(k)] if all(_columns_equal(uv, j, k) for uv in uvs))
        same[k] = next(equal, k)
    return {n: replace(f, coordinates=same[f.coordinates]) for n, f in transforms.items()}


def _columns_equal(uvs: NDArray, first: int, second: int) -> bool:
    return bool(
        np.array_equal(uvs[:, 2 * first : 2 * first + 2], uvs[:, 2 * second : 2 * second + 2])
    )


def _resample_alike(
    told: str,
    meshes: Sequence[Mesh],
    textures: Mapping[str, Texture],
    transforms: Mapping[str, UvTransform],
    most: int,
    note: Callable[[str], None],
) -> Resampled | None:
    """The textures of ``meshes`` under one transform, or None if each would be too large, or all
    together larger than ``most`` texels; ``note`` is told, after ``told``."""
    each = min(MAX_TEXELS, most // len(textures))
    if len({f.coordinates for f in transforms.values()}) > 1:
        found = under_one_set(meshes, textures, transforms, each)
    else:
        # tangents follow the coordinates, and the normal map follows the tangents
        leading = "normal_texture" if "normal_texture" in textures else next(iter(textures))
        found = under_one_transform(
            [np.asarray(m.uvs) for m in meshes], textures, transforms, leading, each
        )
    if found is None:
        note(f"{told}, and are too large to be resampled: the first one's are used for all")
    else:
        note(f"{told}: resampled to {found.what}")
    return found


def keep_first_sets(
    meshes: Sequence[Mesh],
    transforms_of: Mapping[int, Mapping[str, UvTransform]],
    note: Callable[[str], None],
) -> list[Mesh]:
    """The meshes with the first set of texture coordinates that their materials read, as it is, for
    ``keep_layout`` of ``asset.load``; ``note`` is told whose textures would have been moved.
    Parameters as for ``unify``."""
    for material in {id(m.material): m.material for m in meshes}.values():
        transforms = transforms_of.get(id(material), {})
        unmoved = (
            np.allclose(f.matrix, affine(None)) and f.coordinates == 0 for f in transforms.values()
        )
        moved = [
            n
            for n, still in zip(transforms, unmoved, strict=True)
            if getattr(material, n) is not None and not still
        ]
        if moved:
            which = ", ".join(n.replace("_texture", "").replace("_", " ") for n in moved)
            told = f"material '{material.name}': the transform of its textures ({which}) is not applied"
            note(f"{told}: the mesh keeps its texture coordinates")
    return [_first_set(m) for m in meshes]


def alike(
    uvs: Sequence[NDArray], textures: Mapping[str, Texture], transforms: Mapping[str, UvTransform]
) -> bool:
    """Can the textures, of one set, share the first one's transform and wrap mode? Wrap modes do
    not matter within the image."""
    first = next(iter(transforms.values()))
    if any(
        not np.allclose(transform.matrix, first.matrix, atol=1e-9)
        for transform in transforms.values()
    ):
        return False
    if len({mode for t in textures.values() for mode in t.wrap}) == 1:
        return True
    placed = np.concatenate([first.of(uv) for uv in uvs])
    return bool(placed.min() >= -1e-6 and placed.max() <= 1 + 1e-6)


def under_one_transform(
    uvs: Sequence[NDArray],
    textures: Mapping[str, Texture],
    transforms: Mapping[str, UvTransform],
    leading: str,
    most: int = MAX_TEXELS,
) -> Resampled | None:
    """Textures that read the same set of coordinates under one transform, or None if the images
    would have more than ``most`` texels.

    ``transforms``: those of the textures, on one set of coordinates. ``leading``: the texture whose
    transform the others are brought to; where it is the finest, it is copied texel by texel. The
    others are read bilinearly.
    """
    transform = transforms[leading].matrix
    if min(abs(np.linalg.det(f.matrix[:, :2])) for f in transforms.values()) < 1e-12:
        return None
    height, width = textures[leading].pixels.shape[:2]
    back = np.linalg.inv(transform[:, :2])
    # enough texels for the finest of them, in whole multiples so that the leading one's texels stay
    # texels
    finer = 1.0
    for name, texture in textures.items():
        step = (
            transforms[name].matrix[:, :2] @ back * np.array(texture.pixels.shape[1::-1])[:, None]
        )
        finer = max(finer, *(np.linalg.norm(step, axis=0) / (width, height)))
    size = np.array([width, height]) * int(np.ceil(finer - 1e-6))
    placed = [transforms[leading].of(uv) * size for uv in uvs]
    low = np.floor(np.min([p.min(axis=0) for p in placed], axis=0)) - 1
    extent = np.ceil(np.max([p.max(axis=0) for p in placed], axis=0)) + 1 - low
    if not extent.prod() <= most:  # nor for coordinates that are no numbers
        return None
    to_uv = np.concatenate([back, -back @ transform[:, 2:]], axis=1)
    new = {
        n: _resample(t, transforms[n].matrix, to_uv, low, size, extent) for n, t in textures.items()
    }
    return Resampled([((p - low) / extent).astype(np.float32) for p in placed], new)


def _resample(
    texture: Texture,
    transform: NDArray,
    to_uv: NDArray,
    low: NDArray,
    size: NDArray,
    extent: NDArray,
) -> Texture:
    columns, rows = int(extent[0]), int(extent[1])
    out = np.empty((rows, columns, texture.pixels.shape[2]), texture.pixels.dtype)
    whole = compose(transform, to_uv)
    step = max(1, BAND // columns)
    for start in range(0, rows, step):
        row, column = np.arange(start, min(start + step, rows)), np.arange(columns)
        if abs(whole[0, 1]) + abs(whole[1, 0]) < 1e-12:
            u = whole[0, 0] * (column + 0.5 + low[0]) / size[0] + whole[0, 2]
            v = whole[1, 1] * (row + 0.5 + low[1]) / size[1] + whole[1, 2]
            values = bilinear_grid(texture, u, v)
        else:
            y, x = np.meshgrid(row, column, indexing="ij")
            centres = (np.stack([x.ravel(), y.ravel()], axis=1) + 0.5 + low) / size
            values = bilinear(texture, apply(whole, centres)).reshape(*x.shape, -1)
        if out.dtype.kind == "u":
            values = np.rint(values)
        out[start : start + step] = values.astype(out.dtype)
    return replace(texture, pixels=out, wrap=("clamp", "clamp"))
