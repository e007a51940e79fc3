"""glTF 2.0 and GLB to an Asset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.gltf_accessors import Document
from appearance_opt.asset.gltf_draco import DRACO, Compressed
from appearance_opt.asset.gltf_materials import READ_EXTENSIONS, MaterialReader
from appearance_opt.asset.gltf_meshopt import MESHOPT
from appearance_opt.asset.gltf_nodes import INSTANCING, Nodes, Placement, local_transform
from appearance_opt.asset.normals import unit
from appearance_opt.asset.types import Asset, Mesh
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.companions import Companions

_COMPRESSED = {"KHR_texture_basisu": "Basis Universal"}
_READ = {DRACO, *MESHOPT, INSTANCING, "KHR_mesh_quantization", *READ_EXTENSIONS}
_VISUAL = ("KHR_materials_", "KHR_lights_", "EXT_lights_", "KHR_animation_pointer", "KHR_xmp_json_ld")
"""Extensions, by the start of their names, without which shapes and textures are the same: lobes of materials, and
lights. They are ignored with a note even where a file calls them required."""


def load_gltf(path: Path, companions: Companions, keep_layout: bool = False, variant: str | None = None) -> Asset:
    """Read a .gltf or .glb file. ``keep_layout``: see ``asset.load``; ``variant``: name of a KHR_materials_variants
    variant. Raises InputError."""
    return _Reader(Document(path, companions), keep_layout, variant).asset()


class _Reader:
    def __init__(self, document: Document, keep_layout: bool, variant: str | None) -> None:
        self.document, self.keep_layout = document, keep_layout
        self.path = document.path
        self.note = document.companions.note
        self.materials = MaterialReader(document, variant)
        self.nodes = Nodes(document)

    def asset(self) -> Asset:
        self._check_extensions()
        meshes: list[Mesh] = []
        for root in self._roots():
            self._visit(root, np.eye(4), meshes, set())
        for kind, what in (
            ("skins", "skins: the rest pose is kept, skinning dropped"),
            ("animations", "animations dropped"),
        ):
            if self.document.items(kind):
                self.note(what)
        meshes = self.materials.in_one_frame(meshes, self.keep_layout)
        return Asset(tuple(meshes), self.path.stem, tuple(self.document.companions.notes))

    def _roots(self) -> list[int]:
        """The nodes at the top of what is drawn: those of the scene that the file names, else of the
        first one; in a library without scenes, the nodes that are no one's children."""
        scenes = self.document.items("scenes")
        if not scenes:
            return self.nodes.roots()
        chosen = self.document.json.get("scene", 0)
        names = [scene.get("name", f"scene{k}") for k, scene in enumerate(scenes)]
        if len(scenes) > 1:
            others = ", ".join(f"'{n}'" for k, n in enumerate(names) if k != chosen)
            self.note(f"scene '{names[chosen]}' is taken, others ignored: {others}")
        return scenes[chosen].get("nodes", [])

    def _check_extensions(self) -> None:
        for name in self.document.json.get("extensionsRequired", []):
            if name in _COMPRESSED:
                raise InputError(
                    f"{self.path}: {_COMPRESSED[name]} compression is not supported; save it uncompressed first"
                )
            if name not in _READ and not str(name).startswith(_VISUAL):
                raise InputError(
                    f"{self.path}: requires the extension '{name}', which is not supported; save it without"
                )
        for name in self.document.json.get("extensionsUsed", []):
            if name not in _READ:
                self.note(f"extension {name} ignored")

    def _visit(self, index: int, parent: NDArray, meshes: list[Mesh], seen: set[int]) -> None:
        if index in seen:
            raise InputError(f"{self.path}: node {index} is its own ancestor")
        node = self.document.items("nodes")[index]
        world = parent @ local_transform(node)
        if "mesh" in node:
            mesh = self.document.items("meshes")[node["mesh"]]
            name = node.get("name") or mesh.get("name") or f"mesh{node['mesh']}"
            for k, primitive in enumerate(mesh["primitives"]):
                weights = node.get("weights", mesh.get("weights", ()))
                meshes += self._primitive(primitive, node, world, name if k == 0 else f"{name}.{k}", weights)
        for child in node.get("children", []):
            self._visit(child, world, meshes, seen | {index})

    def _primitive(
        self, primitive: dict[str, Any], node: dict[str, Any], world: NDArray, name: str, weights: Sequence[float]
    ) -> list[Mesh]:
        """The meshes of a primitive, one for each place at which its node puts it. ``weights``: of
        its morph targets."""
        mode = primitive.get("mode", 4)
        if mode not in (4, 5, 6):
            self.note("points and lines ignored")
            return []
        attributes = primitive["attributes"]
        compressed = Compressed.of(self.document, primitive)
        # (weight, accessors) of the morph targets that count
        targets = [(w, t) for w, t in zip(weights, primitive.get("targets", ()), strict=False) if w]
        if primitive.get("targets"):
            self.note("morph targets: the shape of their default weights is kept, others are dropped")

        def read(name: str) -> NDArray:
            if compressed is not None and name in compressed:
                given = compressed.attribute(name)
            else:
                given = self.document.accessor(attributes[name])
            return self._morphed(given, [(w, t[name]) for w, t in targets if name in t])

        positions = read("POSITION")[:, :3].astype(np.float64)
        if compressed is not None:
            faces = compressed.faces
        else:
            accessor = primitive.get("indices")
            indices = np.arange(len(positions)) if accessor is None else self.document.accessor(accessor)[:, 0]
            faces = _triangles(indices.astype(np.int64), mode)
        normals = tangents = colors = None
        if "NORMAL" in attributes:
            normals = read("NORMAL").astype(np.float64)
            tangents = read("TANGENT").astype(np.float64) if "TANGENT" in attributes else None
        material, channel = self.materials.read(self.materials.of(primitive))
        if "COLOR_0" in attributes:
            colors = read("COLOR_0").astype(np.float32)
            if material.alpha_mode == "opaque":  # their alpha means nothing
                colors = colors[:, :3]
        uvs = _float(read(f"TEXCOORD_{channel}")) if f"TEXCOORD_{channel}" in attributes else None
        if "skin" in node and "JOINTS_0" in attributes:
            places = [self.nodes.skinned(node["skin"], attributes, read)]
        else:
            places = self.nodes.placements(node, world)
        local = Mesh(positions, faces, normals, uvs, tangents, colors, material, name)  # type: ignore[arg-type]
        meshes = [_placed(local, place) for place in places]
        if normals is None and not self.keep_layout:
            self.note("meshes without normals are shaded flat, as glTF 2.0 asks")
            meshes = [_flat(m) for m in meshes]
        return meshes

    def _morphed(self, values: NDArray, displacements: list[tuple[float, int]]) -> NDArray:
        """(V, width) values of an attribute plus the sum of weight * displacement, accessors of which
        are given (glTF 2.0, 3.7.2.2); those of tangents have no handedness."""
        if not displacements:
            return values
        out = values.astype(np.float64)
        for weight, accessor in displacements:
            moved = self.document.accessor(accessor)
            if len(moved) != len(out):
                raise InputError(
                    f"{self.path}: a morph target moves {len(moved)} vertices of {len(out)}; export it again"
                )
            out[:, : moved.shape[1]] += float(weight) * moved
        return out


def _placed(mesh: Mesh, place: Placement) -> Mesh:
    """A mesh, still in double precision, at its place in the world."""
    faces, mirrors = mesh.faces, place.mirrors(len(mesh.positions))
    if mirrors.any():
        turned = mirrors[faces[:, 0]][:, None]
        faces = np.where(turned, faces[:, ::-1], faces)
    normals, tangents = mesh.normals, mesh.tangents
    if normals is not None:
        normals = _float(_normalized(place.normals(normals)))
    if tangents is not None:
        # a reflection turns cross(normal, tangent) over, but not the bitangent
        w = np.where((tangents[:, 3:4] < 0) != mirrors[:, None], -1, 1)
        tangents = _float(np.concatenate([_normalized(place.directions(tangents[:, :3])), w], axis=1))
    return replace(
        mesh,
        positions=place.points(mesh.positions).astype(np.float32),
        faces=np.ascontiguousarray(faces, np.int32),
        normals=normals,
        tangents=tangents,
    )


def _flat(mesh: Mesh) -> Mesh:
    """The mesh with its faces' normals: "When normals are not specified, client implementations MUST calculate flat
    normals and the provided tangents (if present) MUST be ignored" (glTF 2.0, 3.7.2.1). Where faces of different
    normals meet, each corner gets a vertex of its own."""
    corners = mesh.faces.ravel()
    if len(corners) and (corners.min() < 0 or corners.max() >= len(mesh.positions)):
        return mesh  # refused by ``repair``, which counts them
    p = mesh.positions[mesh.faces].astype(np.float64)
    with np.errstate(all="ignore"):
        normal = unit(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])).astype(np.float32)
    normal = np.repeat(normal, 3, axis=0)
    some = np.zeros((len(mesh.positions), 3), np.float32)  # the normal of some face of each vertex
    some[corners] = normal
    disagree = (some[corners] != normal).any(axis=1)
    shared = np.bincount(corners[disagree], minlength=len(some)) == 0
    split = ~shared[corners]
    index = np.concatenate([np.flatnonzero(shared), corners[split]])
    faces = (np.cumsum(shared) - 1)[corners]
    faces[split] = int(shared.sum()) + np.arange(int(split.sum()))
    return replace(
        mesh,
        positions=mesh.positions[index],
        faces=faces.reshape(-1, 3).astype(np.int32),
        normals=np.concatenate([some[shared], normal[split]]),
        uvs=None if mesh.uvs is None else mesh.uvs[index],
        colors=None if mesh.colors is None else mesh.colors[index],
        tangents=None,
    )


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


def _normalized(v: NDArray) -> NDArray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-30)


def _float(v: NDArray | None) -> NDArray[np.float32] | None:
    return None if v is None else v.astype(np.float32)
