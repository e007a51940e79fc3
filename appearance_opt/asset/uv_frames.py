"""Textures of one material under transforms or wrap modes that differ, resampled so that they share them.

A material here has one set of texture coordinates, one transform and one wrap mode. Where a file says otherwise, each
texture is drawn into an image that spans the coordinates which the meshes use, and the coordinates are moved there.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Mesh, Texture, Wrap

MAX_TEXELS = 1 << 25
"""Texels of a resampled texture at most."""

BAND = 1 << 20
"""Texels resampled at once."""


def affine(transform: Mapping[str, Any] | None) -> NDArray[np.float64]:
    """(2, 3) matrix of KHR_texture_transform: offset, then rotation, then scale, as the extension composes them."""
    t = transform or {}
    angle = float(t.get("rotation", 0.0))
    c, s = np.cos(angle), np.sin(angle)
    linear = np.array([[c, s], [-s, c]]) @ np.diag(np.array(t.get("scale", (1, 1)), np.float64))
    return np.concatenate([linear, np.array(t.get("offset", (0, 0)), np.float64)[:, None]], axis=1)


def usd_affine(scale: Sequence[float], rotation: float, translation: Sequence[float]) -> NDArray[np.float64]:
    """(2, 3) matrix of UsdTransform2d (scale, then rotation in degrees, then translation), which counts v upward, for
    coordinates that count it downward."""
    angle = np.radians(rotation)
    c, s = np.cos(angle), np.sin(angle)
    (a, b), (p, q) = np.array([[c, -s], [s, c]]) @ np.diag(np.array(scale, np.float64))
    return np.array([[a, -b, b + translation[0]], [-p, q, 1 - q - translation[1]]])


def apply(matrix: NDArray, points: NDArray) -> NDArray[np.float64]:
    """(N, 2) points under a (2, 3) matrix."""
    return points @ matrix[:, :2].T + matrix[:, 2]


def unified(
    meshes: Sequence[Mesh], frames_of: Mapping[int, Mapping[str, NDArray]], note: Callable[[str], None]
) -> list[Mesh]:
    """The meshes with the transforms of their textures applied, and textures brought under one transform and wrap mode
    where they differ. ``frames_of``: by ``id`` of a material, the transform (2, 3) of each of its textures by field
    name; materials that are not there stay. ``note``: told what was resampled."""
    out = list(meshes)
    wearers: dict[int, list[int]] = {}
    for k, m in enumerate(meshes):
        if m.uvs is not None:
            wearers.setdefault(id(m.material), []).append(k)
    for own in wearers.values():
        material = meshes[own[0]].material
        frames = {n: f for n, f in frames_of.get(id(material), {}).items() if getattr(material, n) is not None}
        if not frames:
            continue
        textures = {n: getattr(material, n) for n in frames}
        uvs = [np.asarray(meshes[k].uvs) for k in own]
        new = material
        placed = [apply(next(iter(frames.values())), uv).astype(np.float32) for uv in uvs]
        if not alike(uvs, textures, frames):
            # tangents follow the coordinates, and the normal map follows the tangents
            leading = "normal_texture" if "normal_texture" in textures else next(iter(textures))
            found = in_one_frame(uvs, textures, frames, leading)
            differ = f"material '{material.name}': its textures differ in transform or wrap mode"
            if found is None:
                note(f"{differ}, and are too large to be resampled: the first one's are used for all")
            else:
                note(f"{differ}: resampled to common texture coordinates")
                placed, new = found[0], replace(material, **found[1])  # type: ignore[arg-type]
        for k, uv in zip(own, placed, strict=True):
            out[k] = replace(meshes[k], uvs=uv, material=new)
    return out


def kept(
    meshes: Sequence[Mesh], frames_of: Mapping[int, Mapping[str, NDArray]], note: Callable[[str], None]
) -> list[Mesh]:
    """The meshes as they are, for ``keep_layout`` of ``asset.load``; ``note`` is told whose textures would have been
    moved. Parameters as for ``unified``."""
    for material in {id(m.material): m.material for m in meshes}.values():
        frames = frames_of.get(id(material), {})
        moved = [n for n, f in frames.items() if getattr(material, n) is not None and not np.allclose(f, affine(None))]
        if moved:
            which = ", ".join(n.replace("_texture", "").replace("_", " ") for n in moved)
            told = f"material '{material.name}': the transform of its textures ({which}) is not applied"
            note(f"{told}: the mesh keeps its texture coordinates")
    return list(meshes)


def alike(uvs: Sequence[NDArray], textures: Mapping[str, Texture], frames: Mapping[str, NDArray]) -> bool:
    """Can the textures share the first one's transform and wrap mode? Wrap modes do not matter within the image."""
    first = next(iter(frames.values()))
    if any(not np.allclose(frame, first, atol=1e-9) for frame in frames.values()):
        return False
    if len({mode for t in textures.values() for mode in t.wrap}) == 1:
        return True
    placed = np.concatenate([apply(first, uv) for uv in uvs])
    return bool(placed.min() >= -1e-6 and placed.max() <= 1 + 1e-6)


def in_one_frame(
    uvs: Sequence[NDArray], textures: Mapping[str, Texture], frames: Mapping[str, NDArray], leading: str
) -> tuple[list[NDArray[np.float32]], dict[str, Texture]] | None:
    """(new texture coordinates (N, 2) each, new textures), or None if the images would be too large.

    ``frames``: the transform of each texture, (2, 3). ``leading``: the texture whose frame the others are brought
    to; where it is the finest, it is copied texel by texel. The others are read bilinearly.
    """
    frame = frames[leading]
    if min(abs(np.linalg.det(f[:, :2])) for f in frames.values()) < 1e-12:
        return None
    height, width = textures[leading].pixels.shape[:2]
    back = np.linalg.inv(frame[:, :2])
    # enough texels for the finest of them, in whole multiples so that the leading one's texels stay texels
    finer = 1.0
    for name, texture in textures.items():
        step = frames[name][:, :2] @ back * np.array(texture.pixels.shape[1::-1])[:, None]
        finer = max(finer, *(np.linalg.norm(step, axis=0) / (width, height)))
    size = np.array([width, height]) * int(np.ceil(finer - 1e-6))
    placed = [apply(frame, uv) * size for uv in uvs]
    low = np.floor(np.min([p.min(axis=0) for p in placed], axis=0)) - 1
    extent = np.ceil(np.max([p.max(axis=0) for p in placed], axis=0)) + 1 - low
    if not extent.prod() <= MAX_TEXELS:  # nor for coordinates that are no numbers
        return None
    to_uv = np.concatenate([back, -back @ frame[:, 2:]], axis=1)
    new = {n: _resampled(t, frames[n], to_uv, low, size, extent) for n, t in textures.items()}
    return [((p - low) / extent).astype(np.float32) for p in placed], new


def _resampled(
    texture: Texture, frame: NDArray, to_uv: NDArray, low: NDArray, size: NDArray, extent: NDArray
) -> Texture:
    columns, rows = int(extent[0]), int(extent[1])
    out = np.empty((rows, columns, texture.pixels.shape[2]), texture.pixels.dtype)
    step = max(1, BAND // columns)
    for start in range(0, rows, step):
        y, x = np.meshgrid(np.arange(start, min(start + step, rows)), np.arange(columns), indexing="ij")
        centres = (np.stack([x.ravel(), y.ravel()], axis=1) + 0.5 + low) / size
        values = _bilinear(texture, apply(frame, apply(to_uv, centres)))
        if out.dtype.kind == "u":
            values = np.rint(values)
        out[start : start + step] = values.reshape(*x.shape, -1).astype(out.dtype)
    return replace(texture, pixels=out, wrap=("clamp", "clamp"))


def _bilinear(texture: Texture, uv: NDArray) -> NDArray[np.float64]:
    """Stored values (N, C) at texture coordinates, wrapped as the texture says."""
    height, width = texture.pixels.shape[:2]
    # the rounding of a frame there and back must not mix neighbours
    at = np.round(uv * (width, height) - 0.5, 6)
    corner = np.floor(at)
    fraction = at - corner
    out = np.zeros((len(uv), texture.pixels.shape[2]))
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - fraction[:, 0]) * np.abs(1 - dy - fraction[:, 1])
            column = _wrapped(corner[:, 0].astype(np.int64) + dx, width, texture.wrap[0])
            row = _wrapped(corner[:, 1].astype(np.int64) + dy, height, texture.wrap[1])
            out += weight[:, None] * texture.pixels[row, column]
    return out


def _wrapped(index: NDArray[np.int64], size: int, mode: Wrap) -> NDArray[np.int64]:
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "repeat":
        return index % size
    folded = index % (2 * size)
    return np.minimum(folded, 2 * size - 1 - folded)
