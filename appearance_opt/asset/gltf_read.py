"""glTF 2.0 and GLB to an Asset."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.gltf_accessors import Document
from appearance_opt.asset.gltf_draco import DRACO, Compressed
from appearance_opt.asset.gltf_materials import READ_EXTENSIONS, MaterialReader
from appearance_opt.asset.gltf_meshopt import MESHOPT
from appearance_opt.asset.types import Asset, Mesh
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.companions import Companions

_COMPRESSED = {"KHR_texture_basisu": "Basis Universal"}
_HARMLESS = {DRACO, *MESHOPT, "KHR_mesh_quantization", *READ_EXTENSIONS}


def load_gltf(path: Path, companions: Companions) -> Asset:
    """Read a .gltf or .glb file. Raises InputError."""
    document = Document(path, companions)
    try:
        return _Reader(document).asset()
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"{path}: the glTF structure is broken ({type(error).__name__}: {error})") from error


class _Reader:
    def __init__(self, document: Document) -> None:
        self.document = document
        self.path = document.path
        self.note = document.companions.note
        self.materials = MaterialReader(document)

    def asset(self) -> Asset:
        self._check_extensions()
        json = self.document.json
        roots = range(len(self.document.items("nodes")))
        if self.document.items("scenes"):
            roots = self.document.items("scenes")[json.get("scene", 0)].get("nodes", [])
        meshes: list[Mesh] = []
        for root in roots:
            self._visit(root, np.eye(4), meshes, set())
        for kind, what in (("skins", "skins (bind pose kept)"), ("animations", "animations")):
            if self.document.items(kind):
                self.note(f"{what} ignored")
        return Asset(tuple(self.materials.in_one_frame(meshes)), self.path.stem, tuple(self.document.companions.notes))

    def _check_extensions(self) -> None:
        for name in self.document.json.get("extensionsRequired", []):
            if name in _COMPRESSED:
                raise InputError(
                    f"{self.path}: {_COMPRESSED[name]} compression is not supported; save it uncompressed first"
                )
        for name in self.document.json.get("extensionsUsed", []):
            if name not in _HARMLESS:
                self.note(f"extension {name} ignored")

    def _visit(self, index: int, parent: NDArray, meshes: list[Mesh], seen: set[int]) -> None:
        if index in seen:
            raise InputError(f"{self.path}: node {index} is its own ancestor")
        node = self.document.items("nodes")[index]
        world = parent @ _local_transform(node)
        if "mesh" in node:
            mesh = self.document.items("meshes")[node["mesh"]]
            name = node.get("name") or mesh.get("name") or f"mesh{node['mesh']}"
            for k, primitive in enumerate(mesh["primitives"]):
                part = self._primitive(primitive, world, name if k == 0 else f"{name}.{k}")
                if part is not None:
                    meshes.append(part)
        for child in node.get("children", []):
            self._visit(child, world, meshes, seen | {index})

    def _primitive(self, primitive: dict[str, Any], world: NDArray, name: str) -> Mesh | None:
        mode = primitive.get("mode", 4)
        if mode not in (4, 5, 6):
            self.note("points and lines ignored")
            return None
        if primitive.get("targets"):
            self.note("morph targets ignored")
        attributes = primitive["attributes"]
        compressed = Compressed.of(self.document, primitive)

        def read(name: str) -> NDArray:
            if compressed is not None and name in compressed:
                return compressed.attribute(name)
            return self.document.accessor(attributes[name])

        positions = read("POSITION")[:, :3].astype(np.float64)
        if compressed is not None:
            faces = compressed.faces
        else:
            accessor = primitive.get("indices")
            indices = np.arange(len(positions)) if accessor is None else self.document.accessor(accessor)[:, 0]
            faces = _triangles(indices.astype(np.int64), mode)
        linear = world[:3, :3]
        if np.linalg.det(linear) < 0:
            faces = faces[:, ::-1]
        normals = tangents = colors = None
        if "NORMAL" in attributes:
            normals = _normalized(read("NORMAL").astype(np.float64) @ _cofactor(linear).T)
        if "TANGENT" in attributes and normals is not None:
            t = read("TANGENT").astype(np.float64)
            tangents = np.concatenate([_normalized(t[:, :3] @ linear.T), np.where(t[:, 3:4] < 0, -1, 1)], axis=1)
        if "COLOR_0" in attributes:
            colors = read("COLOR_0")[:, :3].astype(np.float32)
        material, channel = self.materials.read(primitive.get("material"))
        uvs = read(f"TEXCOORD_{channel}") if f"TEXCOORD_{channel}" in attributes else None
        return Mesh(
            positions=(positions @ linear.T + world[:3, 3]).astype(np.float32),
            faces=np.ascontiguousarray(faces, np.int32),
            normals=_float(normals),
            uvs=_float(uvs),
            tangents=_float(tangents),
            colors=colors,
            material=material,
            name=name,
        )


def _local_transform(node: dict[str, Any]) -> NDArray:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = (float(q) for q in node.get("rotation", (0, 0, 0, 1)))
    out = np.eye(4)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    out[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64)
    out[:3, 3] = node.get("translation", (0, 0, 0))
    return out


def _triangles(indices: NDArray, mode: int) -> NDArray:
    """(F, 3) faces of a triangle list (4), strip (5) or fan (6)."""
    if mode == 4:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    n = max(len(indices) - 2, 0)
    if mode == 6:
        return np.stack([np.repeat(indices[:1], n), indices[1 : n + 1], indices[2 : n + 2]], axis=1)
    strip = np.stack([indices[:n], indices[1 : n + 1], indices[2 : n + 2]], axis=1)
    strip[1::2] = strip[1::2, [1, 0, 2]]
    return strip


def _cofactor(m: NDArray) -> NDArray:
    """Transforms normals, singular matrices included (inverse transpose times determinant, sign kept)."""
    c = np.stack([np.cross(m[1], m[2]), np.cross(m[2], m[0]), np.cross(m[0], m[1])])
    return c if np.linalg.det(m) >= 0 else -c


def _normalized(v: NDArray) -> NDArray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-30)


def _float(v: NDArray | None) -> NDArray[np.float32] | None:
    return None if v is None else v.astype(np.float32)
