"""What ``inspect`` says of a file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

import appearance_opt
from appearance_opt.asset import save
from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.jobs.inspect import COLUMNS, LISTED, MapFacts
from tests.test_asset_gltf import triangle_document, write_glb
from tests.test_asset_gltf_nodes import ball
from tests.test_cli import run


def glass_and_wood() -> Asset:
    """A ball of 3 m across, and a smaller one that can be seen through, of which 5 faces are turned
    over."""
    positions, faces = (np.array(a) for a in ball(1))
    uvs = np.abs(positions[:, :2])
    color = Texture(np.zeros((4, 8, 3), np.uint8), "srgb")
    bumps = Texture(np.full((16, 16, 3), 32768, np.uint16), "linear")
    wood = Material("wood", base_color_texture=color, normal_texture=bumps, double_sided=False)
    glass = Material("glass", opacity=0.5, alpha_mode="blend", base_color_texture=color)
    turned = faces.copy()
    turned[:5] = turned[:5, ::-1]
    one = Mesh(positions * np.float32(1.5), faces, positions, uvs, material=wood, name="one")
    return Asset((one, Mesh(positions, turned, positions, uvs, material=glass, name="two")), "pair")


def test_what_an_artist_wants_to_know(tmp_path: Path) -> None:
    asset = glass_and_wood()
    path = tmp_path / "pair.gltf"
    save(asset, path)
    found = appearance_opt.inspect(path)
    _, faces = ball(1)
    size = np.ptp(asset.meshes[0].positions, axis=0)
    np.testing.assert_allclose(found.size, size, rtol=1e-6)
    assert found.files == 4 and found.file_bytes == sum(
        f.stat().st_size for f in tmp_path.iterdir()
    )
    assert (found.meshes, found.counts.triangles, found.counts.connected_parts) == (
        2,
        2 * len(faces),
        2,
    )
    assert found.counts.reversed_normals == 5
    assert found.textures == 2 and found.texture_bytes == 4 * 8 * 3 + 16 * 16 * 3 * 2
    wood, glass = sorted(found.materials, key=lambda m: m.name, reverse=True)
    assert (wood.seen, wood.simplify, wood.double_sided) == ("opaque", "fitted", False)
    assert (glass.seen, glass.simplify, glass.double_sided) == ("blend", "kept as it is", True)
    assert wood.maps == (
        MapFacts("base colour", 8, 4, 3, 8, "srgb"),
        MapFacts("normal", 16, 16, 3, 16, "linear"),
    )


def test_skins_clips_and_variants_of_both_formats(tmp_path: Path) -> None:
    variants = {"KHR_materials_variants": {"variants": [{"name": "red"}, {"name": "blue"}]}}
    given, binary = triangle_document(
        skins=[{"joints": [0]}, {"name": "rig", "joints": [0]}],
        animations=[{"name": "walk", "channels": [], "samplers": []}],
        extensions=variants,
        extensionsUsed=list(variants),
    )
    write_glb(tmp_path / "x.glb", given, binary)
    contents = appearance_opt.inspect(tmp_path / "x.glb").contents
    assert (
        contents.skins == ("skin0", "rig")
        and contents.clips == ("walk",)
        and contents.variants == ("red", "blue")
    )
    stage = """#usda 1.0
(
    defaultPrim = "a"
    startTimeCode = 1
    endTimeCode = 24
)
def Xform "a" (
    variants = {
        string look = "dark"
    }
    prepend variantSets = "look"
)
{
    def Skeleton "bones"
    {
    }
    def Mesh "m"
    {
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    }
    variantSet "look" = {
        "dark" {
        }
        "light" {
        }
    }
}
"""
    (tmp_path / "x.usda").write_text(stage)
    found = appearance_opt.inspect(tmp_path / "x.usda").contents
    assert found.skins == ("bones",) and found.clips == ("frames 1 to 24",)
    assert sorted(found.variants) == ["look=dark", "look=light"]


def test_the_terminal_has_80_columns_and_long_lists_are_counted(tmp_path: Path) -> None:
    positions, faces = (np.array(a) for a in ball(0))
    picture = Texture(np.zeros((2, 2, 3), np.uint8), "srgb")
    name = "a material with a name that goes on and on, as names of materials do " * 3
    meshes = [
        Mesh(
            positions + np.float32(3 * k),
            faces,
            positions,
            name=f"m{k}",
            material=replace(m, name=f"{name}{k}"),
        )
        for k in range(LISTED + 5)
        if (m := Material(base_color_texture=picture))
    ]
    save(Asset(tuple(meshes)), tmp_path / "x.glb")
    found = appearance_opt.inspect(tmp_path / "x.glb")
    lines = found.lines()
    told = lines[: lines.index(next(line for line in lines if line.startswith("... and 5 more")))]
    assert max(map(len, told)) <= COLUMNS
    done = run("inspect", "x.glb", "--json", cwd=tmp_path)
    record = json.loads(done.stdout)
    assert (
        record["triangles"] == len(meshes) * len(faces) and len(record["materials"]) == LISTED + 5
    )
    assert record["materials"][0]["maps"][0]["color_space"] == "srgb"
