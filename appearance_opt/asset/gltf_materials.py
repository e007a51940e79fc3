"""Materials and textures of glTF 2.0."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from appearance_opt.asset import images, specular_glossiness, udim, uv_transforms, uv_unification
from appearance_opt.asset.packing import with_occlusion
from appearance_opt.asset.types import Material, Mesh, Texture, Volume, Wrap
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from appearance_opt.asset.gltf_accessors import Document
    from appearance_opt.asset.types import AlphaMode
    from appearance_opt.asset.udim import Tile

STRENGTH = "KHR_materials_emissive_strength"
SPECULAR = "KHR_materials_pbrSpecularGlossiness"
VARIANTS = "KHR_materials_variants"
UNLIT = "KHR_materials_unlit"
TRANSMISSION, VOLUME, IOR = (f"KHR_materials_{name}" for name in ("transmission", "volume", "ior"))
_TRANSPARENT = (TRANSMISSION, VOLUME, IOR)
WEBP, BASISU = "EXT_texture_webp", "KHR_texture_basisu"
_IMAGES = (WEBP, BASISU)
READ_EXTENSIONS = (
    STRENGTH,
    SPECULAR,
    *_TRANSPARENT,
    VARIANTS,
    UNLIT,
    "KHR_texture_transform",
    *_IMAGES,
)
"""Extensions of materials and textures that are heeded."""

_WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}


class MaterialReader:
    """Materials of a file, each read once, as its ``variant`` chooses them. Raises InputError for
    one that it does not have."""

    def __init__(self, document: Document, variant: str | None = None) -> None:
        self.document, self.path = document, document.path
        self.note = document.companions.note
        self._images: dict[int, NDArray | None] = {}
        # what several materials read is one texture, as in the file
        self._read_textures: dict[tuple[int, str, tuple[Wrap, Wrap]], Texture] = {}
        self._materials: dict[int | None, tuple[Material, list[int]]] = {}
        self.sets_read: dict[int | None, list[int]] = {}  # sets of texture coordinates by material
        self._transforms: dict[int, dict[str, uv_transforms.UvTransform]] = {}
        self._tiles: dict[int, Callable[[Tile], Material]] = {}
        self._tile: Tile | None = None  # the one that is read
        self._variant = self._number(variant)

    def _number(self, variant: str | None) -> int | None:
        """Index of a variant, which several may share their names with: the first."""
        names = [v.get("name", "") for v in self.document.extension(VARIANTS).get("variants", [])]
        if variant is None:
            if names:
                self.note(f"shown without a variant; there are {_quote(names)} (--variant NAME)")
            return None
        if variant not in names:
            raise InputError(
                f"{self.path}: has no variant '{variant}'; there are {_quote(names) or 'none'}"
            )
        return names.index(variant)

    def of(self, primitive: dict[str, Any]) -> int | None:
        """Index of the material that a primitive wears."""
        for mapping in primitive.get("extensions", {}).get(VARIANTS, {}).get("mappings", []):
            if self._variant in mapping["variants"]:
                return mapping["material"]
        return primitive.get("material")

    def read(self, index: int | None) -> tuple[Material, list[int]]:
        """(material, numbers of the sets of texture coordinates that its textures read)."""
        if index not in self._materials:
            self._materials[index] = self._place(index), self._sets(index)
            self.sets_read[index] = self._sets(index)
        return self._materials[index]

    def apply_uv_transforms(self, meshes: list[Mesh], keep_layout: bool = False) -> list[Mesh]:
        """The meshes as their textures read them; see ``uv_unification.apply_all``."""
        return uv_unification.apply_all(
            meshes, self._transforms, self.note, self._tiles, keep_layout
        )

    def _place(self, index: int | None, tile: Tile | None = None) -> Material:
        """A material, of one tile of its textures if it has some in tiles; where they read is
        remembered."""
        infos = self._texture_infos(index)
        self._tile = tile
        material = Material() if index is None else self._read_material(index)
        self._tile = None
        sets = self._sets(index)
        self._transforms[id(material)] = {
            n: uv_transforms.UvTransform(
                uv_transforms.affine(_transform(info)), sets.index(_coordinates(info))
            )
            for n, info in infos.items()
        }
        if tile is None and any(self._tiled_name(info) for info in infos.values()):
            self._tiles[id(material)] = partial(self._place, index)
        return material

    def _sets(self, index: int | None) -> list[int]:
        """Numbers of the sets of texture coordinates that the textures of a material read."""
        return list(
            dict.fromkeys(_coordinates(i) for i in self._texture_infos(index).values())
        ) or [0]

    def _tiled_name(self, info: dict[str, Any]) -> str | None:
        """The name of a texture in tiles, which glTF does not have, but some files."""
        source = _source(self.document.items("textures")[info["index"]])
        uri = "" if source is None else str(self.document.items("images")[source].get("uri", ""))
        return uri if not uri.startswith("data:") and udim.is_tiled(uri) else None

    def _texture_infos(self, index: int | None) -> dict[str, dict[str, Any]]:
        """What a material says of its textures, by the name of ours."""
        return (
            {} if index is None else self._texture_infos_of(self.document.items("materials")[index])
        )

    def _texture_infos_of(self, m: dict[str, Any]) -> dict[str, dict[str, Any]]:
        extensions = m.get("extensions", {})
        pbr, specular = m.get("pbrMetallicRoughness", {}), extensions.get(SPECULAR)
        color, orm = pbr.get("baseColorTexture"), pbr.get("metallicRoughnessTexture")
        if specular is not None:  # both are made of both of its textures
            color = orm = specular.get("diffuseTexture", specular.get("specularGlossinessTexture"))
        infos = {
            "base_color_texture": color,
            "orm_texture": orm,
            "normal_texture": m.get("normalTexture"),
            "emission_texture": m.get("emissiveTexture"),
            "transmission_texture": extensions.get(TRANSMISSION, {}).get("transmissionTexture"),
            "thickness_texture": extensions.get(VOLUME, {}).get("thicknessTexture"),
        }
        return {name: info for name, info in infos.items() if info is not None}

    def _read_material(self, index: int) -> Material:
        m = self.document.items("materials")[index]
        name = m.get("name", f"material{index}")
        if UNLIT in m.get("extensions", {}):
            return self._unlit(m, name)
        specular = m.get("extensions", {}).get(SPECULAR)
        if specular is None:
            material = self._metallic(m.get("pbrMetallicRoughness", {}), name)
        else:
            material = self._converted(specular, name)
        mode = _alpha_mode(m)
        material = self._transmissive(material, m.get("extensions", {}), name)
        if "occlusionTexture" in m:
            material = self._occluded(
                material, m, name, mode != "opaque" or material.transmission > 0
            )
        normal = m.get("normalTexture")
        emission, emission_texture = self._emission(m, name)
        return replace(
            material,
            normal_scale=float(normal.get("scale", 1.0)) if normal else 1.0,
            normal_texture=self._texture(normal, "linear", name),
            alpha_mode=mode,
            alpha_cutoff=float(m.get("alphaCutoff", 0.5)),
            double_sided=bool(m.get("doubleSided", False)),
            emission=emission,
            emission_texture=emission_texture,
        )

    def _unlit(self, m: dict[str, Any], name: str) -> Material:
        """A material of which nothing but its base colour and alpha counts
        (KHR_materials_unlit)."""
        pbr = {
            k: v for k, v in m.get("pbrMetallicRoughness", {}).items() if k.startswith("baseColor")
        }
        return replace(
            self._metallic(pbr, name),
            metalness=0.0,
            alpha_mode=_alpha_mode(m),
            alpha_cutoff=float(m.get("alphaCutoff", 0.5)),
            double_sided=bool(m.get("doubleSided", False)),
            unlit=True,
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

    def _transmissive(self, material: Material, extensions: dict[str, Any], name: str) -> Material:
        """The material with what its extensions say of light that passes through it."""
        share = float(extensions.get(TRANSMISSION, {}).get("transmissionFactor", 0.0))
        if share == 0:
            return material
        inside = extensions.get(VOLUME)
        volume = thickness = None
        if inside is not None:
            red, green, blue = (float(x) for x in inside.get("attenuationColor", (1, 1, 1)))
            distance = float(inside.get("attenuationDistance", "inf"))
            volume = Volume(float(inside.get("thicknessFactor", 0.0)), distance, (red, green, blue))
            thickness = self._texture(inside.get("thicknessTexture"), "linear", name)
        return replace(
            material,
            transmission=share,
            transmission_texture=self._texture(
                extensions[TRANSMISSION].get("transmissionTexture"), "linear", name
            ),
            ior=float(extensions.get(IOR, {}).get("ior", 1.5)),
            volume=volume,
            thickness_texture=thickness,
        )

    def _occluded(self, material: Material, m: dict[str, Any], name: str, kept: bool) -> Material:
        """The material with its occlusion in the red channel, if it may pass into a result as it is
        (``kept``)."""
        if not kept:
            self.note("occlusion ignored (it is not part of the appearance under a moving light)")
            return material
        info, orm = (
            m["occlusionTexture"],
            m.get("pbrMetallicRoughness", {}).get("metallicRoughnessTexture"),
        )
        if orm is not None and info["index"] == orm["index"]:
            return replace(material, has_occlusion=True)
        others = self._texture_infos_of(m)
        if any(_place(info) != _place(other) for other in others.values()):
            self.note(
                f"material '{name}': its occlusion lies elsewhere than its other textures: ignored"
            )
            return material
        occlusion = self._texture(info, "linear", name)
        if occlusion is None:
            return material
        return replace(
            material,
            orm_texture=with_occlusion(material.orm_texture, occlusion),
            has_occlusion=True,
        )

    def _emission(
        self, m: dict[str, Any], name: str
    ) -> tuple[tuple[float, float, float], Texture | None]:
        """(factor, texture) of what a material emits: nothing if the texture that says where is
        missing."""
        strength = float(m.get("extensions", {}).get(STRENGTH, {}).get("emissiveStrength", 1.0))
        red, green, blue = (strength * float(x) for x in m.get("emissiveFactor", (0, 0, 0)))
        if not any((red, green, blue)):
            return (0.0, 0.0, 0.0), None
        texture = self._texture(m.get("emissiveTexture"), "srgb", name)
        if texture is None and "emissiveTexture" in m:
            return (0.0, 0.0, 0.0), None
        return (red, green, blue), texture

    def _converted(self, given: dict[str, Any], name: str) -> Material:
        """A specular-glossiness material as a metallic-roughness one."""
        self.note("specular-glossiness materials converted to metallic-roughness")
        infos = [given[k] for k in ("diffuseTexture", "specularGlossinessTexture") if k in given]
        if len({str((i.get("texCoord"), i.get("extensions"))) for i in infos}) > 1:
            self.note(
                f"material '{name}': its textures differ in transform: the first one's is used for all"
            )
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
        return Material(
            name, (1, 1, 1), 1.0, 1.0, base_color_texture=base, orm_texture=orm, opacity=diffuse[3]
        )

    def _texture(self, info: dict[str, Any] | None, space: str, material: str) -> Texture | None:
        if info is None:
            return None
        texture = self.document.items("textures")[info["index"]]
        source, companions = _source(texture), self.document.companions
        name = self._tiled_name(info)
        if source is None:
            where = f"{self.path}: a texture of material '{material}'"
            pixels = companions.read(
                partial(_refuse, f"{where} has no image in a supported format")
            )
        elif name is not None:
            pixels = self._read_tile(name)
        else:
            if source not in self._images:
                self._images[source] = companions.read(partial(self._image, source, material))
            pixels = self._images[source]
        sampler = (
            self.document.items("samplers")[texture["sampler"]] if "sampler" in texture else {}
        )
        wrap = (
            _WRAPS.get(sampler.get("wrapS", 0), "repeat"),
            _WRAPS.get(sampler.get("wrapT", 0), "repeat"),
        )
        if pixels is None:
            return None
        read = Texture(images.to_color(pixels), space, wrap)  # type: ignore[arg-type]
        if name is None and source is not None:
            return self._read_textures.setdefault((source, space, wrap), read)
        if name is None or self._tile is None:
            return read
        return udim.fit_to_tile(read, self._tile, self.document.companions)

    def _read_tile(self, name: str) -> NDArray | None:
        companions = self.document.companions
        if self._tile is None:
            return None
        return udim.read_tile(
            name,
            self._tile,
            self.path,
            companions,
            lambda file: companions.picture(companions.find(file, self.path)),
        )

    def _image(self, index: int, material: str) -> NDArray:
        image = self.document.items("images")[index]
        if "bufferView" in image:
            data = bytes(self.document.buffer_view(image["bufferView"])[0])
        else:
            data = self.document.uri(image["uri"])
        return self.document.companions.decoded(
            data, f"{self.path}, image {image.get('name') or index} of material '{material}'"
        )


def _refuse(reason: str) -> NDArray:
    raise InputError(reason)


def _alpha_mode(m: dict[str, Any]) -> AlphaMode:
    modes: dict[str, AlphaMode] = {"MASK": "mask", "BLEND": "blend"}
    return modes.get(m.get("alphaMode", "OPAQUE"), "opaque")


def _source(texture: dict[str, Any]) -> int | None:
    """The image of a texture: the plain one, if there is one, beside those that extensions name."""
    others = (e.get("source") for n, e in texture.get("extensions", {}).items() if n in _IMAGES)
    return texture.get("source", next((s for s in others if s is not None), None))


def _transform(info: dict[str, Any]) -> dict[str, Any] | None:
    return info.get("extensions", {}).get("KHR_texture_transform")


def _coordinates(info: dict[str, Any]) -> int:
    """Number of the set of texture coordinates that a texture reads."""
    return (_transform(info) or {}).get("texCoord", info.get("texCoord", 0))


def _quote(names: list[str]) -> str:
    return ", ".join(f"'{n}'" for n in names)


def _place(info: dict[str, Any]) -> tuple[int, str]:
    """Which texture coordinates a texture uses, and where it lies in them."""
    return _coordinates(info), str(sorted((_transform(info) or {}).items()))
