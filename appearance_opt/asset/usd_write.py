"""An Asset to USD: meshes with UsdPreviewSurface materials."""

from __future__ import annotations

import errno
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.alpha import coverage, kind_of
from appearance_opt.asset.encoding import encoded_for
from appearance_opt.asset.file_options import PLAIN
from appearance_opt.asset.height import as_16_bit, height_png
from appearance_opt.asset.hierarchy import in_coordinates
from appearance_opt.asset.origin import ZERO
from appearance_opt.asset.paths import MAX_NAME
from appearance_opt.asset.rows import unique_rows
from appearance_opt.asset.sides import apart_from_sides
from appearance_opt.asset.texture_files import Slot, TextureFile, encode, encode_pixels
from appearance_opt.asset.usd_nodes import COPYRIGHT, write_nodes
from appearance_opt.asset.usd_rig_write import RigWriter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.file_options import FileOptions
    from appearance_opt.asset.types import Asset, ColorSpace, Material, Mesh, Texture

_SPACES: dict[ColorSpace, str] = {"srgb": "sRGB", "linear": "raw"}
"""UsdUVTexture's names of our colour spaces."""

SIBLINGS = 500
"""Meshes that lie below one prim."""


LOD = "LOD"
"""Variant set of the levels of detail, whose variants are LOD0 (the finest), LOD1, ..."""


def save_usd(
    asset: Asset, path: Path, options: FileOptions = PLAIN, coarser: Sequence[Asset] = ()
) -> None:
    """Write .usd, .usda or .usdc with PNG or JPEG files in ``<stem>_textures/``, or one .usdz package. Y
    up, metres. Vertex colours, times the base colour, are read by the surface where it has no
    texture of that; a UsdPreviewSurface cannot multiply the two. What light passes through becomes
    opacity: of ``alpha.coverage``. With ``coarser`` levels, each is a variant of the default prim;
    they share its materials. Raises OSError when the disk refuses."""
    from pxr import Sdf, Tf, UsdUtils

    path = Path(path)
    package = path.suffix.lower() == ".usdz"
    folder = Path(tempfile.mkdtemp(dir=path.parent)) if package else path.parent
    try:
        root = folder / (path.stem + (".usdc" if package else path.suffix))
        _write_stage((asset, *coarser), root, f"{path.stem}_textures", options)
        if package and not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(root)), str(path)):
            raise OSError(errno.EIO, "the USDZ package could not be written", str(path))
    except Tf.ErrorException as error:  # USD has its own exceptions for what the system reports
        reason = "the USD file could not be written; is the disk full?"
        raise OSError(errno.EIO, reason, str(path)) from error
    finally:
        if package:
            shutil.rmtree(folder, ignore_errors=True)


def _write_stage(levels: Sequence[Asset], root: Path, textures: str, options: FileOptions) -> None:
    from pxr import Kind, Tf, Usd, UsdGeom, UsdSkel

    asset = levels[0]
    stage = Usd.Stage.CreateNew(str(root))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    roots = [n.name for n in asset.nodes if n.parent is None]
    hung = asset.rig is None and all(m.node is not None for m in asset.meshes)
    name = Tf.MakeValidIdentifier(roots[0] if len(roots) == 1 and hung else asset.name)
    kind = UsdGeom.Xform if asset.rig is None else UsdSkel.Root
    top = kind.Define(stage, f"/{name}")
    stage.SetDefaultPrim(top.GetPrim())
    Usd.ModelAPI(top.GetPrim()).SetKind(Kind.Tokens.component)
    said = {COPYRIGHT: asset.credits.copyright, "lighting": asset.credits.lighting}
    if any(said.values()):
        stage.GetRootLayer().customLayerData = {k: v for k, v in said.items() if v}
    UsdGeom.Scope.Define(stage, f"/{name}/Materials")
    materials = _Materials(stage, f"/{name}/Materials", root.parent / textures, options)
    for level in levels:  # outside of the variants, so that all of them share one texture set
        for mesh in level.meshes:
            materials.of(mesh)
    if len(levels) == 1:
        _fill(stage, top, asset, materials)
    else:
        variants = top.GetPrim().GetVariantSets().AddVariantSet(LOD)
        for k, level in enumerate(levels):
            variants.AddVariant(f"{LOD}{k}")
            variants.SetVariantSelection(f"{LOD}{k}")
            with variants.GetVariantEditContext():
                _fill(stage, top, level, materials)
        variants.SetVariantSelection(f"{LOD}0")
    stage.GetRootLayer().Save()


def _fill(stage: Any, top: Any, asset: Asset, materials: _Materials) -> None:
    """Nodes and meshes of an asset below the prim ``top``."""
    from pxr import Gf, Tf, UsdGeom

    name = str(top.GetPath())
    hung = asset.rig is None and all(m.node is not None for m in asset.meshes)
    paths, world = write_nodes(stage, name, asset)
    if any(asset.origin) and not paths:
        top.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*asset.origin))
    rig = None if asset.rig is None else RigWriter(stage, name, asset, asset.rig)
    loose = name
    if paths and any(asset.origin) and not hung:
        loose = f"{name}/Beside"
        beside = UsdGeom.Xform.Define(stage, loose)
        beside.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*asset.origin))
    for k, mesh in enumerate(asset.meshes):
        if mesh.node is not None and paths:
            parent = paths[mesh.node]
            (shown,), offset = in_coordinates([mesh], world[mesh.node], asset.origin)
        else:
            shown, offset = mesh, ZERO
            parent = _parent(stage, loose, k, len(asset.meshes))
        target = f"{parent}/G{k}_{Tf.MakeValidIdentifier(mesh.name)}"
        _mesh(stage, target, shown, materials.of(mesh), rig)
        if any(offset):
            shape = UsdGeom.Xformable.Get(stage, target)
            shape.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*offset))


class _Materials:
    """The materials of a stage below the prim ``scope``, each written when it is first asked for;
    their textures go to ``folder``."""

    def __init__(self, stage: Any, scope: str, folder: Path, options: FileOptions) -> None:
        self._stage, self._scope, self._folder, self._options = stage, scope, folder, options
        self._written: dict[tuple[tuple, bool, bool], Any] = {}

    def of(self, mesh: Mesh) -> Any:
        """What a mesh is bound to."""
        from pxr import Tf

        key = (apart_from_sides(mesh.material), _colored(mesh), _veiled(mesh))
        if key not in self._written:
            word = Tf.MakeValidIdentifier(mesh.material.name)[:MAX_NAME]
            target = f"{self._scope}/M{len(self._written)}_{word}"
            preview = _Preview(self._stage, target, self._folder, self._options)
            self._written[key] = _material(preview, mesh.material, key[1], key[2])
        return self._written[key]


def _parent(stage: Any, top: str, number: int, count: int) -> str:
    """The prim below which a mesh goes: the top, or a group, for what has many siblings takes long
    to add."""
    from pxr import UsdGeom

    if count <= SIBLINGS:
        return top
    group = f"{top}/Group{number // SIBLINGS}"
    UsdGeom.Scope.Define(stage, group)
    return group


def _colored(mesh: Mesh) -> bool:
    """Do vertex colours drive the base colour?"""
    return mesh.colors is not None and mesh.material.base_color_texture is None


def _veiled(mesh: Mesh) -> bool:
    """Does the alpha of vertex colours drive the opacity?"""
    if mesh.colors is None or mesh.colors.shape[1] < 4 or mesh.material.alpha_mode == "opaque":
        return False
    return coverage(mesh.material)[1] is None


def _mesh(stage: Any, target: str, mesh: Mesh, material: Any, rig: RigWriter | None) -> None:
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    out = UsdGeom.Mesh.Define(stage, target)
    out.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    positions = np.ascontiguousarray(mesh.positions, np.float32)
    # vertices in one place are one point: editors take edges between points that are apart for a
    # rim
    kinds_of_points = [positions]
    if mesh.skin is not None:
        kinds_of_points += [mesh.skin.bones.astype(np.float32), mesh.skin.weights]
    first, place = _distinct(np.concatenate(kinds_of_points, axis=1))
    points, corners = positions[first], place[mesh.faces.ravel()].astype(np.int32)
    out.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    out.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    out.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners))
    out.CreateExtentAttr(
        Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)]))
    )
    out.CreateDoubleSidedAttr(mesh.material.double_sided)
    kinds = Sdf.ValueTypeNames
    if mesh.normals is not None:
        _add_primvar(out, "normals", kinds.Normal3fArray, mesh.normals, mesh.faces)
    if mesh.uvs is not None:
        st = np.stack([mesh.uvs[:, 0], 1 - mesh.uvs[:, 1]], axis=1)
        _add_primvar(out, "st", kinds.TexCoord2fArray, st, mesh.faces)
    if mesh.colors is not None:
        factor = mesh.material.base_color if _colored(mesh) else (1.0, 1.0, 1.0)
        color = mesh.colors[:, :3] * np.array(factor, np.float32)
        _add_primvar(out, "displayColor", kinds.Color3fArray, color, mesh.faces)
    if _veiled(mesh):
        assert mesh.colors is not None
        alpha = mesh.colors[:, 3:] * np.float32(coverage(mesh.material)[0])
        _add_primvar(out, "displayOpacity", kinds.FloatArray, alpha, mesh.faces)
    UsdShade.MaterialBindingAPI.Apply(out.GetPrim()).Bind(material)
    if rig is not None and mesh.skin is not None:
        rig.bind(out, mesh.skin, first)


def _add_primvar(out: Any, name: str, kind: Any, values: NDArray, faces: NDArray) -> None:
    """Add a face-varying primvar to a mesh, with indices where that is smaller. ``values`` (V, K)
    of the vertices."""
    from pxr import UsdGeom, Vt

    values = np.ascontiguousarray(values, np.float32)
    width = values.shape[1]
    array = (Vt.FloatArray, Vt.Vec2fArray, Vt.Vec3fArray)[width - 1]
    chosen, index = _distinct(values)
    primvar = UsdGeom.PrimvarsAPI(out).CreatePrimvar(name, kind, UsdGeom.Tokens.faceVarying)
    if len(chosen) * width + faces.size < faces.size * width:
        primvar.SetIndices(Vt.IntArray.FromNumpy(index[faces.ravel()].astype(np.int32)))
        stored = values[chosen]
    else:
        stored = values[faces.ravel()]
    primvar.Set(array.FromNumpy(stored if width > 1 else stored.ravel()))


def _distinct(values: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """(first row of each kind, in the order of the rows; kind of each row) of (N, K) numbers; both
    zeros are one."""
    _, kind = unique_rows((values + np.float32(0)).view(np.uint32).astype(np.int64))
    first = np.full(kind.max(initial=-1) + 1, len(kind))
    np.minimum.at(first, kind, np.arange(len(kind)))
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[kind]


def _material(preview: _Preview, m: Material, colored: bool, veiled: bool) -> Any:
    material = preview.material
    material.CreateSurfaceOutput().ConnectToSource(preview.shader.ConnectableAPI(), "surface")
    shown = "diffuseColor"
    if m.unlit:
        preview.reflect_nothing()
        shown = "emissiveColor"
    else:
        if m.emits:
            preview.color("emissiveColor", "emission", m.emission, m.emission_texture)
        preview.roughness_and_metalness(m)
    if colored:
        preview.primvar(shown, "Color3f", "UsdPrimvarReader_float3", "displayColor")
    else:
        preview.color(shown, "base_color", m.base_color, m.base_color_texture)
    preview.opacity(m, veiled)
    if m.normal_texture is not None and not m.unlit:
        s = m.normal_scale
        slot = Slot(m.normal_texture, "linear", "normal")
        node = preview.sampler("normal", slot, (2 * s, 2 * s, 2, 1), (-s, -s, -1, 0))
        preview.connect("normal", "Normal3f", node, "rgb")
    if m.displacement is not None:
        d = as_16_bit(m.displacement)
        scale, bias = (d.scale,) * 3 + (1,), (-d.mid * d.scale,) * 3 + (0,)
        slot = Slot(d.texture, "linear", "material")
        node = preview.sampler("displacement", slot, scale, bias, TextureFile(height_png(d), "png"))
        preview.connect("displacement", "Float", node, "r")
        material.CreateDisplacementOutput().ConnectToSource(
            preview.shader.ConnectableAPI(), "displacement"
        )
    return material


class _Preview:
    """A material of a UsdPreviewSurface and the samplers of its textures, which are written to
    ``folder``."""

    def __init__(self, stage: Any, target: str, folder: Path, options: FileOptions) -> None:
        from pxr import Sdf, UsdShade

        self.stage, self.target, self.folder, self.options = stage, target, folder, options
        self.types = Sdf.ValueTypeNames
        self.material = UsdShade.Material.Define(stage, target)
        self.shader = self._node("Surface", "UsdPreviewSurface")
        self.reader = self._node("st", "UsdPrimvarReader_float2")
        self.reader.CreateInput("varname", self.types.String).Set("st")

    def _node(self, name: str, kind: str) -> Any:
        from pxr import UsdShade

        node = UsdShade.Shader.Define(self.stage, f"{self.target}/{name}")
        node.CreateIdAttr(kind)
        return node

    def sampler(
        self,
        key: str,
        slot: Slot,
        scale: tuple[float, ...] | None = None,
        bias: tuple[float, ...] | None = None,
        encoded: TextureFile | None = None,
    ) -> Any:
        """A node that reads the texture of a slot, written as ``encoded`` if that is given."""
        from pxr import Gf, Sdf

        encoded = encoded or encode(slot, self.options.format_of(slot.kind))
        file = self.folder / f"{self.target.rsplit('/', 1)[1]}_{key}{encoded.suffix}"
        self.folder.mkdir(exist_ok=True)
        file.write_bytes(encoded.data)
        node = self._node(key, "UsdUVTexture")
        node.CreateInput("file", self.types.Asset).Set(
            Sdf.AssetPath(f"./{self.folder.name}/{file.name}")
        )
        node.CreateInput("sourceColorSpace", self.types.Token).Set(_SPACES[slot.space])
        node.CreateInput("st", self.types.Float2).ConnectToSource(
            self.reader.ConnectableAPI(), "result"
        )
        for axis, wrap in zip("ST", slot.texture.wrap, strict=True):
            node.CreateInput(f"wrap{axis}", self.types.Token).Set(wrap)
        for name, value in (("scale", scale), ("bias", bias)):
            if value is not None:
                node.CreateInput(name, self.types.Float4).Set(Gf.Vec4f(*value))
        return node

    def connect(self, name: str, kind: str, node: Any, output: str) -> None:
        """Let an input of the surface follow an output of a sampler."""
        source = self.shader.CreateInput(name, getattr(self.types, kind))
        source.ConnectToSource(node.ConnectableAPI(), output)

    def color(
        self, name: str, key: str, factor: tuple[float, float, float], texture: Texture | None
    ) -> None:
        """A colour: a constant, or a texture times a factor."""
        from pxr import Gf

        if texture is None:
            self.shader.CreateInput(name, self.types.Color3f).Set(Gf.Vec3f(*factor))
            return
        scale = None if tuple(factor) == (1.0, 1.0, 1.0) else (*factor, 1.0)
        slot = Slot(texture, "srgb", "color")
        self.connect(name, "Color3f", self.sampler(key, slot, scale), "rgb")

    def primvar(self, name: str, kind: str, node: str, primvar: str) -> None:
        """An input that is a primvar of the mesh."""
        reader = self._node(primvar, node)
        reader.CreateInput("varname", self.types.String).Set(primvar)
        self.connect(name, kind, reader, "result")

    def reflect_nothing(self) -> None:
        """Black in any light, but for a little at grazing angles: a UsdPreviewSurface reflects all
        light there."""
        from pxr import Gf

        self.shader.CreateInput("useSpecularWorkflow", self.types.Int).Set(1)
        for name in ("diffuseColor", "specularColor"):
            self.shader.CreateInput(name, self.types.Color3f).Set(Gf.Vec3f(0))
        self.shader.CreateInput("roughness", self.types.Float).Set(1.0)

    def roughness_and_metalness(self, m: Material) -> None:
        """Both, and occlusion, from one texture, or constants."""
        if m.orm_texture is None:
            self.shader.CreateInput("roughness", self.types.Float).Set(m.roughness)
            self.shader.CreateInput("metallic", self.types.Float).Set(m.metalness)
            return
        plain = (m.roughness, m.metalness) == (1.0, 1.0)
        slot = Slot(m.orm_texture, "linear", "material", not m.has_occlusion)
        node = self.sampler("orm", slot, None if plain else (1.0, m.roughness, m.metalness, 1.0))
        self.connect("roughness", "Float", node, "g")
        self.connect("metallic", "Float", node, "b")
        if m.has_occlusion:
            self.connect("occlusion", "Float", node, "r")

    def opacity(self, m: Material, veiled: bool) -> None:
        """Coverage by the mesh's displayOpacity (``veiled``), a constant or a texture, for the
        alpha test if there is one. A UsdPreviewSurface cannot multiply them."""
        factor, texture = coverage(m)
        if factor == 1 and texture is None and not veiled:
            return
        if veiled:
            self.primvar("opacity", "Float", "UsdPrimvarReader_float", "displayOpacity")
        elif texture is None:
            self.shader.CreateInput("opacity", self.types.Float).Set(factor)
        else:
            slot = Slot(texture, "linear", "material")
            pixels = encoded_for(texture, "linear", (factor,))
            encoded = encode_pixels(pixels, self.options.material, slot)
            self.connect("opacity", "Float", self.sampler("opacity", slot, encoded=encoded), "r")
        if kind_of(m) == "mask":
            self.shader.CreateInput("opacityThreshold", self.types.Float).Set(m.alpha_cutoff)
        else:  # its highlights are covered as the rest of it is, as in glTF
            self.shader.CreateInput("opacityMode", self.types.Token).Set("presence")
