"""USD materials: UsdPreviewSurface networks, and MaterialX standard_surface files."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset import images, specular_glossiness, udim, uv_transforms, uv_unification
from appearance_opt.asset.materialx import SURFACES, read_surface
from appearance_opt.asset.materialx_file import find_surface
from appearance_opt.asset.packing import pack_orm, with_alpha
from appearance_opt.asset.paths import check_inside
from appearance_opt.asset.specular_glossiness import Specular
from appearance_opt.asset.types import Material, Mesh, Texture
from appearance_opt.asset.usd_networks import UsdNode
from appearance_opt.asset.usd_package import read_packaged
from appearance_opt.asset.uv_transforms import Place

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

    from appearance_opt.asset.companions import Companions
    from appearance_opt.asset.udim import Tile

_WRAPS = {"repeat": "repeat", "clamp": "clamp", "mirror": "mirror", "black": "clamp"}
_PURPOSES = ("full", "preview", "")
"""Purposes of bindings in the order in which they are taken; the last is that for all."""
MAX_TRANSFORMS = 16
"""Transforms in a row before a texture's coordinates: networks may have cycles."""
_REFLECTANCES = ("diffuseColor", "specularColor")
_CHANNEL = {"r": 0, "g": 1, "b": 2, "a": 3}


class MaterialReader:
    """Materials of a stage, each read once."""

    def __init__(self, stage: Any, path: Path, companions: Companions) -> None:
        self.stage, self.path, self.companions, self.note = stage, path, companions, companions.note
        self._materials: dict[str, Material] = {}
        self.transforms: dict[int, dict[str, uv_transforms.UvTransform]] = {}
        self._sets: dict[
            int, tuple[str, ...]
        ] = {}  # by id of a material, the primvars that its textures read
        self.tiles: dict[int, Callable[[Tile], Material]] = {}
        # while a material is read: the tile of its textures that is asked for, and whether it has
        # any in tiles
        self._tile: Tile | None = None
        self._in_tiles = False
        self._pixels: dict[str, NDArray] = {}
        self._worn: dict[tuple[int, bool, bool], Material] = {}

    def bindings(
        self, prim: Any, face_ids: NDArray, covers_in_part: bool = False
    ) -> Iterator[tuple[Material, list[str], NDArray[np.bool_]]]:
        """(material, primvars of the texture coordinates that it reads, mask of the triangles that
        wear it); ``face_ids``: face of the file of each triangle. ``covers_in_part``: does the
        mesh's displayOpacity say so?"""
        from pxr import UsdGeom

        double = bool(UsdGeom.Gprim(prim).GetDoubleSidedAttr().Get())
        rest = np.ones(len(face_ids), bool)
        for subset in self._subsets(prim):
            faces = np.array(UsdGeom.Subset(subset).GetIndicesAttr().Get() or [], np.int64)
            mask = np.isin(face_ids, faces) & rest
            rest &= ~mask
            material = self._on_mesh(self._bound(subset), double, covers_in_part)
            yield material, self._uv_names(prim, subset), mask
        if rest.any():
            material = self._on_mesh(self._bound(prim), double, covers_in_part)
            yield material, self._uv_names(prim, prim), rest

    def uv_names(self, prim: Any) -> list[str]:
        """The primvars that hold texture coordinates of a mesh, of which each of its materials
        reads some."""
        subsets = self._subsets(prim)
        wearers = [*subsets, *([prim] if not subsets or self._bound_prim(prim) else [])]
        names = list(dict.fromkeys(name for w in wearers for name in self._uv_names(prim, w)))
        if len(names) > 1 and len(wearers) > 1:
            self.note(
                f"'{prim.GetPath()}': its materials read texture coordinates of their own ({', '.join(names)})"
            )
        return names

    def bound_keys(self, prim: Any) -> tuple[str, ...]:
        """What tells the materials of a mesh and its subsets from those of others."""
        wearers = (prim, *self._subsets(prim))
        bound = ((w, self._bound_prim(w)) for w in wearers)
        return tuple(
            _key(material) if material else self._unresolved(w) or "" for w, material in bound
        )

    def _subsets(self, prim: Any) -> list[Any]:
        from pxr import UsdShade

        return [s.GetPrim() for s in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()]

    def _uv_names(self, prim: Any, wearer: Any) -> list[str]:
        """The primvars that the material of ``wearer``, a mesh or a subset of it, reads, in the
        order of its sets; the usual one for each that the mesh does not have."""
        from pxr import UsdGeom

        api = UsdGeom.PrimvarsAPI(prim)
        usual = next((n for n in ("st", "UVMap", "map1", "uv") if api.HasPrimvar(n)), "st")
        read = self._sets.get(id(self._bound(wearer)), ())
        return [n if api.HasPrimvar(n) else usual for n in read] or [usual]

    def reads_primvar(self, prim: Any, name: str) -> bool:
        """Does displayColor or displayOpacity count? (No material, or one that reads it.)"""
        from pxr import UsdShade

        materials = [m for m in (self._bound_prim(w) for w in (prim, *self._subsets(prim))) if m]
        if not materials:
            return not self._unresolved(prim)
        readers = (UsdShade.Shader(n) for m in materials for n in _descendants(m.GetPrim()))
        return any(r and _reads_primvar(r, name) for r in readers)

    def _on_mesh(self, material: Material, double: bool, covers_in_part: bool) -> Material:
        """The material with what in USD the mesh says: are both sides of it seen, or one, and does
        it cover what lies behind it in part?"""
        key = (id(material), double, covers_in_part)
        if key not in self._worn:
            one = (
                material
                if material.double_sided == double
                else replace(material, double_sided=double)
            )
            if covers_in_part and one.alpha_mode == "opaque":
                one = replace(one, alpha_mode="blend")
            self._worn[key] = one
            self.transforms[id(one)] = dict(self.transforms.get(id(material), {}))
            if id(material) in self.tiles:
                self.tiles[id(one)] = partial(
                    self._tile_on_mesh, self.tiles[id(material)], double, covers_in_part
                )
        return self._worn[key]

    def _tile_on_mesh(
        self, read: Callable[[Tile], Material], double: bool, covers_in_part: bool, tile: Tile
    ) -> Material:
        return self._on_mesh(read(tile), double, covers_in_part)

    def _bound_prim(self, prim: Any) -> Any:
        """The material bound for the purpose "full", else for "preview", else for all.
        ``ComputeBoundMaterial`` goes on from each purpose to bindings for all of them."""
        from pxr import UsdShade

        api = UsdShade.MaterialBindingAPI(prim)
        for purpose in _PURPOSES:
            material, binding = api.ComputeBoundMaterial(purpose)
            if material and _purpose(binding) == purpose:
                return material
        return material

    def _unresolved(self, prim: Any) -> str | None:
        """Name of a bound material that does not exist on the stage."""
        from pxr import UsdShade

        api = UsdShade.MaterialBindingAPI(prim)
        targets: list[Any] = next(
            (t for p in _PURPOSES if (t := api.GetDirectBindingRel(p).GetTargets())), []
        )
        return targets[0].name if targets and not self.stage.GetPrimAtPath(targets[0]) else None

    def _bound(self, prim: Any) -> Material:
        material = self._bound_prim(prim)
        if material:
            return self._read_once(_key(material), partial(self._read, material))
        name = self._unresolved(prim)
        if name is not None:
            return self._read_once(name, partial(self._from_materialx, name))
        return self._materials.setdefault(
            "", Material(name="default", base_color=(1.0, 1.0, 1.0), roughness=0.5)
        )

    def _read_once(self, key: str, read: Callable[[], Material]) -> Material:
        if key not in self._materials:
            self._in_tiles = False
            self._materials[key] = read()
            if self._in_tiles:
                self.tiles[id(self._materials[key])] = partial(self._read_tile, read)
        return self._materials[key]

    def _read_tile(self, read: Callable[[], Material], tile: Tile) -> Material:
        read_before = dict(self._pixels)
        self._tile = tile
        try:
            return read()
        finally:
            self._tile, self._pixels = None, read_before

    def _from_materialx(self, name: str) -> Material:
        """A material that usd-core could not compose because it lives in a MaterialX file."""
        for layer in self.stage.GetUsedLayers():
            for dependency in layer.GetCompositionAssetDependencies():
                if not dependency.endswith(".mtlx") or not layer.realPath:
                    continue
                where = str(Path(layer.realPath).resolve().parent / dependency)
                instead = "default materials stand for its own"
                file = self.companions.read(
                    partial(self.companions.find, where, self.path), instead
                )
                if file is None:
                    continue
                surface = find_surface(
                    file, name, self.companions, partial(self._read_beside, file), self._fitted
                )
                found = None if surface is None else read_surface(surface, name, self.note)
                if found is not None:
                    self.note(f"material '{name}': read from {file.name}")
                    self._keep(*found)
                    return found[0]
        self.note(f"material '{name}': does not exist, the default material is used")
        return Material(name=name)

    def _read_beside(self, owner: Path, text: str) -> NDArray | None:
        """Pixels of a file that a document names, see ``_read_image``."""

        def read(name: str) -> NDArray:
            path = str(self.companions.find(name, owner))
            if path not in self._pixels:
                self._pixels[path] = self.companions.picture(Path(path))
            return self._pixels[path]

        if not udim.is_tiled(text):
            return self.companions.read(lambda: read(text))
        self._in_tiles = True
        return (
            None
            if self._tile is None
            else udim.read_tile(text, self._tile, owner, self.companions, read)
        )

    def _fitted(self, texture: Texture, text: str) -> Texture:
        if self._tile is None or not udim.is_tiled(text):
            return texture
        return udim.fit_to_tile(texture, self._tile, self.companions)

    def _read(self, material: Any) -> Material:
        name = str(material.GetPrim().GetName())
        shader = material.ComputeSurfaceSource()[0]
        if shader and str(shader.GetIdAttr().Get()) == "UsdPreviewSurface":
            return self._preview(shader, name)
        for other in (shader, material.ComputeSurfaceSource("mtlx")[0]):
            node = UsdNode(other, self._read_input, self._fitted_input) if other else None
            found = (
                read_surface(node, name, self.note)
                if node is not None and node.category in SURFACES
                else None
            )
            if found is not None:
                self._keep(*found)
                return found[0]
        self.note(f"material '{name}': {_what_it_has(material)}: default material used")
        return Material(name=name)

    def _read_input(self, source: Any) -> NDArray | None:
        text, there = _file(source)
        return self._read_image(text, there) if text else None

    def _fitted_input(self, texture: Texture, source: Any) -> Texture:
        return self._fitted(texture, _file(source)[0])

    def _preview(self, shader: Any, name: str) -> Material:
        of = partial(_input, shader)
        unlit = _reflects_nothing(shader)
        color, color_map, _ = (
            of("emissiveColor", (1.0, 1.0, 1.0))
            if unlit
            else of("diffuseColor", (0.18, 0.18, 0.18))
        )
        roughness, rough_map, rough_channel = of("roughness", 0.5)
        metalness, metal_map, metal_channel = of("metallic", 0.0)
        _, normal_map, _ = of("normal", None)
        glow, glow_map, _ = of("emissiveColor", (0.0, 0.0, 0.0))
        if unlit:
            roughness, rough_map, metalness, metal_map, normal_map = 1.0, None, 0.0, None, None
            glow, glow_map = (0.0, 0.0, 0.0), None
        base, base_factor = self._scaled(color_map, "srgb", "rgb", _rgb(color))
        rough, rough_factor = self._scaled(
            rough_map, "linear", rough_channel, (float(roughness),) * 3
        )
        if not unlit and int(of("useSpecularWorkflow", 0)[0]) == 1:
            tint, metal_map, _ = of("specularColor", (0.0, 0.0, 0.0))
            shine, shine_factor = self._scaled(metal_map, "srgb", "rgb", _rgb(tint))
            self.note(f"material '{name}': its specular workflow converted to metallic-roughness")
            given = Specular(base_factor, shine_factor, 1.0, base, shine)
            base, base_factor, metal, metal_factor = _metallic(given)
            color_map = metal_map = color_map or metal_map  # both are made of both of its textures
        else:
            metal, metal_factor = self._scaled(
                metal_map, "linear", metal_channel, (float(metalness),) * 3
            )
        # without the texture that says where it glows, nothing does
        emission, strength = self._scaled(
            glow_map, "srgb", "rgb", (0.0, 0.0, 0.0) if glow_map else _rgb(glow)
        )
        normal, normal_scale = self._normals(normal_map)
        opacity, alpha, alpha_map, threshold = self._opacity(shader)
        if alpha is not None:
            if base is not None and not _place(color_map).equals(_place(alpha_map)):
                self.note(
                    f"material '{name}': colour and opacity differ in transform: the first one's is used for both"
                )
            base, color_map = with_alpha(base, alpha), color_map if base is not None else alpha_map
        given = shader.GetInput("opacity")
        veiled = (
            bool(given) and given.HasConnectedSource() and alpha_map is None
        )  # by a primvar of the mesh
        transparent = alpha is not None or opacity < 1 or veiled
        out = Material(
            name=name,
            base_color=base_factor,
            roughness=rough_factor[0],
            metalness=metal_factor[0],
            normal_scale=normal_scale,
            base_color_texture=base,
            orm_texture=pack_orm(rough, metal) if rough or metal else None,
            normal_texture=normal,
            opacity=opacity,
            alpha_mode=("mask" if threshold > 0 else "blend") if transparent else "opaque",
            alpha_cutoff=threshold if threshold > 0 else 0.5,
            emission=strength,
            emission_texture=emission,
            unlit=unlit,
        )
        nodes = {
            "base_color_texture": color_map,
            "orm_texture": rough_map if rough else metal_map,
            "normal_texture": normal_map,
            "emission_texture": glow_map,
        }
        places = {n: _place(node) for n, node in nodes.items() if node}
        if rough and metal and not places["orm_texture"].equals(_place(metal_map)):
            self.note(
                f"material '{name}': roughness and metalness differ in transform: the first one's is used for both"
            )
        self._keep(out, places)
        return out

    def _keep(self, material: Material, places: Mapping[str, Place]) -> None:
        """Remember where the textures of a material read."""
        sets = tuple(dict.fromkeys(p.primvar for p in places.values()))
        self._sets[id(material)] = sets
        self.transforms[id(material)] = {
            n: uv_transforms.UvTransform(p.matrix, sets.index(p.primvar)) for n, p in places.items()
        }

    def _opacity(self, shader: Any) -> tuple[float, Texture | None, Any, float]:
        """(factor, texture of one channel or None, its node, threshold) of what a surface
        covers."""
        opacity, node, channel = _input(shader, "opacity", 1.0)
        threshold = float(_value(shader.GetInput("opacityThreshold")) or 0.0)
        texture, factor = self._scaled(node, "linear", channel, (float(opacity),) * 3)
        return factor[0], texture, node, threshold

    def apply_uv_transforms(self, meshes: list[Mesh], keep_layout: bool = False) -> list[Mesh]:
        """The meshes as their textures read them; see ``uv_unification.apply_all``."""
        return uv_unification.apply_all(meshes, self.transforms, self.note, self.tiles, keep_layout)

    def _scaled(
        self, node: Any, space: str, channel: str, constant: tuple[float, float, float]
    ) -> tuple[Texture | None, tuple[float, float, float]]:
        """(texture or None, its factor) of an input: ``constant`` without a texture. A bias cannot
        be a factor, and becomes part of the texture."""
        texture = self._texture(node, space, channel) if node else None
        if texture is None:
            return None, constant
        scale, bias = _vector(node, "scale", 1.0), _vector(node, "bias", 0.0)
        if channel in _CHANNEL:
            scale, bias = ((v[_CHANNEL[channel]],) * 3 for v in (scale, bias))
        if not any(bias[:3]):
            return texture, scale[:3]
        channels = texture.pixels.shape[2]
        values = texture.linear() * np.float32(scale[:channels]) + np.float32(bias[:channels])
        return Texture(values, "linear", texture.wrap), (1.0, 1.0, 1.0)

    def _normals(self, node: Any) -> tuple[Texture | None, float]:
        """(normal map stored as (n + 1) / 2, strength). Normals are texels times the sampler's
        scale plus its bias, usually 2 and -1; files that leave both out mean these."""
        texture = self._texture(node, "linear") if node else None
        if texture is None:
            return None, 1.0
        given = any(_value(node.GetInput(k)) is not None for k in ("scale", "bias"))
        scale = _vector(node, "scale", 1.0 if given else 2.0)[:3]
        bias = _vector(node, "bias", 0.0 if given else -1.0)[:3]
        strength = scale[0] / 2
        if strength > 0 and np.allclose(
            (scale, bias), ((2 * strength, 2 * strength, 2), (-strength, -strength, -1))
        ):
            return texture, strength
        normals = texture.linear()[..., :3] * np.float32(scale) + np.float32(bias)
        return Texture(normals * np.float32(0.5) + np.float32(0.5), "linear", texture.wrap), 1.0

    def _texture(self, node: Any, space: str, channel: str = "rgb") -> Texture | None:
        text, there = _file(node.GetInput("file"))
        if not text:  # a slot for a texture, without one
            return None
        pixels = self._read_image(text, there)
        if pixels is None:
            return None
        encoding = str(_value(node.GetInput("sourceColorSpace")) or "auto")
        if encoding == "raw":
            space = "linear"
        elif encoding == "sRGB":
            space = "srgb"
        elif pixels.dtype != np.uint8 or pixels.shape[2] < 3:
            space = "linear"  # "auto" takes 8-bit colours alone for sRGB
        pixels = images.to_color(pixels)
        if channel in _CHANNEL:
            if channel == "a":  # linear in any picture, and 1 in those without
                space = "linear"
                pixels = pixels if pixels.shape[2] == 4 else _opaque(pixels)
            pixels = pixels[..., _CHANNEL[channel]][..., None]
        wraps = tuple(
            _WRAPS.get(str(_value(node.GetInput(k))), "repeat") for k in ("wrapS", "wrapT")
        )
        texture = Texture(np.ascontiguousarray(pixels), space, wraps)  # type: ignore[arg-type]
        return self._fitted(texture, text)

    def _read_image(self, text: str, there: bool) -> NDArray | None:
        """Pixels of a file. None if it is missing and that is to be ignored, or if it is one in
        tiles and none is asked for. ``there``: is it known that some of its tiles exist?"""
        if not udim.is_tiled(text):
            return self.companions.read(lambda: self._image(text))
        self._in_tiles = True
        if self._tile is None:
            return None
        return udim.read_tile(text, self._tile, self.path, self.companions, self._image, there)

    def _image(self, text: str) -> NDArray:
        if text not in self._pixels:
            if "[" in text:  # inside a .usdz package
                check_inside(Path(text.split("[")[0]), self.path, text, self.companions.root)
                self._pixels[text] = self.companions.decoded(read_packaged(text, self.path), text)
            else:
                self._pixels[text] = self.companions.picture(self.companions.find(text, self.path))
        return self._pixels[text]


def _what_it_has(material: Any) -> str:
    """The surface of a material that is not read, by the names that its renderers know it by."""
    from pxr import UsdShade

    kinds = []
    for output in material.GetSurfaceOutputs():
        for attribute in UsdShade.Utils.GetValueProducingAttributes(output):
            shader = UsdShade.Shader(attribute.GetPrim())
            inside = (
                shader.GetPrim().GetAttribute(f"info:{k}:sourceAsset:subIdentifier")
                for k in ("mdl", "osl")
            )
            named = (a.Get() for a in inside if a)
            kinds.append(
                str(
                    shader.GetIdAttr().Get()
                    or next(named, None)
                    or attribute.GetPrim().GetTypeName()
                )
            )
    if not kinds:
        return "it has no surface shader"
    return f"its surface {', '.join(repr(k) for k in dict.fromkeys(kinds))} is not understood"


def _file(source: Any) -> tuple[str, bool]:
    """(name of the file that an input holds, as USD resolves it, or empty; does it stand for tiles
    that exist?)"""
    from pxr import UsdShade

    asset = _value(source)
    if asset is None or not (asset.resolvedPath or asset.path):
        return "", False
    if not UsdShade.UdimUtils.IsUdimIdentifier(asset.path):
        return asset.resolvedPath or asset.path, False
    given = UsdShade.Utils.GetValueProducingAttributes(source)[0].GetPropertyStack()
    resolved = UsdShade.UdimUtils.ResolveUdimPath(asset.path, given[0].layer) if given else ""
    return resolved or asset.path, bool(resolved)


def _purpose(binding: Any) -> str:
    """The purpose for which a relationship binds a material: "material:binding[:PURPOSE]", or, for
    a collection, "material:binding:collection[:PURPOSE]:NAME" (UsdShadeMaterialBindingAPI)."""
    words = binding.GetName().split(":")[2:]
    if words[:1] == ["collection"]:
        words = words[1:-1]
    return words[0] if words else ""


def _opaque(pixels: NDArray) -> NDArray:
    """Pixels (H, W, 3) with an alpha of 1."""
    one = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1
    return np.concatenate([pixels, np.full_like(pixels[..., :1], one)], axis=2)


def _key(material: Any) -> str:
    """The path of a material, the same for the copies of an instance."""
    prim = material.GetPrim()
    return str((prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath())


def _reflects_nothing(shader: Any) -> bool:
    """Does a UsdPreviewSurface emit light and reflect none? That is how one is shown in its colour
    whatever the light, for which USD has no other word."""
    values = [
        _input(shader, key, (0.18,) * 3 if key == "diffuseColor" else (0.0,) * 3)
        for key in _REFLECTANCES
    ]
    dark = all(node is None and not any(color) for color, node, _ in values)
    glow = shader.GetInput("emissiveColor")
    shown = bool(glow) and (glow.HasConnectedSource() or any(_value(glow) or ()))
    return dark and shown and _value(shader.GetInput("useSpecularWorkflow")) == 1


def _input(shader: Any, key: str, default: Any) -> tuple[Any, Any, str]:
    """(constant, texture shader or None, its output) of an input of a surface."""
    from pxr import UsdShade

    source = shader.GetInput(key)
    if source and source.HasConnectedSource():
        attributes = UsdShade.Utils.GetValueProducingAttributes(source)
        if (
            attributes
            and UsdShade.Utils.GetType(attributes[0].GetName()) == UsdShade.AttributeType.Output
        ):
            node = UsdShade.Shader(attributes[0].GetPrim())
            output = UsdShade.Output(attributes[0]).GetBaseName()
            if str(node.GetIdAttr().Get()) == "UsdUVTexture":
                return _constant(source, node, output, default), node, output
            # a primvar reader: the mesh's vertex colours take its place
            return ((1.0, 1.0, 1.0) if key == "diffuseColor" else default), None, ""
    value = _value(source)
    return (default if value is None else value), None, ""


def _metallic(
    given: Specular,
) -> tuple[Texture | None, tuple[float, float, float], Texture | None, tuple[float, float, float]]:
    """(base colour, its factor, metalness, its factor) of the specular workflow, whose two colours
    mean what those of glTF's specular-glossiness materials do."""
    if given.diffuse_texture is None and given.specular_texture is None:
        color, _, metalness = specular_glossiness.constants(given)
        return None, color, None, (metalness,) * 3
    base, orm = specular_glossiness.textures(given)
    metal = Texture(np.ascontiguousarray(orm.pixels[..., 2:3]), "linear", orm.wrap)
    return base, (1.0, 1.0, 1.0), metal, (1.0, 1.0, 1.0)


def _vector(node: Any, key: str, default: float) -> Any:
    """Four numbers of an input of a sampler: what a texture's values are multiplied by, or what is
    added."""
    value = _value(node.GetInput(key))
    return (default,) * 4 if value is None else tuple(float(x) for x in value)


def _place(node: Any) -> Place:
    """Where a sampler reads, after the transforms before it."""
    from pxr import UsdShade

    matrix = uv_transforms.affine(None)
    source = node.GetInput("st")
    for _ in range(MAX_TRANSFORMS):
        if not source:
            break
        attributes = UsdShade.Utils.GetValueProducingAttributes(source)
        if not attributes:
            break
        before = UsdShade.Shader(attributes[0].GetPrim())
        kind = str(before.GetIdAttr().Get() or "") if before else ""
        if kind.startswith("UsdPrimvarReader_float2"):
            return Place(str(_value(before.GetInput("varname")) or "st"), matrix)
        if kind != "UsdTransform2d":
            break
        scale, rotation, move = (
            _value(before.GetInput(k)) for k in ("scale", "rotation", "translation")
        )
        first = uv_transforms.usd_affine(
            (1.0, 1.0) if scale is None else tuple(scale),
            0.0 if rotation is None else float(rotation),
            (0.0, 0.0) if move is None else tuple(move),
        )
        matrix = uv_transforms.compose(matrix, first)
        source = before.GetInput("in")
    return Place(matrix=matrix)


def _rgb(value: Any) -> tuple[float, float, float]:
    r, g, b = (float(x) for x in value)
    return r, g, b


def _constant(source: Any, node: Any, output: str, default: Any) -> Any:
    """What an input is worth without its texture: its own value, or the texture's fallback."""
    value = source.Get()
    if value is not None:
        return value
    fallback = _value(node.GetInput("fallback"))
    if fallback is None:
        return default
    return fallback[_CHANNEL[output]] if output in _CHANNEL else tuple(fallback)[:3]


def _reads_primvar(shader: Any, name: str) -> bool:
    names = (str(_value(shader.GetInput(n))) for n in ("varname", "geomprop"))
    is_color = name == "displayColor" and str(shader.GetIdAttr().Get() or "").startswith(
        "ND_geomcolor"
    )
    return is_color or name in names


def _descendants(prim: Any) -> Any:
    from pxr import Usd

    return Usd.PrimRange(prim)


def _value(source: Any) -> Any:
    """Value of an input, through the interfaces of node graphs."""
    from pxr import UsdShade

    if not source:
        return None
    attributes = UsdShade.Utils.GetValueProducingAttributes(source)
    return attributes[0].Get() if attributes else None
