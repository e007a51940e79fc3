"""Textures under absolute paths of another machine: found by name, ignored on demand, never read
from elsewhere."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import Asset, images, load, save
from appearance_opt.errors import InputError

ELSEWHERE = (
    "C:\\me\\textures\\t.png",
    "C:/Users/me/t.png",
    "/home/me/textures/t.png",
    "\\\\server\\share\\t.png",
)
PIXELS = np.full((2, 2, 3), (9, 8, 7), np.uint8)


def write(folder: Path, suffix: str, ball: Asset, reference: str) -> Path:
    """A file of which the base colour has this reference, and nothing beside it."""
    folder.mkdir(exist_ok=True)
    path = folder / f"x{suffix}"
    if suffix == ".obj":
        (folder / "x.mtl").write_text(f"newmtl m\nmap_Kd {reference}\n")
        path.write_text("mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
        return path
    save(ball, path)
    text = path.read_text()
    if suffix == ".gltf":
        document = json.loads(text)
        document["images"][0] = {"uri": reference}
        path.write_text(json.dumps(document))
    else:
        name = next(p for p in folder.rglob("*base_color.png")).relative_to(folder)
        path.write_text(text.replace(f"./{name}", reference))
    return path


@pytest.mark.parametrize("suffix", [".obj", ".gltf", ".usda"])
@pytest.mark.parametrize("reference", ELSEWHERE)
def test_absolute_paths(tmp_path: Path, ball: Asset, suffix: str, reference: str) -> None:
    path = write(tmp_path / "asset", suffix, ball, reference)
    with pytest.raises(
        InputError, match=r"outside its own folder, where there is no 't\.png'.*--missing-textures"
    ):
        load(path)
    asset = load(path, missing_textures="ignore")
    assert asset.meshes[0].material.base_color_texture is None
    assert any("t.png" in n and "ignored" in n for n in asset.notes)
    (tmp_path / "t.png").write_bytes(images.encode_png(PIXELS))
    np.testing.assert_array_equal(
        load(path, root=tmp_path).meshes[0].material.base_color_texture.pixels, PIXELS
    )
    (path.parent / "t.png").write_bytes(images.encode_png(PIXELS + 1))
    asset = load(path)
    np.testing.assert_array_equal(asset.meshes[0].material.base_color_texture.pixels, PIXELS + 1)
    assert any("stands for it" in n for n in asset.notes)


def test_an_absolute_path_that_may_be_read_is_read(tmp_path: Path, ball: Asset) -> None:
    folder = tmp_path / "asset"
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "t.png").write_bytes(images.encode_png(PIXELS))
    (folder / "t.png").write_bytes(images.encode_png(PIXELS + 1))
    asset = load(write(folder, ".obj", ball, str(folder / "deep" / "t.png")))
    np.testing.assert_array_equal(asset.meshes[0].material.base_color_texture.pixels, PIXELS)
    assert not asset.notes


def test_a_link_to_elsewhere_does_not_stand_for_it(tmp_path: Path, ball: Asset) -> None:
    path = write(tmp_path / "asset", ".obj", ball, "/home/me/t.png")
    (tmp_path / "secret.png").write_bytes(images.encode_png(PIXELS))
    (path.parent / "t.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(InputError, match="outside"):
        load(path)
