"""Textures of one material that read different sets of texture coordinates, drawn into the layout
of one of them.

A texel of the new images lies on a face of the leading layout; the face says where the other sets
read there. Where the leading layout puts several faces at one place, they share its texels, and one
of them wins: the layout with the least of this leads.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.resampling import BAND, MAX_TEXELS, Resampled, bilinear

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Mesh, Texture
    from appearance_opt.asset.uv_transforms import UvTransform

PROBE = 512
"""Texels along the longer side of the image in which shared places of a layout are counted."""

SHARED = 0.02
"""Shares of a layout that differ by less count as equal."""

DENSE = 0.95
"""Share of the surface on which the new images have as many texels as the textures, if there is
room."""

SAMPLES = 20000
"""Points of the surface at which old and new values are compared."""


def under_one_set(
    meshes: Sequence[Mesh],
    textures: Mapping[str, Texture],
    transforms: Mapping[str, UvTransform],
    most: int = MAX_TEXELS,
) -> Resampled | None:
    """The textures drawn into the layout of one of their sets of coordinates, or None if the images
    would have more than ``most`` texels.

    ``meshes``: all that wear the material, their sets side by side (``uv_transforms.UvTransform``).
    Texels that no face uses hold what the nearest face continues to.
    """
    corners, positions = _corners(meshes, transforms)
    sizes = {n: np.array(t.pixels.shape[1::-1], np.float64) for n, t in textures.items()}
    leading = _leading(corners, sizes, transforms)
    multiple = _multiple(corners, sizes, leading)
    placed = corners[leading] * sizes[leading]
    if not np.isfinite(placed).all() or not len(placed):
        return None
    while multiple >= 1:
        low, extent = _box(placed * multiple)
        if extent.prod() <= most:
            break
        multiple -= 1
    else:
        return None
    size = sizes[leading] * multiple
    face = _faces(placed * multiple - low, extent)
    new = {}
    for name, texture in textures.items():
        to = _maps(corners[leading] * size - low, corners[name])
        turns = None
        if (
            name == "normal_texture"
            and transforms[name].coordinates != transforms[leading].coordinates
        ):
            turns = _turns(positions, corners[name], corners[leading])
        new[name] = _redraw(texture, face, to, turns)
    uvs = [
        ((transforms[leading].of(np.asarray(m.uvs)) * size - low) / extent).astype(np.float32)
        for m in meshes
    ]
    normal = transforms.get("normal_texture")
    turned = normal is not None and normal.coordinates != transforms[leading].coordinates
    loss = _loss(
        textures, new, corners, (corners[leading] * size - low) / extent, positions, turned
    )
    return Resampled(uvs, new, f"one set, {loss}", not turned)


def _corners(
    meshes: Sequence[Mesh], transforms: Mapping[str, UvTransform]
) -> tuple[dict[str, NDArray], NDArray]:
    """((F, 3, 2) places of the faces' corners in each texture, (F, 3, 3) their positions). Faces
    that cannot be used are left out: ``repair`` has not seen them yet."""
    places: dict[str, list[NDArray]] = {n: [] for n in transforms}
    positions = []
    for mesh in meshes:
        uvs = np.asarray(mesh.uvs, np.float64)
        inside = ((mesh.faces >= 0) & (mesh.faces < len(uvs))).all(axis=1)
        faces = mesh.faces[inside]
        finite = np.asarray(np.isfinite(uvs).all(axis=1))
        faces = faces[finite[faces].all(axis=1)]
        positions.append(mesh.positions[faces].astype(np.float64))
        for name, transform in transforms.items():
            places[name].append(transform.of(uvs)[faces])
    return {n: np.concatenate(v) for n, v in places.items()}, np.concatenate(positions)


def _leading(
    corners: Mapping[str, NDArray],
    sizes: Mapping[str, NDArray],
    transforms: Mapping[str, UvTransform],
) -> str:
    """The texture whose coordinates all others are drawn in: of the layout that has least at places
    shared by several faces, there the normal map, else the finest."""
    finest = sorted(transforms, key=lambda n: (n != "normal_texture", -sizes[n].prod()))
    shared: dict[int, float] = {}
    for name in finest:
        if transforms[name].coordinates not in shared:
            shared[transforms[name].coordinates] = _shared(corners[name])
    least = min(shared.values())
    return next(n for n in finest if shared[transforms[n].coordinates] <= least + SHARED)


def _shared(corners: NDArray) -> float:
    """Share of a layout's area that lies over itself."""
    spread = corners - corners.reshape(-1, 2).min(axis=0, initial=0)
    scale = PROBE / max(spread.max(initial=0.0), 1e-12)
    if not np.isfinite(scale):
        return 1.0
    area = np.abs(_doubled_areas(spread * scale)).sum() / 2
    covered = (_drawn_faces(spread * scale, (PROBE + 1, PROBE + 1), 0.0) >= 0).sum()
    return float(1 - min(covered / max(area, 1e-12), 1.0))


def _doubled_areas(corners: NDArray) -> NDArray:
    (a, b), (c, d) = ((corners[:, k] - corners[:, 0]).T for k in (1, 2))
    return a * d - b * c


def _multiple(corners: Mapping[str, NDArray], sizes: Mapping[str, NDArray], leading: str) -> int:
    """How many times as fine as the leading texture the new images must be along each side, so that
    nothing of the others gets lost on the share ``DENSE`` of the surface."""
    to_lead = corners[leading] * sizes[leading]
    weight = np.abs(_doubled_areas(to_lead))
    if not weight.sum() > 0:
        return 1
    finest = 1.0
    for name, size in sizes.items():
        linear = _maps(to_lead, corners[name] * size)[:, :, :2]
        ratio = np.linalg.norm(linear, axis=1).max(axis=1)
        order = np.argsort(ratio, kind="stable")
        reached = np.searchsorted(np.cumsum(weight[order]), DENSE * weight.sum())
        finest = max(finest, float(ratio[order][min(reached, len(order) - 1)]))
    return int(min(np.ceil(finest - 1e-3), 64))


def _maps(source: NDArray, target: NDArray) -> NDArray[np.float64]:
    """(F, 2, 3): for each face the affine map from the coordinates of ``source`` (F, 3, 2) to those
    of ``target``. Faces without area in the first map to their first corner."""
    doubled = _doubled_areas(source)
    flat = np.abs(doubled) < 1e-12
    (a, b), (c, d) = ((source[:, k] - source[:, 0]).T for k in (1, 2))
    over = np.where(flat, 0.0, 1 / np.where(flat, 1.0, doubled))
    inverse = np.stack([np.stack([d, -c], 1), np.stack([-b, a], 1)], axis=1) * over[:, None, None]
    edges = np.stack([target[:, 1] - target[:, 0], target[:, 2] - target[:, 0]], axis=2)
    linear = edges @ inverse
    offset = target[:, 0] - np.einsum("fij,fj->fi", linear, source[:, 0])
    return np.concatenate([linear, offset[:, :, None]], axis=2)


def _box(placed: NDArray) -> tuple[NDArray, NDArray]:
    low = np.floor(placed.reshape(-1, 2).min(axis=0)) - 1
    return low, np.ceil(placed.reshape(-1, 2).max(axis=0)) + 1 - low


def _faces(corners: NDArray, extent: NDArray) -> NDArray[np.int32]:
    """(rows, columns) the face of each texel: the one that covers its middle, else one that comes
    near, else the nearest."""
    from scipy.ndimage import distance_transform_edt

    shape = int(extent[1]), int(extent[0])
    near, within = (_drawn_faces(corners, shape, margin) for margin in (1.0, 0.0))
    out = np.where(within >= 0, within, near)
    if (out < 0).any() and (out >= 0).any():
        rows, columns = distance_transform_edt(out < 0, return_distances=False, return_indices=True)
        out = out[rows, columns]
    return np.maximum(out, 0)


def _drawn_faces(corners: NDArray, shape: tuple[int, int], margin: float) -> NDArray[np.int32]:
    """(rows, columns) the last face that comes within ``margin`` of a texel's middle along its row
    or column, or -1."""
    out = np.full(shape, -1, np.int32)
    low, high = corners.min(axis=1), corners.max(axis=1)
    first = np.clip(np.ceil(low[:, 1] - 0.5 - margin), 0, shape[0]).astype(np.int64)
    rows = np.clip(np.floor(high[:, 1] - 0.5 + margin) + 1, 0, shape[0]).astype(np.int64) - first
    cost = np.cumsum(np.maximum(rows, 0) * (2 + high[:, 0] - low[:, 0]))
    start = 0
    while start < len(corners):
        end = max(start + 1, int(np.searchsorted(cost, (cost[start - 1] if start else 0) + BAND)))
        _draw(
            out, corners[start:end], first[start:end], np.maximum(rows[start:end], 0), margin, start
        )
        start = end
    return out


def _draw(
    out: NDArray[np.int32],
    corners: NDArray,
    first: NDArray,
    rows: NDArray,
    margin: float,
    number: int,
) -> None:
    """Write the numbers of faces, from ``number`` on, into the texels of their ``rows`` rows from
    ``first`` on."""
    face, y = _counted(rows)
    y = y + first[face]
    p = corners[face]
    at = np.clip(y + 0.5, p[..., 1].min(axis=1), p[..., 1].max(axis=1))
    left, right = np.full(len(at), np.inf), np.full(len(at), -np.inf)
    for k in range(3):
        (ax, ay), (bx, by) = p[:, k].T, p[:, (k + 1) % 3].T
        flat = ay == by
        t = np.where(flat, 0.0, (at - ay) / np.where(flat, 1.0, by - ay))
        meets = np.where(flat, at == ay, (t >= 0) & (t <= 1))
        x = ax + t * (bx - ax)
        for end in (x, np.where(flat, bx, x)):
            left = np.where(meets, np.minimum(left, end), left)
            right = np.where(meets, np.maximum(right, end), right)
    met = left <= right  # not for what the rounding of t leaves out
    begin = np.clip(np.ceil(np.where(met, left, 0) - 0.5 - margin), 0, out.shape[1]).astype(
        np.int64
    )
    end_ = np.clip(np.floor(np.where(met, right, -1) - 0.5 + margin) + 1, 0, out.shape[1]).astype(
        np.int64
    )
    span, x = _counted(np.maximum(end_ - begin, 0))
    out[y[span], x + begin[span]] = face[span] + number


def _counted(counts: NDArray) -> tuple[NDArray, NDArray]:
    """(index of each of ``counts`` things, its number among those of the same index)."""
    index = np.repeat(np.arange(len(counts)), counts)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)


def _turns(positions: NDArray, own: NDArray, leading: NDArray) -> NDArray[np.float64]:
    """(F, 2, 2): what takes tangent-space x and y of one set of coordinates to those of another."""
    normal = np.cross(positions[:, 1] - positions[:, 0], positions[:, 2] - positions[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    (t, b), (u, v) = (_tangents(positions, uv, normal) for uv in (own, leading))
    return np.stack(
        [np.stack([_dot(u, t), _dot(u, b)], 1), np.stack([_dot(v, t), _dot(v, b)], 1)], axis=1
    )


def _tangents(positions: NDArray, uvs: NDArray, normal: NDArray) -> tuple[NDArray, NDArray]:
    """Unit tangents and bitangents (F, 3); these point against v, which grows downward, as green
    points up."""
    edges = np.stack([positions[:, 1] - positions[:, 0], positions[:, 2] - positions[:, 0]], axis=2)
    doubled = _doubled_areas(uvs)[:, None]
    (a, b), (c, d) = ((uvs[:, k] - uvs[:, 0]).T for k in (1, 2))
    sign = np.where(doubled < 0, -1.0, 1.0)
    along = (edges[..., 0] * d[:, None] - edges[..., 1] * b[:, None]) * sign
    down = (edges[..., 1] * a[:, None] - edges[..., 0] * c[:, None]) * sign
    tangent = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-30)
    bitangent = np.cross(normal, tangent)
    return tangent, bitangent * np.where(_dot(bitangent, down) > 0, -1.0, 1.0)[:, None]


def _dot(a: NDArray, b: NDArray) -> NDArray:
    return np.einsum("fi,fi->f", a, b)


def _redraw(texture: Texture, face: NDArray, to: NDArray, turns: NDArray | None) -> Texture:
    """The texture in the layout of ``face``; ``to``: the map (F, 2, 3) of each face from texels to
    where it reads."""
    rows, columns = face.shape
    out = np.empty((rows, columns, texture.pixels.shape[2]), texture.pixels.dtype)
    whole = float(np.iinfo(out.dtype).max) if out.dtype.kind == "u" else 1.0
    step = max(1, BAND // columns)
    for start in range(0, rows, step):
        number = face[start : start + step]
        y, x = np.indices(number.shape) + 0.5
        number = number.ravel()
        at = np.stack([x.ravel(), y.ravel() + start, np.ones(len(number))], axis=1)
        values = bilinear(texture, np.einsum("fij,fj->fi", to[number], at))
        if turns is not None:
            n = values[:, :2] / whole * 2 - 1
            values[:, :2] = (np.einsum("fij,fj->fi", turns[number], n) * 0.5 + 0.5) * whole
        if out.dtype.kind == "u":
            values = np.clip(np.rint(values), 0, whole)
        out[start : start + step] = values.reshape(-1, columns, values.shape[1]).astype(out.dtype)
    return replace(texture, pixels=out, wrap=("clamp", "clamp"))


def _loss(
    old: Mapping[str, Texture],
    new: Mapping[str, Texture],
    corners: Mapping[str, NDArray],
    placed: NDArray,
    positions: NDArray,
    turned: bool,
) -> str:
    """How far the new textures are from the old ones, on average over points of the surface."""
    rng = np.random.default_rng(0)
    area = np.linalg.norm(
        np.cross(positions[:, 1] - positions[:, 0], positions[:, 2] - positions[:, 0]), axis=1
    )
    if not area.sum() > 0:
        return "on faces without area"
    face = rng.choice(len(area), SAMPLES, p=area / area.sum())
    u, v = rng.random((2, SAMPLES))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    weight = np.stack([1 - u - v, u, v], axis=1)
    errors = []
    for name, texture in old.items():
        if name == "normal_texture" and turned:
            continue  # the same normal has other numbers
        before, after = (
            bilinear(t, np.einsum("nk,nki->ni", weight, c[face]))
            for t, c in ((texture, corners[name]), (new[name], placed))
        )
        whole = (
            float(np.iinfo(texture.pixels.dtype).max) if texture.pixels.dtype.kind == "u" else 1.0
        )
        rms = float(np.sqrt(np.mean(((before - after) / whole) ** 2)))
        errors.append((rms, name.replace("_texture", "").replace("_", " ")))
    return ", ".join(
        f"{what} " + (f"within {100 * rms:.2g} % (RMS)" if rms > 1e-5 else "as it was")
        for rms, what in errors
    )
