"""An Asset to glTF 2.0: one GLB file, or .gltf with .bin and image files beside it."""

from __future__ import annotations

import json
import struct
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from appearance_opt.asset import hierarchy
from appearance_opt.asset.file_options import PLAIN
from appearance_opt.asset.gltf_buffers import Buffers
from appearance_opt.asset.gltf_materials import (
    BASISU,
    IOR,
    STRENGTH,
    TRANSMISSION,
    UNLIT,
    VOLUME,
    WEBP,
)
from appearance_opt.asset.gltf_rig_write import RigWriter
from appearance_opt.asset.height import as_16_bit, height_png
from appearance_opt.asset.hierarchy import Transform
from appearance_opt.asset.origin import ZERO
from appearance_opt.asset.quantize import Grid
from appearance_opt.asset.sides import apart_from_sides
from appearance_opt.asset.texture_files import Slot, encode_all

if TYPE_CHECKING:
    from collections.abc import Sequence

    from appearance_opt.asset.file_options import FileOptions, MapKind
    from appearance_opt.asset.origin import Origin
    from appearance_opt.asset.types import Asset, ColorSpace, Displacement, Material, Mesh, Texture

_WRAPS = {"repeat": 10497, "clamp": 33071, "mirror": 33648}
_SOURCES = {"webp": WEBP, "ktx2": BASISU}
"""Extensions through which a texture names an image that is neither PNG nor JPEG."""


LOD, COVERAGE = "MSFT_lod", "MSFT_screencoverage"
"""Extension of a node that coarser levels replace, and the key of its extras that says when."""


def save_gltf(
    asset: Asset,
    path: Path,
    options: FileOptions = PLAIN,
    coarser: Sequence[Asset] = (),
    coverage: Sequence[float] = (),
) -> None:
    """Write .glb (one file) or .gltf (geometry in ``<stem>.bin``, textures in ``<stem>_<k>.png``,
    or the suffix of their codec). ``coarser``: levels that replace the asset where it is small
    (MSFT_lod); ``coverage``: share of the screen down to which each level is shown, the asset's
    first.

    glTF has no displacement: a height map goes to ``<stem>_displacement.png`` (16 bit), and the
    extras of its materials name it, its scale and its mid-level.
    """
    path = Path(path)
    writer = _Writer(asset, path.stem, options, coarser, coverage)
    for name, data in writer.companions.items():
        path.with_name(name).write_bytes(data)
    if path.suffix.lower() == ".glb":
        writer.embed_images()
        path.write_bytes(writer.glb())
        return
    for k, file in enumerate(writer.images):
        name = f"{path.stem}_{k}{file.suffix}"
        path.with_name(name).write_bytes(file.data)
        writer.json["images"][k] = {"uri": quote(name)}
        if file.codec in _SOURCES:
            writer.json["images"][k]["mimeType"] = file.mime
    path.with_suffix(".bin").write_bytes(bytes(writer.buffers.binary))
    path.write_text(json.dumps(writer.finished(quote(f"{path.stem}.bin")), indent=1))


class _Writer:
    """Collects the JSON and the binary buffer of a file."""

    def __init__(
        self,
        asset: Asset,
        stem: str,
        options: FileOptions,
        coarser: Sequence[Asset] = (),
        coverage: Sequence[float] = (),
    ) -> None:
        self.buffers = Buffers(options)
        self.stem, self.options = stem, options
        self.companions: dict[str, bytes] = {}
        self._displacements: dict[int, str] = {}
        self._textures: dict[tuple[int, str], int] = {}
        self._samplers: list[dict[str, int]] = []
        self._slots: list[Slot] = []
        self._materials: dict[int, int] = {}
        self._looks: set[tuple] = set()
        self.json: dict[str, Any] = {"asset": _about(asset), "scene": 0, "meshes": []}
        if asset.rig is None:
            self.json["nodes"] = []
            tops = self._place(asset)
            if coarser:
                tops = [self._place_levels(asset.name, tops, coarser, coverage)]
            self.json["scenes"] = [{"nodes": tops}]
        else:
            self._place_rigged(RigWriter(asset, asset.rig))
        self.images = encode_all(self._slots, options)
        self._name_images()

    def embed_images(self) -> None:
        """Put the images into the binary buffer."""
        for k, file in enumerate(self.images):
            view = self.buffers.add_bytes(file.data)
            self.json["images"][k] = {"bufferView": view, "mimeType": file.mime}

    def finished(self, uri: str | None = None) -> dict[str, Any]:
        """The JSON of the file whose binary buffer is at ``uri`` (None: in the same file)."""
        self.json["accessors"], self.json["bufferViews"] = (
            self.buffers.accessors,
            self.buffers.views,
        )
        self.json["buffers"] = self.buffers.extents(uri)
        for name in self.buffers.required:
            self._use(name, required=True)
        return self.json

    def glb(self) -> bytes:
        """The whole file."""
        self.buffers.binary += b"\0" * (-len(self.buffers.binary) % 4)
        text = json.dumps(self.finished(), separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.buffers.binary)
        head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
        return b"".join(
            [
                head,
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(binary), b"BIN\0"),
                binary,
            ]
        )

    def _place(self, asset: Asset) -> list[int]:
        """Nodes and meshes; returns the nodes that none is above. Meshes of one node are one mesh
        in its coordinates. Those of no node have one each, below a root that brings them to the
        asset's origin if that is not the world's."""
        transforms, world = hierarchy.place_nodes(asset.nodes)
        nodes: list[dict[str, Any]] = self.json["nodes"]
        base = len(nodes)
        nodes += [_node(n.name, t, n.extras) for n, t in zip(asset.nodes, transforms, strict=True)]
        tops: list[int] = []
        for k, node in enumerate(asset.nodes):
            above = None if node.parent is None else nodes[base + node.parent]
            siblings = tops if above is None else above.setdefault("children", [])
            siblings.append(base + k)
        groups = hierarchy.group_by_node(asset)
        loose = [asset.meshes[k] for k in groups.pop(None, [])]
        for number, members in groups.items():
            assert number is not None
            meshes, offset = hierarchy.in_coordinates(
                [asset.meshes[k] for k in members], world[number], asset.origin
            )
            self._hang(meshes, offset, nodes[base + number], nodes)
        grid, first = self._grid(loose), len(nodes)
        nodes += [{"name": m.name, **self._shown([m], m.name, grid)} for m in loose]
        beside = list(range(first, len(nodes)))
        if loose and any(asset.origin):
            root = {"name": asset.name, "translation": list(asset.origin), "children": beside}
            nodes.append(root)
            beside = [len(nodes) - 1]
        return tops + beside

    def _place_levels(
        self, name: str, tops: list[int], coarser: Sequence[Asset], coverage: Sequence[float]
    ) -> int:
        """A node for each level with all that it shows below it; those of coarser levels belong to
        no scene. Returns the finest one, above ``tops``."""
        below = [tops, *map(self._place, coarser)]
        first = len(self.json["nodes"])
        self.json["nodes"] += [
            {"name": f"{name}_LOD{k}", "children": children} for k, children in enumerate(below)
        ]
        finest = self.json["nodes"][first]
        self._extend(finest, LOD, {"ids": [first + k for k in range(1, len(below))]})
        finest["extras"] = {COVERAGE: list(coverage)}
        return first

    def _place_rigged(self, rig: RigWriter) -> None:
        """Scene, nodes, skins, animations and meshes of an asset that moves."""
        skinned, hung, still = rig.parts
        for mesh in hung:
            parent, node = rig.nodes[rig.node_of(mesh)], {"name": mesh.name}
            parent.setdefault("children", []).append(len(rig.nodes))
            rig.nodes.append(
                node | self._shown([replace(mesh, skin=None)], mesh.name, self._grid([mesh]))
            )
        grid = self._grid(still)
        rig.nodes += [{"name": m.name, **self._shown([m], m.name, grid)} for m in still]
        grid = self._grid(skinned)
        for mesh in skinned:  # their own place does not count
            shown = self._shown([mesh], mesh.name, grid)["mesh"]
            rig.nodes.append({"name": mesh.name, "mesh": shown, "skin": 0})
        self.json |= rig.finish(self.buffers, grid)

    def _hang(
        self,
        meshes: list[Mesh],
        offset: Origin,
        node: dict[str, Any],
        nodes: list[dict[str, Any]],
    ) -> None:
        """Let a node show meshes at a place in its coordinates. What brings them there, or undoes a
        grid, gets a node of its own below it, so that the pivot stays."""
        name = node.get("name", "mesh")
        shown = self._shown(meshes, name, self._grid(meshes), offset)
        if len(shown) == 1:
            node |= shown
            return
        node.setdefault("children", []).append(len(nodes))
        nodes.append({"name": f"{name}{hierarchy.OF_MESH}", **shown})

    def _grid(self, meshes: list[Mesh]) -> Grid | None:
        """The grid of meshes whose positions are to be quantised. Not of those whose thickness the
        scale of a node would change (KHR_materials_volume)."""
        thick = any(m.material.volume and m.material.volume.thickness > 0 for m in meshes)
        if not self.options.quantize or not meshes or thick:
            return None
        return Grid.around([m.positions for m in meshes])

    def _shown(
        self, meshes: list[Mesh], name: str, grid: Grid | None, offset: Origin = ZERO
    ) -> dict[str, Any]:
        """What a node says that shows meshes at a place: as one of the file, and what undoes their
        grid."""
        primitives = []
        for mesh in meshes:
            primitive = self.buffers.primitive(mesh, grid)
            primitives.append({**primitive, "material": self._number(mesh.material)})
        self.json["meshes"].append({"name": name, "primitives": primitives})
        out: dict[str, Any] = {"mesh": len(self.json["meshes"]) - 1}
        place = np.add(offset, ZERO if grid is None else grid.low).tolist()
        if any(place):
            out["translation"] = place
        if grid is not None:
            out["scale"] = [grid.scale] * 3
        return out

    def _number(self, material: Material) -> int:
        """Index of a material, written when it is first asked for."""
        if id(material) not in self._materials:
            self._materials[id(material)] = len(self._materials)
            written = self._material(material)
            if (look := apart_from_sides(material)) in self._looks:
                written["name"] += "_double_sided" if material.double_sided else "_single_sided"
            self._looks.add(look)
            self.json.setdefault("materials", []).append(written)
        return self._materials[id(material)]

    def _material(self, m: Material) -> dict[str, Any]:
        pbr: dict[str, Any] = {
            "baseColorFactor": [*m.base_color, m.opacity],
            "roughnessFactor": m.roughness,
            "metallicFactor": m.metalness,
        }
        if m.base_color_texture is not None:
            pbr["baseColorTexture"] = {"index": self._texture(m.base_color_texture, "color")}
        if (
            m.unlit
        ):  # what readers without the extension show comes near (KHR_materials_unlit, "Fallback")
            pbr |= {"roughnessFactor": 0.9, "metallicFactor": 0.0}
        elif m.orm_texture is not None:
            orm = self._texture(m.orm_texture, "material", not m.has_occlusion)
            pbr["metallicRoughnessTexture"] = {"index": orm}
        out: dict[str, Any] = {
            "name": m.name,
            "pbrMetallicRoughness": pbr,
            "doubleSided": m.double_sided,
        }
        if m.unlit:
            self._extend(out, UNLIT, {})
        elif m.normal_texture is not None:
            out["normalTexture"] = {
                "index": self._texture(m.normal_texture, "normal"),
                "scale": m.normal_scale,
            }
        if m.orm_texture is not None and m.has_occlusion and not m.unlit:
            out["occlusionTexture"] = {"index": self._texture(m.orm_texture, "material")}
        if m.emits and not m.unlit:
            self._add_emission(out, m)
        if m.transmission > 0:
            self._add_transmission(out, m)
        if m.displacement is not None:
            out["extras"] = {"displacement": self._displacement(m.displacement)}
        if m.alpha_mode != "opaque":
            out["alphaMode"] = m.alpha_mode.upper()
            if m.alpha_mode == "mask":
                out["alphaCutoff"] = m.alpha_cutoff
        return out

    def _add_emission(self, out: dict[str, Any], m: Material) -> None:
        strength = max(1.0, *m.emission)  # factors end at 1
        out["emissiveFactor"] = [x / strength for x in m.emission]
        if m.emission_texture is not None:
            out["emissiveTexture"] = {"index": self._texture(m.emission_texture, "color")}
        if strength > 1:
            self._extend(out, STRENGTH, {"emissiveStrength": strength})

    def _add_transmission(self, out: dict[str, Any], m: Material) -> None:
        through: dict[str, Any] = {"transmissionFactor": m.transmission}
        if m.transmission_texture is not None:
            through["transmissionTexture"] = {
                "index": self._texture(m.transmission_texture, "material")
            }
        self._extend(out, TRANSMISSION, through)
        if m.ior != 1.5:
            self._extend(out, IOR, {"ior": m.ior})
        if m.volume is None:
            return
        inside: dict[str, Any] = {
            "thicknessFactor": m.volume.thickness,
            "attenuationColor": list(m.volume.attenuation_color),
        }
        if np.isfinite(m.volume.attenuation_distance):
            inside["attenuationDistance"] = m.volume.attenuation_distance
        if m.thickness_texture is not None:
            inside["thicknessTexture"] = {"index": self._texture(m.thickness_texture, "material")}
        self._extend(out, VOLUME, inside)

    def _extend(self, out: dict[str, Any], name: str, values: dict[str, Any]) -> None:
        """Add an extension to a material or a node, and to those that the file uses."""
        out.setdefault("extensions", {})[name] = values
        self._use(name)

    def _use(self, name: str, required: bool = False) -> None:
        for key in ("extensionsUsed", "extensionsRequired")[: 1 + required]:
            names = self.json.setdefault(key, [])
            if name not in names:
                names.append(name)

    def _displacement(self, given: Displacement) -> dict[str, Any]:
        d = as_16_bit(given)
        if id(given) not in self._displacements:
            name = f"{self.stem}_displacement{len(self.companions) or ''}.png"
            self._displacements[id(given)] = name
            self.companions[name] = height_png(d)
        uri = quote(self._displacements[id(given)])
        return {"uri": uri, "scale": d.scale, "midLevel": d.mid, "texCoord": 0, "unit": "metre"}

    def _texture(self, texture: Texture, kind: MapKind, free_red: bool = False) -> int:
        """Index of a texture in a slot for maps of that kind. ``free_red``: see ``Slot``; what is
        asked for with and without it is one texture, with the red channel that it has."""
        space: ColorSpace = "srgb" if kind == "color" else "linear"
        key = (id(texture), kind)
        if key not in self._textures:
            sampler = {
                "magFilter": 9729,
                "minFilter": 9987,
                "wrapS": _WRAPS[texture.wrap[0]],
                "wrapT": _WRAPS[texture.wrap[1]],
            }
            if sampler not in self._samplers:
                self._samplers.append(sampler)
            self._textures[key] = len(self._slots)
            entry = {"sampler": self._samplers.index(sampler), "source": len(self._slots)}
            self.json.setdefault("textures", []).append(entry)
            self._slots.append(Slot(texture, space, kind, free_red))
        elif not free_red:
            self._slots[self._textures[key]] = Slot(texture, space, kind)
        return self._textures[key]

    def _name_images(self) -> None:
        """Let textures name images of other codecs than glTF's own by the extensions that know
        them. There is no other image to fall back on, so that a reader must know them, too."""
        if not self._slots:
            return
        self.json["images"] = [{} for _ in self._slots]
        self.json["samplers"] = self._samplers
        for entry, file in zip(self.json["textures"], self.images, strict=True):
            extension = _SOURCES.get(file.codec)
            if extension is not None:
                entry["extensions"] = {extension: {"source": entry.pop("source")}}
                self._use(extension, required=True)


def _about(asset: Asset) -> dict[str, Any]:
    """What the file says of itself."""
    out: dict[str, Any] = {"version": "2.0", "generator": "appearance-opt"}
    if asset.credits.copyright:
        out["copyright"] = asset.credits.copyright
    if asset.credits.extras is not None:
        out["extras"] = asset.credits.extras
    if asset.credits.lighting:
        given = asset.credits.extras
        others = given if isinstance(given, dict) else {} if given is None else {"source": given}
        out["extras"] = {**others, "lighting": asset.credits.lighting}
    return out


def _node(name: str, transform: Transform, extras: Any) -> dict[str, Any]:
    """A node without meshes or children. What is the default is left out."""
    out: dict[str, Any] = {"name": name}
    for key, default in _RESTING.items():
        value = getattr(transform, key)
        if value != default:
            out[key] = list(value)
    if extras is not None:
        out["extras"] = extras
    return out


_RESTING = {f.name: f.default for f in fields(Transform)}
