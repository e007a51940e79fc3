"""An Asset to USD: meshes with UsdPreviewSurface materials."""

from __future__ import annotations

import errno
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset import images
from appearance_opt.asset.height import as_16_bit, height_png
from appearance_opt.asset.paths import replacing
from appearance_opt.asset.types import linear_to_srgb

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset, Material, Mesh, Texture


def save_usd(asset: Asset, path: Path) -> None:
    """Write .usd, .usda or .usdc with PNG files in ``<stem>_textures/``, or one .usdz package. Y up,
    metres. Raises OSError when the disk refuses."""
    from pxr import Sdf, Tf, UsdUtils

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    package = path.suffix.lower() == ".usdz"
    folder = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.stem}-"))
    try:
        root = folder / (path.stem + (".usdc" if package else path.suffix))
        _write_stage(asset, root, f"{path.stem}_textures")
        if package:
            with replacing(path) as temporary:
                if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(root)), str(temporary)):
                    raise OSError(errno.EIO, "the USDZ package could not be written", str(path))
            return
        textures = folder / f"{path.stem}_textures"
        if textures.exists():
            target = path.parent / textures.name
            target.mkdir(exist_ok=True)
            for file in textures.iterdir():
                file.replace(target / file.name)
        root.replace(path)
    except Tf.ErrorException as error:  # USD has its own exceptions for what the system reports
        reason = "the USD file could not be written; is the disk full?"
        raise OSError(errno.EIO, reason, str(path)) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _write_stage(asset: Asset, root: Path, textures: str) -> None:
    from pxr import Kind, Tf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(root))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    name = Tf.MakeValidIdentifier(asset.name)
    top = UsdGeom.Xform.Define(stage, f"/{name}")
    stage.SetDefaultPrim(top.GetPrim())
    Usd.ModelAPI(top.GetPrim()).SetKind(Kind.Tokens.component)
    UsdGeom.Scope.Define(stage, f"/{name}/Materials")
    materials: dict[int, Any] = {}
    for k, mesh in enumerate(asset.meshes):
        if id(mesh.material) not in materials:
            target = f"/{name}/Materials/M{len(materials)}_{Tf.MakeValidIdentifier(mesh.material.name)}"
            materials[id(mesh.material)] = _material(stage, target, mesh.material, root.parent / textures)
        _mesh(stage, f"/{name}/G{k}_{Tf.MakeValidIdentifier(mesh.name)}", mesh, materials[id(mesh.material)])
    stage.GetRootLayer().Save()


def _mesh(stage: Any, target: str, mesh: Mesh, material: Any) -> None:
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    out = UsdGeom.Mesh.Define(stage, target)
    out.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    out.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.positions, np.float32)))
    out.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    out.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces, np.int32).ravel()))
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    out.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([low, high]).astype(np.float32)))
    out.CreateDoubleSidedAttr(mesh.material.double_sided)
    if mesh.normals is not None:
        out.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.normals, np.float32)))
        out.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    api = UsdGeom.PrimvarsAPI(out)
    if mesh.uvs is not None:
        st = api.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
        uvs = np.stack([mesh.uvs[:, 0], 1 - mesh.uvs[:, 1]], axis=1)
        st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(uvs, np.float32)))
    if mesh.colors is not None:
        color = api.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex)
        color.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.colors, np.float32)))
    UsdShade.MaterialBindingAPI.Apply(out.GetPrim()).Bind(material)


def _material(stage: Any, target: str, m: Material, folder: Path) -> Any:
    from pxr import Gf, Sdf, UsdShade

    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, target)
    shader = UsdShade.Shader.Define(stage, f"{target}/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    reader = UsdShade.Shader.Define(stage, f"{target}/st")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    stem = target.rsplit("/", 1)[1]

    def sampler(key: str, texture: Texture, space: str, data: bytes | None = None) -> Any:
        file = folder / f"{stem}_{key}.png"
        folder.mkdir(exist_ok=True)
        file.write_bytes(images.encode_png(_stored(texture)) if data is None else data)
        node = UsdShade.Shader.Define(stage, f"{target}/{key}")
        node.CreateIdAttr("UsdUVTexture")
        node.CreateInput("file", types.Asset).Set(Sdf.AssetPath(f"./{folder.name}/{file.name}"))
        node.CreateInput("sourceColorSpace", types.Token).Set(space)
        node.CreateInput("st", types.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        for axis, wrap in zip("ST", texture.wrap, strict=True):
            node.CreateInput(f"wrap{axis}", types.Token).Set(wrap)
        return node

    color = shader.CreateInput("diffuseColor", types.Color3f)
    if m.base_color_texture is not None:
        node = sampler("base_color", m.base_color_texture, "sRGB")
        if tuple(m.base_color) != (1.0, 1.0, 1.0):
            node.CreateInput("scale", types.Float4).Set(Gf.Vec4f(*m.base_color, 1.0))
        color.ConnectToSource(node.ConnectableAPI(), "rgb")
    else:
        color.Set(Gf.Vec3f(*m.base_color))
    if m.emits:
        glow = shader.CreateInput("emissiveColor", types.Color3f)
        if m.emission_texture is None:
            glow.Set(Gf.Vec3f(*m.emission))
        else:
            node = sampler("emission", m.emission_texture, "sRGB")
            node.CreateInput("scale", types.Float4).Set(Gf.Vec4f(*m.emission, 1.0))
            glow.ConnectToSource(node.ConnectableAPI(), "rgb")
    roughness, metallic = (shader.CreateInput(k, types.Float) for k in ("roughness", "metallic"))
    if m.orm_texture is not None:
        node = sampler("orm", m.orm_texture, "raw")
        if (m.roughness, m.metalness) != (1.0, 1.0):
            node.CreateInput("scale", types.Float4).Set(Gf.Vec4f(1.0, m.roughness, m.metalness, 1.0))
        roughness.ConnectToSource(node.ConnectableAPI(), "g")
        metallic.ConnectToSource(node.ConnectableAPI(), "b")
        if m.has_occlusion:
            shader.CreateInput("occlusion", types.Float).ConnectToSource(node.ConnectableAPI(), "r")
    else:
        roughness.Set(m.roughness)
        metallic.Set(m.metalness)
    if m.normal_texture is not None:
        node = sampler("normal", m.normal_texture, "raw")
        node.CreateInput("scale", types.Float4).Set(Gf.Vec4f(2 * m.normal_scale, 2 * m.normal_scale, 2, 1))
        node.CreateInput("bias", types.Float4).Set(Gf.Vec4f(-m.normal_scale, -m.normal_scale, -1, 0))
        shader.CreateInput("normal", types.Normal3f).ConnectToSource(node.ConnectableAPI(), "rgb")
    if m.displacement is not None:
        d = as_16_bit(m.displacement)
        scale, mid = d.scale, d.mid
        node = sampler("displacement", d.texture, "raw", height_png(d))
        node.CreateInput("scale", types.Float4).Set(Gf.Vec4f(scale, scale, scale, 1))
        node.CreateInput("bias", types.Float4).Set(Gf.Vec4f(-mid * scale, -mid * scale, -mid * scale, 0))
        shader.CreateInput("displacement", types.Float).ConnectToSource(node.ConnectableAPI(), "r")
        material.CreateDisplacementOutput().ConnectToSource(shader.ConnectableAPI(), "displacement")
    return material


def _stored(texture: Texture) -> NDArray:
    """8- or 16-bit pixels of a texture."""
    if texture.pixels.dtype in (np.uint8, np.uint16):
        return texture.pixels
    value = np.clip(texture.pixels.astype(np.float32), 0, 1)
    if texture.color_space == "srgb":
        value[..., :3] = linear_to_srgb(value[..., :3])
    return (value * 255 + 0.5).astype(np.uint8)
