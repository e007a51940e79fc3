"""One small whole file of every format that is read, to be damaged."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from appearance_opt.asset import save
from appearance_opt.optimize import archive
from tests.conftest import make_asset

FINGERPRINT = "the job of the seeds"


@dataclass(frozen=True)
class Seed:
    """``file`` is damaged, ``root`` is read (the same, or what refers to it); ``reader`` of
    ``worker.READERS``."""

    file: str
    root: str
    reader: str = "asset"


SEEDS = {
    "GLB": Seed("x.glb", "x.glb"),
    "glTF": Seed("x.gltf", "x.gltf"),
    "Draco": Seed("draco.glb", "draco.glb"),
    "meshopt": Seed("meshopt.glb", "meshopt.glb"),
    "USDA": Seed("x.usda", "x.usda"),
    "USDC": Seed("x.usdc", "x.usdc"),
    "USDZ": Seed("x.usdz", "x.usdz"),
    "MaterialX": Seed("x.mtlx", "look.usda"),
    "OBJ": Seed("x.obj", "x.obj"),
    "MTL": Seed("x.mtl", "x.obj"),
    "PLY": Seed("x.ply", "x.ply"),
    "PLY text": Seed("text.ply", "text.ply"),
    "STL": Seed("x.stl", "x.stl"),
    "STL text": Seed("text.stl", "text.stl"),
    "PNG": Seed("x.png", "x.png", "picture"),
    "JPEG": Seed("x.jpg", "x.jpg", "picture"),
    "EXR": Seed("x.exr", "x.exr", "picture"),
    "TOML": Seed("x.toml", "x.toml", "job"),
    "checkpoint": Seed("x.npz", "x.npz", "checkpoint"),
}

JOB = """preset = "draft"
triangles = 1200
fit = ["shape", "normal", "material"]
budget = "45s"
texture-size = 512
background = "0.1,0.2,0.3"
no_such = { nested = [1, 2.5, true, 1979-05-27] }
"""

LOOK = """#usda 1.0
(
    defaultPrim = "R"
)
def Xform "R"
{
    def Scope "L" (
        references = @./x.mtlx@</MaterialX>
    )
    {
    }
    def Mesh "m" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (0, 1)] (interpolation = "vertex")
        rel material:binding = </R/L/Materials/M>
    }
}
"""

MATERIALX = """<?xml version="1.0"?>
<materialx version="1.38">
  <nodegraph name="G">
    <image name="I" type="color3">
      <input name="file" type="filename" value="x.png" colorspace="srgb_texture"/>
    </image>
    <output name="o" type="color3" nodename="I"/>
  </nodegraph>
  <standard_surface name="S" type="surfaceshader">
    <input name="base_color" type="color3" nodegraph="G" output="o"/>
    <input name="specular_roughness" type="float" value="0.3"/>
  </standard_surface>
  <surfacematerial name="M" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="S"/>
  </surfacematerial>
</materialx>
"""


def write_seeds(folder: Path) -> None:
    """Write all files of ``SEEDS`` and what they refer to into ``folder``."""
    import OpenImageIO as oiio
    import trimesh

    from tests.test_asset_gltf import QUAD, draco_document, meshopt_document, write_glb

    asset = make_asset(4, 6, 8)
    for suffix in (".glb", ".gltf", ".obj", ".usda", ".usdc", ".usdz"):
        save(asset, folder / f"x{suffix}")
    mesh = asset.meshes[0]
    solid = trimesh.Trimesh(mesh.positions, mesh.faces, process=False)
    for kind in ("ply", "stl"):
        (folder / f"x.{kind}").write_bytes(solid.export(file_type=kind))
    (folder / "text.ply").write_bytes(solid.export(file_type="ply", encoding="ascii"))
    (folder / "text.stl").write_text(solid.export(file_type="stl_ascii"))
    write_glb(folder / "draco.glb", *draco_document(*QUAD))
    write_glb(folder / "meshopt.glb", *meshopt_document())
    (folder / "look.usda").write_text(LOOK)
    (folder / "x.mtlx").write_text(MATERIALX)
    (folder / "x.toml").write_text(JOB)
    pixels = (np.random.default_rng(0).random((24, 17, 3)) * 255).astype(np.uint8)
    for suffix, kind in (("png", oiio.UINT8), ("jpg", oiio.UINT8), ("exr", oiio.HALF)):
        out = oiio.ImageOutput.create(f"x.{suffix}")
        assert out.open(
            str(folder / f"x.{suffix}"), oiio.ImageSpec(17, 24, 3, kind)
        ) and out.write_image(pixels)
        out.close()
    rows = {k: np.arange(40, dtype=np.float32) for k in ("positions", "texels")}
    archive.write(
        folder / "x.npz", FINGERPRINT, {"values": rows, "curve": [(0.5, 1)], "seconds": 1.5}
    )


def glb_parts(data: bytes) -> tuple[dict, bytes]:
    """(JSON, binary chunk) of a whole GLB file."""
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]
