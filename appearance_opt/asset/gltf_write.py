"""An Asset to glTF 2.0: one GLB file, or .gltf with .bin and PNG files beside it."""

from __future__ import annotations

import json
import struct
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from appearance_opt.asset import images
from appearance_opt.asset.encoding import encoded_for
from appearance_opt.asset.gltf_materials import IOR, STRENGTH, TRANSMISSION, UNLIT, VOLUME
from appearance_opt.asset.height import as_16_bit, height_png
from appearance_opt.asset.sides import apart_from_sides

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset, ColorSpace, Displacement, Material, Mesh, Texture

_WRAPS = {"repeat": 10497, "clamp": 33071, "mirror": 33648}
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963


def save_gltf(asset: Asset, path: Path) -> None:
    """Write .glb (one file) or .gltf (geometry in ``<stem>.bin``, textures in ``<stem>_<k>.png``).

    glTF has no displacement: a height map goes to ``<stem>_displacement.png`` (16 bit), and the
    extras of its materials name it, its scale and its mid-level.
    """
    path = Path(path)
    writer = _Writer(asset, path.stem)
    for name, data in writer.companions.items():
        path.with_name(name).write_bytes(data)
    if path.suffix.lower() == ".glb":
        writer.embed_images()
        path.write_bytes(writer.glb())
        return
    for k, data in enumerate(writer.image_files):
        path.with_name(f"{path.stem}_{k}.png").write_bytes(data)
        writer.json["images"][k] = {"uri": quote(f"{path.stem}_{k}.png")}
    path.with_suffix(".bin").write_bytes(bytes(writer.binary))
    writer.json["buffers"] = [{"uri": quote(f"{path.stem}.bin"), "byteLength": len(writer.binary)}]
    path.write_text(json.dumps(writer.json, indent=1))


class _Writer:
    """Collects the JSON and the binary buffer of a file."""

    def __init__(self, asset: Asset, stem: str) -> None:
        self.binary = bytearray()
        self.stem = stem
        self.companions: dict[str, bytes] = {}
        self._displacements: dict[int, str] = {}
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "appearance-opt"},
            "scene": 0,
            **_placed(asset),
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
        }
        self._textures: dict[tuple[int, str], int] = {}
        self._samplers: list[dict[str, int]] = []
        self._pending: list[tuple[Texture, ColorSpace]] = []
        materials: dict[int, int] = {}
        looks: set[tuple] = set()
        for mesh in asset.meshes:
            if id(mesh.material) not in materials:
                materials[id(mesh.material)] = len(materials)
                written = self._material(mesh.material)
                if (look := apart_from_sides(mesh.material)) in looks:
                    written["name"] += (
                        "_double_sided" if mesh.material.double_sided else "_single_sided"
                    )
                looks.add(look)
                self.json.setdefault("materials", []).append(written)
            self.json["meshes"].append(self._mesh(mesh, materials[id(mesh.material)]))
        with ThreadPoolExecutor() as pool:
            self.image_files = list(
                pool.map(lambda p: images.encode_png(encoded_for(*p)), self._pending)
            )
        if self._pending:
            self.json["images"] = [{} for _ in self._pending]
            self.json["samplers"] = self._samplers

    def embed_images(self) -> None:
        """Put the images into the binary buffer."""
        for k, data in enumerate(self.image_files):
            self.json["images"][k] = {"bufferView": self._view(data), "mimeType": "image/png"}

    def glb(self) -> bytes:
        """The whole file."""
        self.json["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.json, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.binary) + b"\0" * (-len(self.binary) % 4)
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

    def _view(self, data: bytes, target: int | None = None) -> int:
        self.binary += b"\0" * (-len(self.binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.binary += data
        self.json["bufferViews"].append(view)
        return len(self.json["bufferViews"]) - 1

    def _attribute(self, values: NDArray, bounds: bool = False) -> int:
        values = np.ascontiguousarray(values, np.float32)
        accessor = {
            "bufferView": self._view(values.tobytes(), _ARRAY_BUFFER),
            "componentType": 5126,
            "count": len(values),
            "type": f"VEC{values.shape[1]}",
        }
        if bounds:
            accessor["min"], accessor["max"] = (
                values.min(axis=0).tolist(),
                values.max(axis=0).tolist(),
            )
        self.json["accessors"].append(accessor)
        return len(self.json["accessors"]) - 1

    def _mesh(self, mesh: Mesh, material: int) -> dict[str, Any]:
        attributes = {"POSITION": self._attribute(mesh.positions, bounds=True)}
        if mesh.normals is not None:
            attributes["NORMAL"] = self._attribute(_unit(mesh.normals))
            if mesh.tangents is not None:
                tangents = np.concatenate(
                    [_unit(mesh.tangents[:, :3]), mesh.tangents[:, 3:]], axis=1
                )
                attributes["TANGENT"] = self._attribute(tangents)
        if mesh.uvs is not None:
            attributes["TEXCOORD_0"] = self._attribute(mesh.uvs)
        if mesh.colors is not None:
            attributes["COLOR_0"] = self._attribute(mesh.colors)
        # the largest index of a type is reserved (primitive restart)
        kind, code = (np.uint16, 5123) if len(mesh.positions) < 65535 else (np.uint32, 5125)
        view = self._view(np.ascontiguousarray(mesh.faces, kind).tobytes(), _ELEMENT_BUFFER)
        indices = {
            "bufferView": view,
            "componentType": code,
            "count": 3 * len(mesh.faces),
            "type": "SCALAR",
        }
        self.json["accessors"].append(indices)
        primitive = {
            "attributes": attributes,
            "indices": len(self.json["accessors"]) - 1,
            "material": material,
        }
        return {"name": mesh.name, "primitives": [primitive]}

    def _material(self, m: Material) -> dict[str, Any]:
        pbr: dict[str, Any] = {
            "baseColorFactor": [*m.base_color, m.opacity],
            "roughnessFactor": m.roughness,
            "metallicFactor": m.metalness,
        }
        if m.base_color_texture is not None:
            pbr["baseColorTexture"] = {"index": self._texture(m.base_color_texture, "srgb")}
        if (
            m.unlit
        ):  # what readers without the extension show comes near (KHR_materials_unlit, "Fallback")
            pbr |= {"roughnessFactor": 0.9, "metallicFactor": 0.0}
        elif m.orm_texture is not None:
            pbr["metallicRoughnessTexture"] = {"index": self._texture(m.orm_texture)}
        out: dict[str, Any] = {
            "name": m.name,
            "pbrMetallicRoughness": pbr,
            "doubleSided": m.double_sided,
        }
        if m.unlit:
            self._extend(out, UNLIT, {})
        elif m.normal_texture is not None:
            out["normalTexture"] = {
                "index": self._texture(m.normal_texture),
                "scale": m.normal_scale,
            }
        if m.orm_texture is not None and m.has_occlusion and not m.unlit:
            out["occlusionTexture"] = {"index": self._texture(m.orm_texture)}
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
            out["emissiveTexture"] = {"index": self._texture(m.emission_texture, "srgb")}
        if strength > 1:
            self._extend(out, STRENGTH, {"emissiveStrength": strength})

    def _add_transmission(self, out: dict[str, Any], m: Material) -> None:
        through: dict[str, Any] = {"transmissionFactor": m.transmission}
        if m.transmission_texture is not None:
            through["transmissionTexture"] = {"index": self._texture(m.transmission_texture)}
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
            inside["thicknessTexture"] = {"index": self._texture(m.thickness_texture)}
        self._extend(out, VOLUME, inside)

    def _extend(self, out: dict[str, Any], name: str, values: dict[str, Any]) -> None:
        """Add an extension to a material, and to those that the file uses."""
        out.setdefault("extensions", {})[name] = values
        used = self.json.setdefault("extensionsUsed", [])
        if name not in used:
            used.append(name)

    def _displacement(self, given: Displacement) -> dict[str, Any]:
        d = as_16_bit(given)
        if id(given) not in self._displacements:
            name = f"{self.stem}_displacement{len(self.companions) or ''}.png"
            self._displacements[id(given)] = name
            self.companions[name] = height_png(d)
        uri = quote(self._displacements[id(given)])
        return {"uri": uri, "scale": d.scale, "midLevel": d.mid, "texCoord": 0, "unit": "metre"}

    def _texture(self, texture: Texture, space: ColorSpace = "linear") -> int:
        """Index of a texture in a slot of that encoding."""
        key = (id(texture), space)
        if key not in self._textures:
            sampler = {
                "magFilter": 9729,
                "minFilter": 9987,
                "wrapS": _WRAPS[texture.wrap[0]],
                "wrapT": _WRAPS[texture.wrap[1]],
            }
            if sampler not in self._samplers:
                self._samplers.append(sampler)
            self._textures[key] = len(self._pending)
            entry = {"source": len(self._pending), "sampler": self._samplers.index(sampler)}
            self.json.setdefault("textures", []).append(entry)
            self._pending.append((texture, space))
        return self._textures[key]


def _placed(asset: Asset) -> dict[str, Any]:
    """Scene and nodes: one for each mesh, below a root that brings them to the asset's origin if
    that is not the world's."""
    nodes: list[dict[str, Any]] = [{"mesh": k, "name": m.name} for k, m in enumerate(asset.meshes)]
    tops = list(range(len(nodes)))
    if any(asset.origin):
        nodes.append({"name": asset.name, "translation": list(asset.origin), "children": tops})
        tops = [len(nodes) - 1]
    return {"scenes": [{"nodes": tops}], "nodes": nodes}


def _unit(v: NDArray) -> NDArray[np.float32]:
    """Unit length to float32 precision, which the validator asks for."""
    w = np.asarray(v, np.float64)
    return (w / np.maximum(np.linalg.norm(w, axis=1, keepdims=True), 1e-30)).astype(np.float32)
