"""Wavefront OBJ and MTL."""

from __future__ import annotations

import shlex
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset import images
from appearance_opt.asset.packing import pack_orm
from appearance_opt.asset.paths import read_bytes, replacing
from appearance_opt.asset.polygons import Polygons, triangulate
from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.errors import InputError, MissingFileError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.companions import Companions

_MAP_OPTIONS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3, "-texres": 1,
    "-clamp": 1, "-bm": 1, "-imfchan": 1, "-type": 1, "-cc": 1,
    "-colorspace": 1,
}  # fmt: skip
"""Options of map statements and how many values follow them."""

MAX_INDEX = 2**31 - 1
"""Largest index of a face's corner (they are kept in 32 bits)."""


def load_obj(path: Path, companions: Companions) -> Asset:
    """Read an OBJ file and its materials. Raises InputError."""
    path = Path(path)
    text = read_bytes(path).decode("utf-8", errors="replace").replace("\\\n", " ")
    parser = _Parser(path, companions)
    for number, line in enumerate(text.splitlines(), 1):
        try:
            parser.line(line)
        except (ValueError, IndexError):
            raise InputError(f"{path}, line {number}: cannot be read: '{line.strip()[:60]}'") from None
    return parser.asset()


class _Parser:
    def __init__(self, path: Path, companions: Companions) -> None:
        self.path = path
        self.positions: list[list[float]] = []
        self.uvs: list[list[float]] = []
        self.normals: list[list[float]] = []
        # by material, and by what the corners have: texture coordinates, normals
        self.polygons: dict[tuple[str, bool, bool], list[list[tuple[int, int, int]]]] = {}
        self.current = ""
        self.materials: dict[str, Material] = {}
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
                raise ValueError
            has_uv, has_normal = (all(c[k] >= 0 for c in corners) for k in (1, 2))
            self.polygons.setdefault((self.current, has_uv, has_normal), []).append(corners)
        elif key == "usemtl":
            self.current = line[line.index(key) + len(key) :].strip()
        elif key == "mtllib":
            name = line.split(None, 1)[1].strip()
            for path in self._libraries(name):
                self.materials.update(load_mtl(path, self.companions))

    def _libraries(self, names: str) -> list[Path]:
        """Files of one name, which may have spaces, or of several with spaces between them."""
        several = names.split()
        if len(several) > 1:
            try:
                return [self.companions.find(names, self.path)]
            except MissingFileError:
                pass
        out = []
        for name in several:
            find = partial(self.companions.find, name, self.path)
            path = self.companions.read(find, "default materials stand for its own")
            out += [] if path is None else [path]
        return out

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

    def asset(self) -> Asset:
        there = bool(self.uvs), bool(self.normals)
        for k, what in enumerate(("texture coordinates", "normals")):
            if not there[k] and any(key[1 + k] for key in self.polygons):
                self.companions.note(f"faces refer to {what}, of which there are none: ignored")
        for name in dict.fromkeys(key[0] for key in self.polygons):
            if name and name not in self.materials:
                self.companions.note(f"material '{name}' is not defined: default material used")
        meshes = [
            self._mesh(name, has_uv and there[0], has_normal and there[1], polygons)
            for (name, has_uv, has_normal), polygons in self.polygons.items()
        ]
        return Asset(tuple(meshes), self.path.stem, tuple(self.companions.notes))

    def _mesh(self, name: str, has_uv: bool, has_normal: bool, polygons: list[list[tuple[int, int, int]]]) -> Mesh:
        indices = np.array([c for p in polygons for c in p], np.int64)
        indices[:, [k for k, has in ((1, has_uv), (2, has_normal)) if not has]] = -1
        used, index = np.unique(indices, axis=0, return_inverse=True)
        for k, (what, rows) in enumerate((("position", self.positions), ("uv", self.uvs), ("normal", self.normals))):
            if used[:, k].max() >= len(rows) and used[:, k].max() >= 0:
                raise InputError(
                    f"{self.path}: a face refers to {what} {used[:, k].max() + 1}, but there are {len(rows)}"
                )
        vertices = [self.positions[i] for i in used[:, 0]]
        if any(len(v) < 3 for v in vertices):
            raise InputError(f"{self.path}: a vertex has fewer than three coordinates")
        positions = np.array([v[:3] for v in vertices], np.float32)
        index = index.ravel()
        corners, _ = triangulate(Polygons(np.array([len(p) for p in polygons]), index), positions)
        has_color = all(len(v) == 6 for v in vertices)
        uvs = np.array([self.uvs[i] for i in used[:, 1]], np.float32) if has_uv else None
        if uvs is not None:
            uvs[:, 1] = 1 - uvs[:, 1]
        normals = [self.normals[i] for i in used[:, 2]] if has_normal else []
        if any(len(v) < 3 for v in normals):
            raise InputError(f"{self.path}: a normal has fewer than three coordinates")
        return Mesh(
            positions=positions,
            faces=index[corners].astype(np.int32),
            normals=_unit(np.array(normals, np.float64)) if has_normal else None,
            uvs=uvs,
            colors=np.array([v[3:6] for v in vertices], np.float32) if has_color else None,
            material=self.materials.get(name, Material(name=name or "material", roughness=0.8)),
            name=name or self.path.stem,
        )


def load_mtl(path: Path, companions: Companions) -> dict[str, Material]:
    """Materials of an MTL file by name. Phong exponents become roughness sqrt(2 / (Ns + 2))."""
    out: dict[str, Material] = {}
    statements: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    for line in read_bytes(path).decode("utf-8", errors="replace").splitlines():
        words = line.split(None, 1)
        if len(words) < 2 or words[0].startswith("#"):
            continue
        if words[0] == "newmtl":
            current = statements.setdefault(words[1].strip(), {})
        else:
            current[words[0].lower()] = words[1].strip()
    for name, values in statements.items():
        try:
            out[name] = _material(name, values, path, companions)
        except (ValueError, IndexError):
            raise InputError(f"{path}: a value of material '{name}' is missing or not a number") from None
    return out


def _material(name: str, values: dict[str, str], path: Path, companions: Companions) -> Material:
    def numbers(key: str, default: list[float]) -> list[float]:
        return [float(w) for w in values[key].split()[:3]] if key in values else default

    def texture(*keys: str, space: str = "linear") -> Texture | None:
        key = next((k for k in keys if k in values), None)
        return None if key is None else companions.read(lambda: _texture(values[key], path, space, companions))

    color = numbers("kd", [0.8, 0.8, 0.8])
    color = color * 3 if len(color) == 1 else color
    base = texture("map_kd", space="srgb")
    shininess = numbers("ns", [1.125])[0]
    roughness = numbers("pr", [float(np.sqrt(2 / (max(shininess, 0.0) + 2)))])[0]
    rough_map, metal_map = texture("map_pr"), texture("map_pm")
    if values.get("d", "1").split()[-1] not in ("1", "1.0", "1.000000") or "map_d" in values:
        companions.note(f"material '{name}': transparency ignored, drawn opaque")
    orm = None if rough_map is None and metal_map is None else pack_orm(rough_map, metal_map)
    glow_map = texture("map_ke", space="srgb")
    # without the map that says where it glows, nothing does
    glow = [0.0] * 3 if glow_map is None and "map_ke" in values else numbers("ke", [float(glow_map is not None)] * 3)
    return Material(
        name=name,
        base_color=(1.0, 1.0, 1.0) if base is not None else (color[0], color[1], color[2]),
        roughness=1.0 if rough_map is not None else min(max(roughness, 0.0), 1.0),
        metalness=1.0 if metal_map is not None else numbers("pm", [0.0])[0],
        base_color_texture=base,
        orm_texture=orm,
        normal_texture=texture("norm", "map_kn"),
        emission=(glow[0], glow[1], glow[2]),
        emission_texture=glow_map,
    )


def _texture(statement: str, owner: Path, space: str, companions: Companions) -> Texture:
    words = shlex.split(statement, posix=True) if '"' in statement else statement.split()
    wrap = "repeat"
    k = 0
    while k < len(words) and words[k] in _MAP_OPTIONS:
        if words[k] == "-clamp" and words[k + 1] == "on":
            wrap = "clamp"
        k += 1 + _MAP_OPTIONS[words[k]]
    pixels = images.read(companions.find(" ".join(words[k:]), owner))
    if pixels.shape[2] < 3:
        pixels = np.repeat(pixels[..., :1], 3, axis=2)
    return Texture(pixels, space, (wrap, wrap))  # type: ignore[arg-type]


def save_obj(asset: Asset, path: Path) -> None:
    """Write OBJ, MTL (with the PBR extension: Pr, Pm, map_Pr, map_Pm, norm) and PNG textures."""
    path = Path(path)
    named = {id(m.material): f"{i}_{m.material.name}".replace(" ", "_") for i, m in enumerate(asset.meshes)}
    mtl: list[str] = []
    for m in {id(m.material): m.material for m in asset.meshes}.values():
        mtl += _mtl_lines(replace(m, name=named[id(m)]), path)
    with replacing(path.with_suffix(".mtl")) as temporary:
        temporary.write_text("\n".join(mtl) + "\n")
    lines = ["# appearance-opt", f"mtllib {path.stem}.mtl"]
    start = np.ones(3, np.int64)  # of this mesh's positions, texture coordinates and normals in the whole file
    for mesh in asset.meshes:
        lines += [f"o {mesh.name}", f"usemtl {named[id(mesh.material)]}"]
        colors = np.empty((len(mesh.positions), 0)) if mesh.colors is None else mesh.colors
        rows = np.concatenate([mesh.positions, colors], axis=1)
        lines += ["v " + " ".join(f"{x:.9g}" for x in row) for row in rows.tolist()]
        if mesh.uvs is not None:
            lines += [f"vt {u:.9g} {1 - v:.9g}" for u, v in mesh.uvs.tolist()]
        if mesh.normals is not None:
            lines += [f"vn {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.normals.tolist()]
        # vertices are split at seams: one index serves all that a mesh has
        has = (True, mesh.uvs is not None, mesh.normals is not None)
        form = {(True, False): "{0}/{1}", (False, True): "{0}//{2}", (True, True): "{0}/{1}/{2}"}.get(has[1:], "{0}")
        for face in mesh.faces.tolist():
            lines.append("f " + " ".join(form.format(*(start + i)) for i in face))
        start += np.where(has, len(mesh.positions), 0)
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n")


def _mtl_lines(m: Material, path: Path) -> list[str]:
    kd = " ".join(f"{x:.6g}" for x in m.base_color)
    lines = [f"newmtl {m.name}", f"Kd {kd}", f"Pr {m.roughness:.6g}", f"Pm {m.metalness:.6g}"]

    def picture(suffix: str, pixels: NDArray) -> str:
        target = path.with_name(f"{path.stem}_{m.name}_{suffix}.png")
        with replacing(target) as temporary:
            temporary.write_bytes(images.encode_png(np.ascontiguousarray(pixels)))
        return target.name

    if m.base_color_texture is not None:
        lines.append("map_Kd " + picture("base_color", m.base_color_texture.pixels))
    if m.orm_texture is not None:
        lines.append("map_Pr " + picture("roughness", m.orm_texture.pixels[..., 1:2]))
        lines.append("map_Pm " + picture("metalness", m.orm_texture.pixels[..., 2:3]))
    if m.emits:
        lines.append("Ke " + " ".join(f"{x:.6g}" for x in m.emission))
        if m.emission_texture is not None:
            lines.append("map_Ke " + picture("emission", m.emission_texture.pixels))
    if m.normal_texture is not None:
        lines.append("norm " + picture("normal", m.normal_texture.pixels[..., :3]))
    return [*lines, ""]


def _unit(v: NDArray) -> NDArray[np.float32]:
    return (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-30)).astype(np.float32)
