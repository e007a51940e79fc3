"""PLY to an Asset, through the package plyfile: polygons, vertex or face colours, textures.

The format fixes no names beyond x, y, z and vertex_indices; those of colours, texture coordinates
and pictures are what MeshLab, Blender, CloudCompare, VCGLib and photogrammetry tools write.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset import images
from appearance_opt.asset.creases import add_normals
from appearance_opt.asset.normals import unit
from appearance_opt.asset.origin import settle
from appearance_opt.asset.paths import read_bytes
from appearance_opt.asset.polygons import Polygons, triangulate
from appearance_opt.asset.rows import rank_rows, unique_rows
from appearance_opt.asset.types import Asset, Material, Mesh, Texture, srgb_to_linear
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.companions import Companions

_FACES = ("vertex_indices", "vertex_index")
_COLORS = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
_UVS = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"), ("texture_s", "texture_t"))
_PICTURE = re.compile(r"TextureFile\s+(.+)", re.IGNORECASE)
_HEADER = 1 << 16
"""Bytes in which the header of a file is looked for the lists of its faces."""


def load_ply(
    path: Path, companions: Companions, keep_layout: bool = False, crease_angle: float | None = None
) -> Asset:
    """Read a .ply file. Without normals, edges sharp by ``creases.smooth_by_angle`` are hard.
    ``keep_layout``, ``crease_angle``: see ``asset.load``. Raises InputError."""
    return _Reader(Path(path), companions).asset(keep_layout, crease_angle)


class _Reader:
    def __init__(self, path: Path, companions: Companions) -> None:
        self.path, self.companions, self.note = path, companions, companions.note
        self.data = _parse(path)
        names = [e.name for e in self.data.elements]
        if "tristrips" in names:
            raise InputError(f"{path}: triangle strips are not supported; save it with faces")
        if "vertex" not in names or "face" not in names or not len(self.data["face"].data):
            raise InputError(f"{path}: there are no triangles in it")
        self.vertex, self.face = self.data["vertex"].data, self.data["face"].data

    def asset(self, keep_layout: bool, crease_angle: float | None) -> Asset:
        self.note("no material in this format: a default one is used")
        corners, face_of = self._triangles()
        attributes, index = self._vertices(corners, face_of)
        textures = self._textures("uvs" in attributes)
        number = self._texture_numbers(len(textures))[face_of]
        meshes = []
        for k in np.unique(number).tolist():
            texture = textures[k] if textures else None
            name = self.path.stem if k == 0 else f"{self.path.stem}.{k}"
            material = Material(name, roughness=0.8, base_color_texture=texture)
            used, faces = np.unique(index[number == k], return_inverse=True)
            own = {n: v[used] for n, v in attributes.items() if n != "colors" or texture is None}
            meshes.append(
                Mesh(
                    faces=faces.reshape(-1, 3).astype(np.int32), material=material, name=name, **own
                )
            )
        if "colors" in attributes and any(t is not None for t in textures):
            self.note("its colours are not drawn where it has a texture")
        settled, origin = settle(meshes, self.note)
        if not keep_layout:
            settled = add_normals(settled, crease_angle=crease_angle)
        return Asset(tuple(settled), self.path.stem, self.companions.notes.lines(), origin=origin)

    def _triangles(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """((T, 3) corners, counted over all faces of the file, (T,) the face of each triangle).
        Sets ``polygons``."""
        lists = [p.name for p in self.data["face"].properties if hasattr(p, "len_dtype")]
        name = next((n for n in (*_FACES, *lists) if n in lists), None)
        if name is None:
            raise InputError(f"{self.path}: its faces have no list of vertices")
        counts, indices = _flat(self.face[name])
        self.polygons = Polygons(counts, indices.astype(np.int64))
        points = self._positions()
        if indices.min(initial=0) < 0 or indices.max(initial=0) >= len(points):
            raise InputError(f"{self.path}: faces refer to vertices that do not exist")
        return triangulate(self.polygons, points)

    def _positions(self) -> NDArray[np.float64]:
        return self._columns(self.vertex, ("x", "y", "z"))

    def _columns(self, element: Any, names: tuple[str, ...]) -> NDArray[np.float64]:
        missing = [n for n in names if n not in (element.dtype.names or ())]
        if missing:
            raise InputError(f"{self.path}: its vertices have no '{missing[0]}'")
        return np.stack([np.asarray(element[n], np.float64) for n in names], axis=1)

    def _vertices(self, corners: NDArray, face_of: NDArray) -> tuple[dict[str, NDArray], NDArray]:
        """(positions, normals, uvs, colors of vertices, as far as there are any, (T, 3) which of
        them are the triangles' corners). Vertices are split where faces differ in colour or texture
        coordinates."""
        index = self.polygons.indices[corners]
        values: dict[str, NDArray] = {"positions": self._positions()}
        normals = self._given(self.vertex, (("nx", "ny", "nz"),))
        if normals is not None and normals.any():
            values["normals"] = unit(normals).astype(np.float32)
        uvs, colors = self._given(self.vertex, _UVS), _decode(self.vertex)
        wedge, painted = self._wedge_uvs(), _decode(self.face) if colors is None else None
        if uvs is not None and wedge is None:
            values["uvs"] = uvs.astype(np.float32)
        if colors is not None:
            values["colors"] = colors
        keys = []
        if wedge is not None:
            wedge, place = _distinct(wedge)
            keys.append(place[corners])
        if painted is not None:
            painted, place = _distinct(painted)
            keys.append(np.repeat(place[face_of][:, None], 3, axis=1))
        if keys:
            rows = np.stack([index, *keys], axis=-1).reshape(-1, 1 + len(keys))
            first, number = unique_rows(rows)
            values = {n: v[rows[first, 0]] for n, v in values.items()}
            if wedge is not None:
                values["uvs"] = wedge[rows[first, 1]].astype(np.float32)
            if painted is not None:
                values["colors"] = painted[rows[first, -1]]
            index = number.reshape(-1, 3)
        if "uvs" in values:
            values["uvs"] = values["uvs"] * np.array((1, -1), np.float32) + np.array(
                (0, 1), np.float32
            )
        return values, index

    def _given(
        self, element: Any, choices: tuple[tuple[str, ...], ...]
    ) -> NDArray[np.float64] | None:
        there = element.dtype.names or ()
        names = next((c for c in choices if all(n in there for n in c)), None)
        return None if names is None else self._columns(element, names)

    def _wedge_uvs(self) -> NDArray[np.float64] | None:
        """(corners of all faces, 2) texture coordinates of the faces' own, two numbers for each
        corner."""
        if "texcoord" not in (self.face.dtype.names or ()):
            return None
        counts, values = _flat(self.face["texcoord"])
        if not (counts == 2 * self.polygons.counts).all():
            self.note("its texture coordinates do not fit its faces: ignored")
            return None
        return values.reshape(-1, 2).astype(np.float64)

    def _textures(self, has_uvs: bool) -> list[Texture | None]:
        comments = (*self.data.comments, *(c for e in self.data.elements for c in e.comments))
        names = [m[1].strip() for c in comments if (m := _PICTURE.match(c.strip()))]
        if names and not has_uvs:
            self.note("its texture is ignored: there are no texture coordinates")
            return []
        return [self._texture(name) for name in names]

    def _texture(self, name: str) -> Texture | None:
        pixels = self.companions.read(
            lambda: self.companions.picture(self.companions.find(name, self.path))
        )
        if pixels is None:
            return None
        pixels = np.ascontiguousarray(images.to_color(pixels)[..., :3])
        return Texture(pixels, "linear" if pixels.dtype.kind == "f" else "srgb")

    def _texture_numbers(self, count: int) -> NDArray[np.int64]:
        """(faces,) the texture of each face."""
        if count < 2 or "texnumber" not in (self.face.dtype.names or ()):
            return np.zeros(len(self.face), np.int64)
        return np.clip(np.asarray(self.face["texnumber"], np.int64), 0, count - 1)


def _distinct(values: NDArray) -> tuple[NDArray, NDArray]:
    """(different rows, which of them each row is)."""
    first, number = unique_rows(rank_rows(values))
    return values[first], number


def _decode(element: Any) -> NDArray[np.float32] | None:
    """(N, 3) linear colours of vertices or faces, which files hold sRGB encoded; None without
    any."""
    there = element.dtype.names or ()
    names = next((c for c in _COLORS if all(n in there for n in c)), None)
    if names is None:
        return None
    columns = []
    for name in names:
        values = np.asarray(element[name])
        whole = float(np.iinfo(values.dtype).max) if values.dtype.kind in "iu" else 1.0
        columns.append(values.astype(np.float32) / np.float32(whole))
    colors = np.stack(columns, axis=1)
    if np.asarray(element[names[0]]).dtype.kind == "f" and colors.max(initial=0) > 1:
        colors = colors / np.float32(255)
    return srgb_to_linear(np.clip(np.nan_to_num(colors), 0, 1))


def _flat(lists: NDArray) -> tuple[NDArray[np.int64], NDArray]:
    """(length of each list, their elements one after the other)."""
    if lists.dtype != object:
        return np.full(len(lists), lists.shape[1]), np.ascontiguousarray(lists).ravel()
    counts = np.array([len(v) for v in lists], np.int64)
    return counts, np.concatenate(list(lists)) if len(lists) else np.empty(0, np.int64)


def _parse(path: Path) -> Any:
    import plyfile

    head = read_bytes(path)[:_HEADER].partition(b"end_header")[0].decode("latin-1")
    faces = re.search(r"element\s+face\b(.*?)(element|$)", head, re.DOTALL)
    lists = re.findall(r"property\s+list\s+\S+\s+\S+\s+(\S+)", faces[1]) if faces else []
    try:
        # lists of known length are read at once; a file of triangles is tried first, then one of
        # quadrilaterals
        for corners in (3, 4) if lists and "ascii" not in head.split("element")[0] else ():
            known = {n: corners * (1 if n in _FACES else 2) for n in lists}
            try:
                return plyfile.PlyData.read(str(path), known_list_len={"face": known})
            except plyfile.PlyElementParseError:
                continue
        return plyfile.PlyData.read(str(path))
    except plyfile.PlyParseError as error:
        reason = " ".join(str(error).split())[:160]
        raise InputError(
            f"{path}: not a readable PLY file ({reason}); it is damaged or cut short"
        ) from None
