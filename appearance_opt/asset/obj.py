"""Wavefront OBJ to an Asset. Its materials are read by ``mtl``."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.creases import add_normals
from appearance_opt.asset.mtl import MaterialReader
from appearance_opt.asset.origin import settle
from appearance_opt.asset.paths import read_text
from appearance_opt.asset.polygons import Polygons, triangulate
from appearance_opt.asset.rows import unique_rows
from appearance_opt.asset.types import Asset, Material, Mesh, Node, srgb_to_linear
from appearance_opt.errors import InputError, MissingFileError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.companions import Companions

MAX_INDEX = 2**31 - 1
"""Largest index of a face's corner (they are kept in 32 bits)."""


def load_obj(
    path: Path, companions: Companions, keep_layout: bool = False, crease_angle: float | None = None
) -> Asset:
    """Read an OBJ file and its materials. ``keep_layout``, ``crease_angle``: see ``asset.load``.
    Raises InputError."""
    path = Path(path)
    text = re.sub(r"\\\r?\n", " ", read_text(path))
    parser = _Parser(path, companions)
    for number, line in enumerate(text.splitlines(), 1):
        try:
            parser.line(line)
        except (ValueError, IndexError):
            raise InputError(
                f"{path}, line {number}: cannot be read: '{line.strip()[:60]}'"
            ) from None
    return parser.asset(keep_layout, crease_angle)


class _Parser:
    def __init__(self, path: Path, companions: Companions) -> None:
        self.path = path
        self.positions: list[list[float]] = []
        self.uvs: list[list[float]] = []
        self.normals: list[list[float]] = []
        # by material, and by what the corners have: texture coordinates, normals
        self.polygons: dict[tuple[str, bool, bool, str], list[list[tuple[int, int, int]]]] = {}
        # the smoothing groups of the same polygons, numbered by their names; 0 is none
        self.groups: dict[tuple[str, bool, bool, str], list[int]] = {}
        self.group, self.says_groups = 0, False
        self.group_numbers: dict[str, int] = {}
        self.current = ""
        self.object = ""
        self.materials = MaterialReader(companions)
        self.companions = companions

    def line(self, line: str) -> None:
        words = line.split()
        if not words or words[0].startswith("#"):
            return
        key = words[0]
        if key == "v":
            self.positions.append([float(w) for w in words[1:7]])
        elif key == "vt":
            self.uvs.append([float(words[1]), float(words[2]) if len(words) > 2 else 0.0])
        elif key == "vn":
            self.normals.append([float(w) for w in words[1:4]])
        elif key == "f":
            corners = [self._corner(w) for w in words[1:]]
            if len(corners) < 3:
                self.companions.note("faces with fewer than three corners ignored")
                return
            has_uv, has_normal = (all(c[k] >= 0 for c in corners) for k in (1, 2))
            key_of = (self.current, has_uv, has_normal, self.object)
            self.polygons.setdefault(key_of, []).append(corners)
            self.groups.setdefault(key_of, []).append(self.group)
        elif key == "s":
            self._smooth(words[1] if len(words) > 1 else "1")
        elif key == "o":
            self.object = line[line.index(key) + 1 :].strip()
        elif key == "usemtl":
            self.current = line[line.index(key) + len(key) :].strip()
        elif key == "mtllib":
            self._read_libraries(line.split(None, 1)[1].strip())
        elif key in ("l", "p"):
            self.companions.note("points and lines ignored")
        elif key in ("curv", "curv2", "surf"):
            self.companions.note("curves and surfaces of free form ignored")

    def _smooth(self, name: str) -> None:
        """Faces that follow are of this smoothing group, of none by "off" and "0"."""
        self.says_groups = True
        off = name.lower() == "off" or not name.strip("0")
        self.group = 0 if off else self.group_numbers.setdefault(name, len(self.group_numbers) + 1)

    def _read_libraries(self, names: str) -> None:
        """Read files of one name, which may have spaces, or of several with spaces between them."""
        several = names.split()
        if len(several) > 1:
            try:
                return self.materials.read(self.companions.find(names, self.path))
            except MissingFileError:
                pass
        for name in several:
            read = partial(self._read_library, name)
            self.companions.read(read, "default materials stand for its own")

    def _read_library(self, name: str) -> None:
        self.materials.read(self.companions.find(name, self.path))

    def _corner(self, word: str) -> tuple[int, int, int]:
        parts = word.split("/")
        counts = (len(self.positions), len(self.uvs), len(self.normals))
        out = [-1, -1, -1]
        for k, part in enumerate(parts[:3]):
            if part:
                i = int(part)
                out[k] = i - 1 if i > 0 else counts[k] + i
                if i == 0 or out[k] < 0 or i > MAX_INDEX:
                    raise ValueError
        if out[0] < 0:
            raise ValueError
        return (out[0], out[1], out[2])

    def asset(self, keep_layout: bool, crease_angle: float | None) -> Asset:
        there = bool(self.uvs), bool(self.normals)
        for k, what in enumerate(("texture coordinates", "normals")):
            if not there[k] and any(key[1 + k] for key in self.polygons):
                self.companions.note(f"faces refer to {what}, of which there are none: ignored")
        for name in dict.fromkeys(key[0] for key in self.polygons):
            if name and name not in self.materials.by_name:
                self.companions.note(
                    f"material '{name}': not defined, the default material is used"
                )
        objects = {name: k for k, name in enumerate(dict.fromkeys(p[3] for p in self.polygons))}
        read = [
            self._mesh(name, has_uv and there[0], has_normal and there[1], polygons)
            for (name, has_uv, has_normal, _), polygons in self.polygons.items()
        ]
        meshes, origin = settle([mesh for mesh, _ in read], self.companions.note)
        if not keep_layout:
            # once a file says anything of smoothing, faces without a group are flat, as the format
            # says; of one that does not, as scans are, nothing is known
            groups = [
                np.array(g)[face] for g, (_, face) in zip(self.groups.values(), read, strict=True)
            ]
            meshes = add_normals(meshes, groups if self.says_groups else None, crease_angle)
        meshes = self.materials.apply_uv_transforms(meshes, keep_layout)
        if len(objects) > 1:
            numbers = [objects[key[3]] for key in self.polygons]
            meshes = [replace(m, node=n) for m, n in zip(meshes, numbers, strict=True)]
        return Asset(
            tuple(meshes),
            self.path.stem,
            self.companions.notes.lines(),
            origin=origin,
            nodes=tuple(Node(n or self.path.stem) for n in objects) if len(objects) > 1 else (),
        )

    def _mesh(
        self, name: str, has_uv: bool, has_normal: bool, polygons: list[list[tuple[int, int, int]]]
    ) -> tuple[Mesh, NDArray[np.int64]]:
        """A mesh, and the polygon of each of its faces."""
        indices = np.array([c for p in polygons for c in p], np.int64)
        indices[:, [k for k, has in ((1, has_uv), (2, has_normal)) if not has]] = -1
        of_kind, index = unique_rows(indices + 1)
        used = indices[of_kind]
        for k, (what, rows) in enumerate(
            (("position", self.positions), ("uv", self.uvs), ("normal", self.normals))
        ):
            if used[:, k].max() >= len(rows) and used[:, k].max() >= 0:
                raise InputError(
                    f"{self.path}: a face refers to {what} {used[:, k].max() + 1}, but there are {len(rows)}"
                )
        vertices = [self.positions[i] for i in used[:, 0]]
        if any(len(v) < 3 for v in vertices):
            raise InputError(f"{self.path}: a vertex has fewer than three coordinates")
        positions = np.array([v[:3] for v in vertices], np.float64)
        corners, polygon = triangulate(
            Polygons(np.array([len(p) for p in polygons]), index), positions
        )
        has_color = all(len(v) == 6 for v in vertices)
        uvs = np.array([self.uvs[i] for i in used[:, 1]], np.float32) if has_uv else None
        if uvs is not None:
            uvs[:, 1] = 1 - uvs[:, 1]
        normals = [self.normals[i] for i in used[:, 2]] if has_normal else []
        if any(len(v) < 3 for v in normals):
            raise InputError(f"{self.path}: a normal has fewer than three coordinates")
        mesh = Mesh(
            positions=positions,  # type: ignore[arg-type]  # in double precision until they are settled
            faces=index[corners].astype(np.int32),
            normals=_unit(np.array(normals, np.float64)) if has_normal else None,
            uvs=uvs,
            # sRGB encoded, as Blender and MeshLab write and read them: the format itself does not
            # say
            colors=srgb_to_linear(np.array([v[3:6] for v in vertices], np.float32))
            if has_color
            else None,
            material=self.materials.by_name.get(
                name, Material(name=name or "material", roughness=0.8)
            ),
            name=name or self.path.stem,
        )
        return mesh, polygon


def _unit(v: NDArray) -> NDArray[np.float32]:
    return (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-30)).astype(np.float32)
