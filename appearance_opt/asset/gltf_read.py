"""glTF 2.0 and GLB to an Asset."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset import hierarchy, uv_transforms
from appearance_opt.asset.alpha import list_names
from appearance_opt.asset.batch import Batch, in_range, replace_chosen
from appearance_opt.asset.gltf_accessors import Document
from appearance_opt.asset.gltf_draco import DRACO, Compressed
from appearance_opt.asset.gltf_dropped import COUNTED, note_dropped
from appearance_opt.asset.gltf_materials import READ_EXTENSIONS, VARIANTS, MaterialReader
from appearance_opt.asset.gltf_meshopt import MESHOPT
from appearance_opt.asset.gltf_nodes import INSTANCING, Nodes
from appearance_opt.asset.gltf_rig import RigReader
from appearance_opt.asset.hierarchy import OF_MESH
from appearance_opt.asset.influences import on_bone
from appearance_opt.asset.instances import place_copies
from appearance_opt.asset.normals import unit
from appearance_opt.asset.origin import ZERO, settle
from appearance_opt.asset.types import Asset, Contents, Credits, Mesh, Node
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.companions import Companions

_READ = {DRACO, *MESHOPT, INSTANCING, "KHR_mesh_quantization", *READ_EXTENSIONS}
_VISUAL = (
    "KHR_materials_",
    "KHR_lights_",
    "EXT_lights_",
    "KHR_animation_pointer",
    "KHR_xmp_json_ld",
)
"""Extensions, by the start of their names, without which shapes and textures are the same: lobes of
materials, and lights. They are ignored with a note even where a file calls them required."""


def load_gltf(
    path: Path,
    companions: Companions,
    keep_layout: bool = False,
    variant: str | None = None,
    keep_rig: bool = False,
) -> Asset:
    """Read a .gltf or .glb file. ``keep_layout``, ``keep_rig``: see ``asset.load``; ``variant``:
    name of a KHR_materials_variants variant. Raises InputError."""
    document = Document(path, companions)
    for item in (*document.items("buffers"), *document.items("images")):
        uri = item.get("uri")
        if isinstance(uri, str) and not uri.startswith("data:"):
            companions.mention(uri, path, percent_encoded=True)
    return _Reader(document, keep_layout, variant, keep_rig).asset()


_OF_MESH = {"name", "mesh", "translation", "scale"}


class _Reader:
    def __init__(
        self, document: Document, keep_layout: bool, variant: str | None, keep_rig: bool
    ) -> None:
        self.document, self.keep_layout = document, keep_layout
        self.path = document.path
        self.note = document.companions.note
        self.materials = MaterialReader(document, variant)
        self.nodes = Nodes(document)
        self.keep_rig = keep_rig
        self.rig: RigReader | None = None
        primitives = [p for mesh in document.items("meshes") for p in mesh.get("primitives", [])]
        self._sharers = Counter(p.get("attributes", {}).get("POSITION") for p in primitives)
        self._uses = Counter(node["mesh"] for node in document.items("nodes") if "mesh" in node)
        self._local: dict[tuple[int, int, tuple[float, ...]], Mesh] = {}
        self._hierarchy: list[Node] = []
        self._joints: set[int] = set()  # numbers in the hierarchy

    def asset(self) -> Asset:
        self._check_extensions()
        roots = self._roots()
        self.document.companions.budget.take(self.nodes.visits(roots), "nodes", self.path)
        if self.keep_rig and (self.document.items("skins") or self.document.items("animations")):
            self.rig = RigReader(self.nodes, roots)
        drawn = [place for root in roots for place in self._drawn(root, np.eye(4), None)]
        parts = {k: self._primitives(*drawn[k]) for k in self._order(drawn)}
        meshes = [mesh for k in range(len(drawn)) for mesh in parts[k]]
        rig = None if self.rig is None else self.rig.rig()
        if not self.keep_rig:
            for kind, what in (
                ("skins", "skins: the pose at rest is kept; `appearance-opt animate` keeps skins"),
                ("animations", "animations dropped; `appearance-opt animate` keeps them"),
            ):
                if self.document.items(kind):
                    self.note(what)
        origin = ZERO
        if rig is None:
            meshes, origin = settle(meshes, self.note)
        else:
            meshes = [replace(m, positions=m.positions.astype(np.float32)) for m in meshes]
        if not self.keep_layout:
            meshes = self._flat_where_needed(meshes)
        meshes = self.materials.apply_uv_transforms(meshes, self.keep_layout)
        note_dropped(self.document, self.materials.sets_read)
        asset = Asset(
            tuple(meshes),
            self.path.stem,
            self.document.companions.notes.lines(),
            origin=origin,
            contents=self._contents(),
            nodes=() if rig is not None else tuple(self._hierarchy),
            credits=self._credits(),
            rig=rig,
        )
        kept = (k for k in range(len(asset.nodes)) if k not in self._joints)
        return hierarchy.without_idle_nodes(asset, kept)

    def _credits(self) -> Credits:
        about = self.document.json["asset"]
        return Credits(str(about.get("copyright", "")), about.get("extras"))

    def _contents(self) -> Contents:
        def names(items: list[dict[str, Any]], kind: str) -> tuple[str, ...]:
            return tuple(str(item.get("name", f"{kind}{k}")) for k, item in enumerate(items))

        variants = self.document.extension(VARIANTS).get("variants", [])
        return Contents(
            names(self.document.items("skins"), "skin"),
            names(self.document.items("animations"), "animation"),
            names(variants, "variant"),
            tuple(dict.fromkeys(t for m in self.document.items("meshes") for t in _targets(m))),
        )

    def _roots(self) -> list[int]:
        """The nodes at the top of what is drawn: those of the scene that the file names, else of
        the first one; in a library without scenes, the nodes that are no one's children."""
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
            if name not in _READ and not str(name).startswith(_VISUAL):
                raise InputError(
                    f"{self.path}: requires the extension '{name}', which is not supported; save it without"
                )
        for name in self.document.json.get("extensionsUsed", []):
            if name not in _READ and name not in COUNTED:
                self.note(f"extension {name} ignored")

    def _drawn(
        self, index: int, above: NDArray, parent: int | None
    ) -> Iterator[tuple[int, NDArray, int]]:
        """(node, its transform to the world, its number in the hierarchy) of a node and those below
        it that have a mesh. ``above``: the transform of its ``parent`` there."""
        node, local = self.document.items("nodes")[index], self.nodes.local[index]
        world, number = above @ local, len(self._hierarchy)
        name = str(node.get("name", f"node{index}"))
        if parent is not None and name == f"{self._hierarchy[parent].name}{OF_MESH}":
            # what our writer hangs below a node, to bring its mesh to its place
            number = parent if node.keys() <= _OF_MESH else number
        if number != parent:
            self._hierarchy.append(Node(name, parent, local, node.get("extras")))
        if index in self.nodes.joints:
            self._joints.add(number)
        if "mesh" in node:
            yield index, world, number
        for child in node.get("children", []):
            yield from self._drawn(child, world, number)

    def _order(self, drawn: list[tuple[int, NDArray, int]]) -> list[int]:
        """In which order meshes are read: with a rig, skinned ones first, which say where the
        bind space is."""
        nodes, order = self.document.items("nodes"), list(range(len(drawn)))
        return (
            order
            if self.rig is None
            else sorted(order, key=lambda k: "skin" not in nodes[drawn[k][0]])
        )

    def _primitives(self, index: int, world: NDArray, number: int) -> list[Mesh]:
        """The triangles of a node's mesh at every place at which the node puts them. ``number``: of
        the node in the hierarchy."""
        node = self.document.items("nodes")[index]
        mesh = self.document.items("meshes")[node["mesh"]]
        name = node.get("name") or mesh.get("name") or f"mesh{node['mesh']}"
        weights = node.get("weights", mesh.get("weights", ()))
        if any(p.get("targets") for p in mesh["primitives"]):
            self._mention_targets(mesh, name)
        found = [
            self._primitive(p, k, index, world, name if k == 0 else f"{name}.{k}", weights)
            for k, p in enumerate(mesh["primitives"])
        ]
        owner = None if self.rig is not None else number
        return [replace(m, node=owner) for m in found if m is not None]

    def _mention_targets(self, mesh: dict[str, Any], name: str) -> None:
        """Note the morph targets of a mesh by the names that exporters give them."""
        told = "morph targets: the shape of their default weights is kept, others are dropped"
        names = _targets(mesh)
        if self.rig is None:
            self.note(told)
        else:
            self.note(f"mesh '{name}': {told} ({list_names(names)})")

    def _primitive(
        self,
        primitive: dict[str, Any],
        k: int,
        index: int,
        world: NDArray,
        name: str,
        weights: Sequence[float],
    ) -> Mesh | None:
        """The ``k``-th primitive of a node's mesh, at every place at which the node puts it; None
        if it is none of triangles. ``weights``: of its morph targets."""
        if primitive.get("mode", 4) not in (4, 5, 6):
            self.note("points and lines ignored")
            return None
        node = self.document.items("nodes")[index]
        if "skin" in node and "JOINTS_0" in primitive["attributes"]:
            source = _Source(self.document, primitive, weights)
            skin = self.nodes.influences(node["skin"], primitive["attributes"], source.read, name)
            mesh = self._read(primitive, source)
            if self.rig is None:
                return place_copies(mesh, self.nodes.skinned(node["skin"], skin), name)
            place, skin = self.rig.skinned(node["skin"], skin, name)
            return replace(place_copies(mesh, place, name), skin=skin)
        key = (node["mesh"], k, tuple(weights))
        local = self._local.get(key)
        if local is None:
            shared = self._sharers[primitive["attributes"]["POSITION"]] > 1
            local = self._read(primitive, _Source(self.document, primitive, weights, shared))
            if self._uses[node["mesh"]] > 1:
                self._local[key] = local
        place = self.nodes.placement(node, world)
        inside = local.material.volume
        if (
            inside is not None
            and inside.thickness > 0
            and not np.allclose(place.volumes(), 1, rtol=1e-3)
        ):
            self.note(
                "the thickness of transmissive materials is not scaled with the nodes of their meshes"
            )
        self.document.companions.budget.take_copies(local, place.copies, self.path)
        bone = None
        if self.rig is not None:
            place, bone = self.rig.rigid(index, place, world)
        placed = place_copies(local, place, name)
        return (
            placed if bone is None else replace(placed, skin=on_bone(bone, len(placed.positions)))
        )

    def _read(self, primitive: dict[str, Any], source: _Source) -> Mesh:
        """A primitive in its own coordinates, in double precision."""
        attributes, read = primitive["attributes"], source.read
        normals = tangents = colors = None
        if "NORMAL" in attributes:
            normals = read("NORMAL").astype(np.float64)
            tangents = read("TANGENT").astype(np.float64) if "TANGENT" in attributes else None
        material, sets = self.materials.read(self.materials.of(primitive))
        if "COLOR_0" in attributes:
            colors = read("COLOR_0").astype(np.float32)
            if material.alpha_mode == "opaque":  # their alpha means nothing
                colors = colors[:, :3]
        names = [f"TEXCOORD_{k}" for k in sets]
        uvs = uv_transforms.stack_sets(
            [_float(read(n)[:, :2]) if n in attributes else None for n in names]
        )
        positions = read("POSITION")[:, :3].astype(np.float64)
        return Mesh(positions, source.faces, normals, uvs, tangents, colors, material)  # type: ignore[arg-type]

    def _flat_where_needed(self, meshes: list[Mesh]) -> list[Mesh]:
        """The meshes with flat normals where they have none, all in one go."""
        lacking = [m.normals is None and in_range(m) for m in meshes]
        if any(lacking):
            self.note("meshes without normals are shaded flat, as glTF 2.0 asks")

        def flat(batch: Batch) -> list[Mesh]:
            index, faces, normals = flat_normals(batch.joined("positions"), batch.faces)
            return batch.reindexed(index, faces, normals=normals, tangents=None)

        return replace_chosen(meshes, lacking, flat)


class _Source:
    """The triangles of a primitive, ``faces`` (F, 3), and its attributes. Of accessors that it has
    ``shared`` with other primitives it takes the vertices that it uses. ``weights``: of its morph
    targets."""

    def __init__(
        self,
        document: Document,
        primitive: dict[str, Any],
        weights: Sequence[float],
        shared: bool = False,
    ) -> None:
        self.document, self.path, self.attributes = document, document.path, primitive["attributes"]
        # (weight, accessors) of the morph targets that count
        self.targets = [
            (w, t) for w, t in zip(weights, primitive.get("targets", ()), strict=False) if w
        ]
        self.compressed = Compressed.of(document, primitive)
        self._used: NDArray | None = None
        if self.compressed is not None:
            self.faces = self.compressed.faces
            return
        accessor, count = (
            primitive.get("indices"),
            len(document.accessor(self.attributes["POSITION"])),
        )
        indices = np.arange(count) if accessor is None else document.accessor(accessor)[:, 0]
        self.faces = _triangles(indices.astype(np.int64), primitive.get("mode", 4))
        if shared and len(self.faces) and self.faces.max() < count:
            used, corners = np.unique(self.faces, return_inverse=True)
            if len(used) < count:
                self._used, self.faces = used, corners.reshape(-1, 3)

    def read(self, name: str) -> NDArray:
        """(V, width) values of an attribute."""
        if self.compressed is not None and name in self.compressed:
            values = self.compressed.attribute(name)
        else:
            values = self.document.accessor(self.attributes[name])
        values = self._morphed(values, [(w, t[name]) for w, t in self.targets if name in t])
        return values if self._used is None else values[self._used]

    def _morphed(self, values: NDArray, displacements: list[tuple[float, int]]) -> NDArray:
        """(V, width) values of an attribute plus the sum of weight * displacement, accessors of
        which are given (glTF 2.0, 3.7.2.2); those of tangents have no handedness."""
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


def _targets(mesh: dict[str, Any]) -> list[str]:
    """Names of the morph targets of a mesh, where exporters write them, or numbers."""
    count = max((len(p.get("targets", ())) for p in mesh["primitives"]), default=0)
    extras = mesh.get("extras")
    named = extras.get("targetNames", []) if isinstance(extras, dict) else []
    names = list(map(str, named))[:count] if isinstance(named, list) else []
    return names + [f"target{k}" for k in range(len(names), count)]


def flat_normals(
    positions: NDArray, faces: NDArray
) -> tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.float32]]:
    """(vertex that each new vertex comes from, faces, normals) with the faces' normals: "When
    normals are not specified, client implementations MUST calculate flat normals and the provided
    tangents (if present) MUST be ignored" (glTF 2.0, 3.7.2.1). Where faces of different normals
    meet, each corner gets a vertex of its own."""
    corners = faces.ravel()
    p = positions[faces].astype(np.float64)
    with np.errstate(all="ignore"):
        normal = unit(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])).astype(np.float32)
    normal = np.repeat(normal, 3, axis=0)
    some = np.zeros((len(positions), 3), np.float32)  # the normal of some face of each vertex
    some[corners] = normal
    disagree = (some[corners] != normal).any(axis=1)
    shared = np.bincount(corners[disagree], minlength=len(some)) == 0
    split = ~shared[corners]
    index = np.concatenate([np.flatnonzero(shared), corners[split]])
    new = (np.cumsum(shared) - 1)[corners]
    new[split] = int(shared.sum()) + np.arange(int(split.sum()))
    return index, new.reshape(-1, 3), np.concatenate([some[shared], normal[split]])


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


def _float(v: NDArray | None) -> NDArray[np.float32] | None:
    return None if v is None else v.astype(np.float32)
