"""glTF 2.0 and GLB to an Asset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset import images, specular_glossiness, uv_frames
from appearance_opt.asset.gltf_accessors import Document
from appearance_opt.asset.gltf_draco import DRACO, Compressed
from appearance_opt.asset.missing import Missing, MissingTextures
from appearance_opt.asset.types import Asset, Material, Mesh, Texture, Wrap
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_COMPRESSED = {
    "EXT_meshopt_compression": "meshopt",
    "KHR_texture_basisu": "Basis Universal",
}
_STRENGTH = "KHR_materials_emissive_strength"
_SPECULAR = "KHR_materials_pbrSpecularGlossiness"
_HARMLESS = {DRACO, _SPECULAR, _STRENGTH, "KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp"}


def load_gltf(path: Path, missing_textures: MissingTextures = "error") -> Asset:
    """Read a .gltf or .glb file. Raises InputError."""
    document = Document(path)
    try:
        return _Reader(document, missing_textures).asset()
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"{path}: the glTF structure is broken ({type(error).__name__}: {error})") from error


class _Reader:
    def __init__(self, document: Document, missing_textures: MissingTextures) -> None:
        self.document = document
        self.path = document.path
        self.notes: list[str] = []
        self.missing = Missing(missing_textures, self.notes)
        self._images: dict[int, NDArray | None] = {}
        self._materials: dict[int | None, Material] = {}

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
                self._note(f"{what} ignored")
        return Asset(tuple(self._in_one_frame(meshes)), self.path.stem, tuple(self.notes))

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def _check_extensions(self) -> None:
        for name in self.document.json.get("extensionsRequired", []):
            if name in _COMPRESSED:
                raise InputError(
                    f"{self.path}: {_COMPRESSED[name]} compression is not supported; save it uncompressed first"
                )
        for name in self.document.json.get("extensionsUsed", []):
            if name not in _HARMLESS:
                self._note(f"extension {name} ignored")

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
            self._note("points and lines ignored")
            return None
        if primitive.get("targets"):
            self._note("morph targets ignored")
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
        material, channel = self._material(primitive.get("material"))
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

    def _texture_infos(self, index: int | None) -> dict[str, dict[str, Any]]:
        """What a material says of its textures, by the name of ours."""
        if index is None:
            return {}
        m = self.document.items("materials")[index]
        pbr, specular = m.get("pbrMetallicRoughness", {}), m.get("extensions", {}).get(_SPECULAR)
        color, orm = pbr.get("baseColorTexture"), pbr.get("metallicRoughnessTexture")
        if specular is not None:  # both are made of both of its textures
            color = orm = specular.get("diffuseTexture", specular.get("specularGlossinessTexture"))
        infos = {
            "base_color_texture": color,
            "orm_texture": orm,
            "normal_texture": m.get("normalTexture"),
            "emission_texture": m.get("emissiveTexture"),
        }
        return {name: info for name, info in infos.items() if info is not None}

    def _in_one_frame(self, meshes: list[Mesh]) -> list[Mesh]:
        """KHR_texture_transform applied, and textures brought under one transform and wrap mode where they differ."""
        out = list(meshes)
        for index, material in self._materials.items():
            own = [k for k, m in enumerate(meshes) if m.material is material and m.uvs is not None]
            infos = self._texture_infos(index)
            textures = {n: t for n in infos if (t := getattr(material, n)) is not None}
            if not own or not textures:
                continue
            uvs = [np.asarray(meshes[k].uvs) for k in own]
            extensions = {n: infos[n].get("extensions", {}) for n in textures}
            frames = {n: uv_frames.affine(e.get("KHR_texture_transform")) for n, e in extensions.items()}
            new = material
            placed = [uv_frames.apply(next(iter(frames.values())), uv).astype(np.float32) for uv in uvs]
            if not uv_frames.alike(uvs, textures, frames):
                # tangents follow the coordinates, and the normal map follows the tangents
                leading = "normal_texture" if "normal_texture" in textures else next(iter(textures))
                unified = uv_frames.in_one_frame(uvs, textures, frames, leading)
                differ = f"material '{material.name}': its textures differ in transform or wrap mode"
                if unified is None:
                    self._note(f"{differ}, and are too large to be resampled: the first one's are used for all")
                else:
                    self._note(f"{differ}: resampled to common texture coordinates")
                    placed, new = unified[0], replace(material, **unified[1])  # type: ignore[arg-type]
            for k, uv in zip(own, placed, strict=True):
                out[k] = replace(meshes[k], uvs=uv, material=new)
        return out

    def _material(self, index: int | None) -> tuple[Material, int]:
        """(material, index of the texture coordinates that its textures use)."""
        infos = self._texture_infos(index)
        channels = [
            i.get("extensions", {}).get("KHR_texture_transform", {}).get("texCoord", i.get("texCoord", 0))
            for i in infos.values()
        ]
        if len(set(channels)) > 1:
            self._note("textures of one material use different texture coordinates: the first set is used for all")
        if index not in self._materials:
            self._materials[index] = Material() if index is None else self._read_material(index)
        return self._materials[index], channels[0] if channels else 0

    def _read_material(self, index: int) -> Material:
        m = self.document.items("materials")[index]
        name = m.get("name", f"material{index}")
        specular = m.get("extensions", {}).get(_SPECULAR)
        if specular is None:
            material = self._metallic(m.get("pbrMetallicRoughness", {}), name)
        else:
            material = self._converted(specular, name)
        if "occlusionTexture" in m:
            self._note("occlusion ignored (it is not part of the appearance under a moving light)")
        mode = {"MASK": "mask", "BLEND": "blend"}.get(m.get("alphaMode", "OPAQUE"), "opaque")
        if mode != "opaque":
            self._note(f"material '{name}': transparency ignored, drawn opaque")
        normal = m.get("normalTexture")
        strength = float(m.get("extensions", {}).get(_STRENGTH, {}).get("emissiveStrength", 1.0))
        red, green, blue = (strength * float(x) for x in m.get("emissiveFactor", (0, 0, 0)))
        return replace(
            material,
            normal_scale=float(normal.get("scale", 1.0)) if normal else 1.0,
            normal_texture=self._texture(normal, "linear", name),
            alpha_mode=mode,  # type: ignore[arg-type]
            alpha_cutoff=float(m.get("alphaCutoff", 0.5)),
            double_sided=bool(m.get("doubleSided", False)),
            emission=(red, green, blue),
            emission_texture=self._texture(m.get("emissiveTexture"), "srgb", name),
        )

    def _metallic(self, pbr: dict[str, Any], name: str) -> Material:
        factor = [float(x) for x in pbr.get("baseColorFactor", (1, 1, 1, 1))]
        return Material(
            name=name,
            base_color=(factor[0], factor[1], factor[2]),
            roughness=float(pbr.get("roughnessFactor", 1.0)),
            metalness=float(pbr.get("metallicFactor", 1.0)),
            base_color_texture=self._texture(pbr.get("baseColorTexture"), "srgb", name),
            orm_texture=self._texture(pbr.get("metallicRoughnessTexture"), "linear", name),
            opacity=factor[3],
        )

    def _converted(self, given: dict[str, Any], name: str) -> Material:
        """A specular-glossiness material as a metallic-roughness one."""
        self._note("specular-glossiness materials converted to metallic-roughness")
        infos = [given[k] for k in ("diffuseTexture", "specularGlossinessTexture") if k in given]
        if len({str((i.get("texCoord"), i.get("extensions"))) for i in infos}) > 1:
            self._note(f"material '{name}': its textures differ in transform: the first one's is used for all")
        diffuse = [float(x) for x in given.get("diffuseFactor", (1, 1, 1, 1))]
        specular = [float(x) for x in given.get("specularFactor", (1, 1, 1))]
        read = specular_glossiness.Specular(
            (diffuse[0], diffuse[1], diffuse[2]),
            (specular[0], specular[1], specular[2]),
            float(given.get("glossinessFactor", 1.0)),
            self._texture(given.get("diffuseTexture"), "srgb", name),
            self._texture(given.get("specularGlossinessTexture"), "srgb", name),
        )
        if read.diffuse_texture is None and read.specular_texture is None:
            color, roughness, metalness = specular_glossiness.constants(read)
            return Material(name, color, roughness, metalness, opacity=diffuse[3])
        base, orm = specular_glossiness.textures(read)
        return Material(name, (1, 1, 1), 1.0, 1.0, base_color_texture=base, orm_texture=orm, opacity=diffuse[3])

    def _texture(self, info: dict[str, Any] | None, space: str, material: str) -> Texture | None:
        if info is None:
            return None
        texture = self.document.items("textures")[info["index"]]
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        source = texture.get("source", webp.get("source"))
        if source is None:
            raise InputError(f"{self.path}: a texture of material '{material}' has no image in a supported format")
        if source not in self._images:
            self._images[source] = self.missing.read(lambda: self._image(source, material))
        sampler = self.document.items("samplers")[texture["sampler"]] if "sampler" in texture else {}
        wrap = (_WRAPS.get(sampler.get("wrapS", 0), "repeat"), _WRAPS.get(sampler.get("wrapT", 0), "repeat"))
        pixels = self._images[source]
        if pixels is None:
            return None
        if pixels.shape[2] < 3:  # grey, or grey and alpha
            pixels = np.repeat(pixels[..., :1], 3, axis=2)
        return Texture(pixels, space, wrap)  # type: ignore[arg-type]

    def _image(self, index: int, material: str) -> NDArray:
        image = self.document.items("images")[index]
        if "bufferView" in image:
            data = self.document.buffer_view(image["bufferView"])[0]
        else:
            data = self.document.uri(image["uri"])
        return images.decode(data, f"{self.path}, image {image.get('name') or index} of material '{material}'")


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
