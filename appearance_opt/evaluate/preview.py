"""What a page's 3D viewer shows of an asset: small, and good enough to turn around.

Vertices are quantized, textures are lossy and at most ``MAX_TEXTURE`` wide; of heavy meshes, what
lies in one cell of a grid becomes one vertex. The result is bytes: a JSON header of what lies
where, and arrays.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from appearance_opt.asset.alpha import coverage, kind_of
from appearance_opt.asset.batch import fill_normals
from appearance_opt.asset.images import to_color
from appearance_opt.evaluate.pictures import encode_for_page, shrink

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset, Material, Mesh, Texture

MAX_TRIANGLES = 60_000
"""Triangles of a preview: more, and the asset is reduced."""

MAX_TEXTURE, MAX_TEXELS = 1024, 4 << 20
"""Texels per side of a preview's textures, and of all of them together."""

QUALITY = {"color": 82, "data": 82}
"""WebP qualities of colours, and of normals, roughness and metalness."""

MAX_BYTES = 3_000_000
"""Of a whole preview: what takes more is left out of a page."""


@dataclass(frozen=True)
class Preview:
    """``header``: meshes and materials, and where in ``data`` their arrays lie; ``images``: WebP
    files; ``reduced``: triangles of the preview, where it has fewer than the asset."""

    header: str
    data: bytes
    images: tuple[bytes, ...]
    reduced: int | None = None

    @property
    def size(self) -> int:
        """Bytes before compression."""
        return len(self.header) + len(self.data) + sum(map(len, self.images))


def preview_of(asset: Asset) -> Preview:
    """The preview of an asset of radius 1 around the origin (``Placement.local``)."""
    meshes, total = fill_normals(asset.meshes), asset.triangle_count
    if total > MAX_TRIANGLES:
        meshes = _reduce(meshes, MAX_TRIANGLES)
    writer = _Writer(_texture_size(meshes))
    shown = [writer.add(m) for m in meshes if len(m.faces)]
    header = json.dumps({"meshes": shown, "materials": writer.materials})
    count = sum(len(m.faces) for m in meshes)
    images = tuple(writer.images)
    return Preview(header, bytes(writer.data), images, count if count < total else None)


class _Writer:
    """Arrays one after the other, materials and textures once each."""

    def __init__(self, size: int) -> None:
        self.data = bytearray()
        self.images: list[bytes] = []
        self.materials: list[dict[str, Any]] = []
        self._size = size
        self._known: dict[tuple, int] = {}
        self._material_of: dict[int, int] = {}

    def add(self, mesh: Mesh) -> dict[str, Any]:
        """One mesh; returns its entry of the header."""
        used, index = np.unique(mesh.faces, return_inverse=True)
        assert mesh.normals is not None
        attributes = {
            "position": self._array(_signed(mesh.positions[used]), 3, True),
            "normal": self._array(_signed(mesh.normals[used]), 3, True),
        }
        if mesh.uvs is not None:
            uvs = mesh.uvs[used].astype(np.float32)
            if uvs.min() >= 0 and uvs.max() <= 1:
                stored = np.round(uvs * 65535).astype(np.uint16)
                attributes["uv"] = self._array(stored, 2, True)
            else:
                attributes["uv"] = self._array(uvs, 2, False)
        if mesh.tangents is not None and mesh.material.normal_texture is not None:
            attributes["tangent"] = self._array(_signed(mesh.tangents[used]), 4, True)
        if mesh.colors is not None:
            colors = np.round(np.clip(mesh.colors[used, :3], 0, 1) * 65535).astype(np.uint16)
            attributes["color"] = self._array(colors, 3, True)
        kind = np.uint16 if len(used) <= 65535 else np.uint32
        return {
            "attributes": attributes,
            "index": self._array(index.ravel().astype(kind), 1, False),
            "material": self._material(mesh.material),
        }

    def _array(self, values: NDArray, width: int, normalized: bool) -> list:
        """[type, offset, count, components, normalized]"""
        while len(self.data) % 4:
            self.data.append(0)
        offset = len(self.data)
        self.data += np.ascontiguousarray(values).tobytes()
        return [values.dtype.name, offset, int(values.size), width, normalized]

    def _material(self, m: Material) -> int:
        if id(m) not in self._material_of:
            self._material_of[id(m)] = len(self.materials)
            kind = kind_of(m)
            self.materials.append(
                {
                    "color": [float(c) for c in m.base_color],
                    "roughness": float(m.roughness),
                    "metalness": float(m.metalness),
                    "emission": [float(c) for c in m.emission],
                    "normalScale": float(m.normal_scale),
                    "map": self._texture(m.base_color_texture, "color", kind != "opaque"),
                    "orm": self._texture(m.orm_texture, "data"),
                    "normal": self._texture(m.normal_texture, "data"),
                    "emissive": self._texture(m.emission_texture, "color"),
                    "occlusion": m.has_occlusion,
                    "opacity": 1.0 if kind == "opaque" else float(coverage(m)[0]),
                    "mask": float(m.alpha_cutoff) if kind == "mask" else 0.0,
                    "blend": kind in ("blend", "transmission"),
                    "doubleSided": m.double_sided,
                    "unlit": m.unlit,
                }
            )
        return self._material_of[id(m)]

    def _texture(self, t: Texture | None, kind: str, alpha: bool = False) -> dict | None:
        if t is None:
            return None
        key = id(t.pixels), kind, alpha
        if key not in self._known:
            self._known[key] = len(self.images)
            self.images.append(encode_for_page(_eight_bits(t, self._size, alpha), QUALITY[kind]))
        return {"image": self._known[key], "srgb": t.color_space == "srgb", "wrap": list(t.wrap)}


def _signed(values: NDArray) -> NDArray[np.int16]:
    """Of [-1, 1]."""
    return np.round(np.clip(values, -1, 1) * 32767).astype(np.int16)


def _texture_size(meshes: list[Mesh]) -> int:
    """Width at most of all textures, so that together they are not too large."""
    shapes = {
        id(t.pixels): t.pixels.shape[:2]
        for m in meshes
        for t in (
            m.material.base_color_texture,
            m.material.orm_texture,
            m.material.normal_texture,
            m.material.emission_texture,
        )
        if t is not None
    }.values()
    size = MAX_TEXTURE
    while (
        sum(h * w * min(1.0, size / max(h, w)) ** 2 for h, w in shapes) > MAX_TEXELS and size > 64
    ):
        size //= 2
    return size


def _eight_bits(t: Texture, size: int, alpha: bool) -> NDArray[np.uint8]:
    """Pixels (H, W, 3 or 4) as they are stored, in eight bits, at most ``size`` wide."""
    pixels = to_color(t.pixels)
    if pixels.shape[2] == 4 and not alpha:
        pixels = pixels[..., :3]
    pixels = shrink(pixels, size)
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    top = 65535.0 if pixels.dtype == np.uint16 else 1.0
    return np.round(np.clip(pixels.astype(np.float32) / top, 0, 1) * 255).astype(np.uint8)


def _reduce(meshes: list[Mesh], triangles: int) -> list[Mesh]:
    """The meshes with at most so many triangles in all, by clustering vertices (Rossignac and
    Borrel 1993) in the finest grid of a few that does it."""
    cells = 256
    out = [_cluster(m, cells) for m in meshes]
    while (count := sum(len(m.faces) for m in out)) > triangles and cells > 2:
        # triangles of a surface grow with the square of the grid's resolution
        cells = min(int(cells * 0.97 * (triangles / count) ** 0.5), cells - 1)
        out = [_cluster(m, max(cells, 2)) for m in meshes]
    return out


def _cluster(mesh: Mesh, cells: int) -> Mesh:
    """The mesh with one vertex for each connected patch within a cell of a grid of ``cells`` per
    side of [-1, 1]. Patches meet at seams of texture coordinates and normals: those of one cell
    share their place, so that no crack opens."""
    used, faces = np.unique(mesh.faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    p = mesh.positions[used].astype(np.float64)
    grid = np.clip(((p + 1) * (cells / 2)).astype(np.int64), 0, cells - 1)
    _, cell = np.unique(grid @ np.array([cells * cells, cells, 1]), return_inverse=True)
    cell = cell.ravel()
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    ends = ends[cell[ends[:, 0]] == cell[ends[:, 1]]]
    links = coo_matrix((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), (len(p), len(p)))
    count, patch = connected_components(links, directed=False)
    members = np.bincount(patch, minlength=count)[:, None]

    def mean(values: NDArray, group: NDArray, groups: int) -> NDArray[np.float64]:
        columns = [np.bincount(group, v, minlength=groups) for v in values.astype(np.float64).T]
        return np.stack(columns, axis=1)

    places = int(cell.max()) + 1
    middle = mean(p, cell, places) / np.bincount(cell, minlength=places)[:, None]
    of_patch = np.zeros(count, np.int64)
    of_patch[patch] = cell
    corners = patch[faces]
    at = of_patch[corners]
    flat = (at[:, 0] == at[:, 1]) | (at[:, 1] == at[:, 2]) | (at[:, 2] == at[:, 0])
    kept = corners[~flat]
    _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
    given: dict[str, NDArray] = {}
    for name in ("normals", "uvs", "colors"):
        values = getattr(mesh, name)
        if values is not None:
            given[name] = mean(values[used], patch, count) / members
    normals = given["normals"]
    given["normals"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    single = {name: values.astype(np.float32) for name, values in given.items()}
    return replace(
        mesh,
        positions=middle[of_patch].astype(np.float32),
        faces=kept[np.sort(first)].astype(np.int32),
        tangents=None,
        normals=single["normals"],
        uvs=single.get("uvs"),
        colors=single.get("colors"),
    )
