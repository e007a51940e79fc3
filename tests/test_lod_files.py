"""Chains of levels in files: MSFT_lod in glTF, variants in USD."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import pytest

from appearance_opt.asset import load, write
from appearance_opt.asset.types import Asset
from tests.conftest import make_asset


def levels() -> tuple[Asset, ...]:
    """Three spheres, the finest first, that share material and textures."""
    first = make_asset(12, 16)
    coarser = [make_asset(6, 8), make_asset(3, 4)]
    material = first.meshes[0].material
    return first, *(replace(a, meshes=(replace(a.meshes[0], material=material),)) for a in coarser)


def gltf_json(path: Path) -> dict:
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length])


def test_levels_of_a_glb_replace_the_finest_node(tmp_path: Path) -> None:
    finest, *coarser = levels()
    out = tmp_path / "a.glb"
    write(finest, out, coarser=coarser, coverage=(0.5, 0.1, 0.0))
    data = gltf_json(out)
    (top,) = data["scenes"][0]["nodes"]
    node = data["nodes"][top]
    ids = node["extensions"]["MSFT_lod"]["ids"]
    assert data["extensionsUsed"] == ["MSFT_lod"]
    assert node["extras"]["MSFT_screencoverage"] == [0.5, 0.1, 0.0]
    counts = []
    for number in (top, *ids):
        (child,) = data["nodes"][number]["children"]
        (primitive,) = data["meshes"][data["nodes"][child]["mesh"]]["primitives"]
        counts.append(data["accessors"][primitive["indices"]]["count"] // 3)
    assert counts == [a.triangle_count for a in (finest, *coarser)]
    assert len(data["images"]) == 2  # shared
    assert load(out).triangle_count == finest.triangle_count


@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
def test_levels_of_a_usd_are_variants(tmp_path: Path, suffix: str) -> None:
    finest, *coarser = levels()
    out = tmp_path / f"a{suffix}"
    write(finest, out, coarser=coarser)
    assert load(out).triangle_count == finest.triangle_count
    for k, level in enumerate((finest, *coarser)):
        read = load(out, variants={"LOD": f"LOD{k}"})
        assert read.triangle_count == level.triangle_count
        assert read.meshes[0].material.base_color_texture is not None
    if suffix == ".usda":
        assert len(list((tmp_path / "a_textures").iterdir())) == 2  # shared
