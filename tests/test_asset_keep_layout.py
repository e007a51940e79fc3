"""A mesh that is baked onto keeps its vertices and texture coordinates, in every format and in
``bake``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import appearance_opt
from appearance_opt.asset import images, load, save
from appearance_opt.asset.types import Asset
from tests.conftest import grid_sphere, make_asset
from tests.test_asset_gltf import write_glb
from tests.test_asset_gltf_nodes import document

TILED = {"index": 0, "extensions": {"KHR_texture_transform": {"scale": [4, 4]}}}


def test_a_low_mesh_with_a_tiled_placeholder_is_baked_onto(tmp_path: Path) -> None:
    """Its texture coordinates, under that material's transform, would leave the unit square."""
    positions, faces, uvs = grid_sphere(8, 12)
    top = {
        "materials": [{"name": "checker", "pbrMetallicRoughness": {"baseColorTexture": TILED}}],
        "textures": [{"source": 0}],
        "images": [{"uri": "t.png"}],
        "extensionsUsed": ["KHR_texture_transform"],
    }
    (tmp_path / "t.png").write_bytes(images.encode_png(np.zeros((2, 2, 3), np.uint8)))
    given, binary = document({"POSITION": positions, "TEXCOORD_0": uvs}, faces, **top)
    given["meshes"][0]["primitives"][0]["material"] = 0
    write_glb(tmp_path / "low.glb", given, binary)
    options = appearance_opt.bake_options(closed_form=True, texture_size=32)
    high: Asset = make_asset(12, 24, 16)
    result = appearance_opt.bake(high, tmp_path / "low.glb", tmp_path / "out.glb", options)
    mesh = result.asset.meshes[0]
    used = np.unique(faces)  # the poles have vertices that no face uses
    np.testing.assert_array_equal(mesh.positions, positions[used])
    np.testing.assert_array_equal(mesh.uvs, uvs[used])
    assert any("LOW: material 'checker'" in n and "not applied" in n for n in result.notes)


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".usda"])
def test_without_transforms_nothing_changes(tmp_path: Path, ball: Asset, suffix: str) -> None:
    save(ball, tmp_path / f"x{suffix}")
    plain, kept = load(tmp_path / f"x{suffix}"), load(tmp_path / f"x{suffix}", keep_layout=True)
    np.testing.assert_array_equal(plain.meshes[0].uvs, kept.meshes[0].uvs)
    np.testing.assert_array_equal(plain.meshes[0].faces, kept.meshes[0].faces)
    assert plain.notes == kept.notes


def test_an_obj_file_s_scale_is_not_applied(tmp_path: Path) -> None:
    (tmp_path / "t.png").write_bytes(images.encode_png(np.zeros((2, 2, 3), np.uint8)))
    (tmp_path / "x.mtl").write_text("newmtl m\nmap_Kd -s 4 4 t.png\n")
    text = (
        "mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    )
    (tmp_path / "x.obj").write_text(text)
    asset = load(tmp_path / "x.obj", keep_layout=True)
    assert asset.meshes[0].uvs.max() == 1
    assert any("not applied" in n for n in asset.notes)
    moved = load(tmp_path / "x.obj").meshes[0].uvs
    np.testing.assert_array_equal(
        [moved.min(), moved.max()], [-3, 4]
    )  # v is counted from the top: 1 - 4 * 1
