"""An Asset to Wavefront OBJ and MTL."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.alpha import coverage, kind_of
from appearance_opt.asset.encoding import encoded_for
from appearance_opt.asset.file_options import PLAIN
from appearance_opt.asset.mtl import ALPHA_TEST, UNLIT_MARK, WITHOUT_MAP
from appearance_opt.asset.paths import file_name
from appearance_opt.asset.sides import apart_from_sides
from appearance_opt.asset.texture_files import Slot, encode_pixels
from appearance_opt.asset.types import Texture, linear_to_srgb

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from appearance_opt.asset.file_options import FileOptions, MapKind
    from appearance_opt.asset.types import Asset, Material, Mesh


def save_obj(asset: Asset, path: Path, options: FileOptions = PLAIN) -> None:
    """Write OBJ, MTL (with the PBR extension: Pr, Pm, map_Pr, map_Pm, norm) and PNG or JPEG
    textures.

    Vertex colours follow the positions, sRGB encoded, as Blender and MeshLab write and read them;
    the format has no place for their alpha. What light passes through becomes alpha: of
    ``alpha.coverage``.
    """
    # the number keeps names apart that are equal, or become so
    look = {id(m.material): apart_from_sides(m.material) for m in asset.meshes}
    named = {
        look[id(m.material)]: f"{i}_{_word(m.material.name)}" for i, m in enumerate(asset.meshes)
    }
    mtl = ["# appearance-opt"]
    for key, m in {look[id(m.material)]: m.material for m in asset.meshes}.items():
        mtl += _mtl_lines(replace(m, name=named[key]), path, options)
    path.with_suffix(".mtl").write_text("\n".join(mtl) + "\n", encoding="utf-8")
    lines = ["# appearance-opt", f"mtllib {path.stem}.mtl"]
    if asset.credits.lighting:
        lines.insert(1, f"# lighting: {asset.credits.lighting}")
    if asset.credits.copyright:
        lines.insert(1, f"# copyright: {' '.join(asset.credits.copyright.split())}")
    start = np.ones(
        3, np.int64
    )  # of this mesh's positions, texture coordinates and normals in the whole file
    for mesh in asset.meshes:
        name = asset.nodes[mesh.node].name if asset.nodes and mesh.node is not None else mesh.name
        lines += [
            f"o {' '.join(name.split())}",
            f"usemtl {named[look[id(mesh.material)]]}",
            *_vertices(mesh, asset.origin),
        ]
        # vertices are split at seams: one index serves all that a mesh has
        has = (True, mesh.uvs is not None, mesh.normals is not None)
        form = {
            (True, False): "{0}/{1}",
            (False, True): "{0}//{2}",
            (True, True): "{0}/{1}/{2}",
        }.get(has[1:], "{0}")
        for face in mesh.faces.tolist():
            lines.append("f " + " ".join(form.format(*(start + i)) for i in face))
        start += np.where(has, len(mesh.positions), 0)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _vertices(mesh: Mesh, origin: tuple[float, float, float]) -> list[str]:
    """What faces refer to. Positions are those of the world: the format knows no other."""
    form = "{:.9g} {:.9g} {:.9g}"
    if any(origin):  # as many decimals as positions relative to the origin have
        decimals = 8 - int(np.floor(np.log10(max(float(np.abs(mesh.positions).max()), 1e-30))))
        form = " ".join([f"{{:.{max(decimals, 0)}f}}"] * 3)
    positions = mesh.positions.astype(np.float64) + origin
    lines = ["v " + form.format(*row) for row in positions.tolist()]
    if mesh.colors is not None:
        encoded = linear_to_srgb(np.clip(mesh.colors[:, :3], 0, 1)).tolist()
        lines = [
            f"{line} {r:.9g} {g:.9g} {b:.9g}"
            for line, (r, g, b) in zip(lines, encoded, strict=True)
        ]
    if mesh.uvs is not None:
        lines += [f"vt {u:.9g} {1 - v:.9g}" for u, v in mesh.uvs.tolist()]
    if mesh.normals is not None:
        lines += [f"vn {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.normals.tolist()]
    return lines


def _mtl_lines(m: Material, path: Path, options: FileOptions) -> list[str]:
    """The statements of a material, whose textures are written beside ``path``.

    Readers differ in whether Kd, Pr and Pm multiply their maps (the Wavefront convention) or stand
    back for them (Blender): the maps hold the factors, and the constants are 1. A comment keeps the
    factor alone, for when the map gets lost.
    """

    def picture(suffix: str, pixels: NDArray, kind: MapKind = "material") -> str:
        slot = Slot(Texture(pixels), "srgb" if kind == "color" else "linear", kind)
        file = encode_pixels(np.ascontiguousarray(pixels), options.format_of(kind), slot)
        target = path.with_name(f"{path.stem}_{file_name(m.name)}_{suffix}{file.suffix}")
        target.write_bytes(file.data)
        return target.name

    def plane(channel: int, factor: float) -> NDArray:
        assert m.orm_texture is not None
        one = Texture(m.orm_texture.linear()[..., channel : channel + 1], "linear")
        if m.orm_texture.color_space == "linear":
            one = replace(one, pixels=m.orm_texture.pixels[..., channel : channel + 1])
        return encoded_for(one, "linear", (factor,))

    def constant(key: str, values: tuple[float, ...], mapped: bool) -> list[str]:
        text = " ".join(f"{x:.6g}" for x in values)
        if not mapped or all(x == 1 for x in values):
            return [f"{key} {text}"]
        return [f"{key} {' '.join('1' for _ in values)}", f"{WITHOUT_MAP}{key} {text}"]

    orm = m.orm_texture is not None and not m.unlit
    lines = [f"newmtl {m.name}", *constant("Kd", m.base_color, m.base_color_texture is not None)]
    lines += [*constant("Pr", (m.roughness,), orm), *constant("Pm", (m.metalness,), orm)]
    if m.base_color_texture is not None:
        color = encoded_for(m.base_color_texture, "srgb", m.base_color)
        lines.append("map_Kd " + picture("base_color", color[..., :3], "color"))
    if orm:
        lines.append("map_Pr " + picture("roughness", plane(1, m.roughness)))
        lines.append("map_Pm " + picture("metalness", plane(2, m.metalness)))
    if m.unlit:  # "0: Color on and Ambient off" (MTL specification, illum), a constant colour
        lines += ["illum 0", UNLIT_MARK]
    elif m.emits:
        lines.append("Ke " + " ".join(f"{x:.6g}" for x in m.emission))
        if m.emission_texture is not None:
            emission = encoded_for(m.emission_texture, "srgb")
            lines.append("map_Ke " + picture("emission", emission, "color"))
    if m.normal_texture is not None and not m.unlit:
        strength = "" if m.normal_scale == 1 else f"-bm {m.normal_scale:.6g} "
        normals = encoded_for(m.normal_texture, "linear")[..., :3]
        lines.append(f"norm {strength}" + picture("normal", normals, "normal"))
    factor, alpha = coverage(m)
    if factor < 1 or alpha is not None:
        # readers differ in whether d multiplies its map, too
        mapped = (
            None if alpha is None else picture("alpha", encoded_for(alpha, "linear", (factor,)))
        )
        lines += [f"d {factor:.6g}"] if mapped is None else ["d 1", f"map_d {mapped}"]
        lines += [f"{ALPHA_TEST}{m.alpha_cutoff:.6g}"] if kind_of(m) == "mask" else []
    return [*lines, ""]


def _word(name: str) -> str:
    """A name without white space, at which statements end."""
    return "_".join(name.split())
