"""Pictures compressed by Basis Universal: KTX 2.0 files written here, block by block."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import images, load
from appearance_opt.errors import InputError
from tests.test_asset_gltf import triangle_document, write_glb

COLORS = np.array(
    [[(200, 30, 10, 255), (0, 255, 0, 255)], [(1, 2, 3, 255), (90, 90, 90, 255)]], np.uint8
)


def ktx2(colors: np.ndarray, vk_format: int = 0) -> bytes:
    """A KTX 2.0 file of UASTC blocks of one colour each (rows, columns, 4): mode 8, whose code is 5
    bits (0x17), then the colour (UASTC LDR 4x4 texture specification, "Mode 8"); what follows
    serves other targets than RGBA."""
    blocks = b"".join(
        (0x17 | int.from_bytes(bytes(c.tolist()), "little") << 5).to_bytes(16, "little")
        for c in colors.reshape(-1, 4)
    )
    sample = struct.pack(
        "<HBBIII", 0, 127, 3 if (colors[..., 3] < 255).any() else 0, 0, 0, 0xFFFFFFFF
    )
    block = (
        struct.pack("<IHH4B4B8B", 0, 2, 24 + 16, 166, 1, 2, 0, 3, 3, 0, 0, 16, *(0,) * 7) + sample
    )
    descriptor = struct.pack("<I", 4 + len(block)) + block
    start = 80 + 24
    level = (start + len(descriptor) + 15) // 16 * 16
    head = b"\xabKTX 20\xbb\r\n\x1a\n" + struct.pack(
        "<9I", vk_format, 1, 4 * colors.shape[1], 4 * colors.shape[0], 0, 0, 1, 1, 0
    )
    index = struct.pack(
        "<4I2Q3Q", start, len(descriptor), 0, 0, 0, 0, level, len(blocks), len(blocks)
    )
    return (head + index + descriptor).ljust(level, b"\0") + blocks


@pytest.mark.parametrize("alpha", [255, 100])
def test_a_ktx2_picture_is_read(alpha: int) -> None:
    pytest.importorskip("opengl_basisu")
    colors = COLORS.copy()
    colors[0, 0, 3] = alpha
    pixels = images.decode(ktx2(colors), "x.ktx2")
    want = colors.repeat(4, axis=0).repeat(4, axis=1)
    np.testing.assert_array_equal(pixels, want if alpha < 255 else want[..., :3])


def test_damaged_and_other_ktx2_files_are_refused_by_name() -> None:
    pytest.importorskip("opengl_basisu")
    with pytest.raises(InputError, match=r"x\.ktx2.*damaged"):
        images.decode(ktx2(COLORS)[:90], "x.ktx2")
    with pytest.raises(InputError, match=r"x\.ktx2"):
        images.decode(ktx2(COLORS, vk_format=37), "x.ktx2")


def textured(folder: Path, plain: bool) -> Path:
    """A triangle whose texture is a KTX 2.0 file, with a PNG file beside it or not."""
    (folder / "c.ktx2").write_bytes(ktx2(COLORS))
    (folder / "c.png").write_bytes(images.encode_png(np.full((4, 4, 3), (9, 8, 7), np.uint8)))
    texture = {
        "extensions": {"KHR_texture_basisu": {"source": 0}},
        **({"source": 1} if plain else {}),
    }
    document, binary = triangle_document()
    document["textures"] = [texture]
    document["images"] = [{"uri": "c.ktx2", "mimeType": "image/ktx2"}, {"uri": "c.png"}]
    document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    document["meshes"][0]["primitives"][0]["material"] = 0
    document["extensionsUsed"] = ["KHR_texture_basisu"]
    if not plain:
        document["extensionsRequired"] = ["KHR_texture_basisu"]
    write_glb(folder / "x.glb", json.loads(json.dumps(document)), binary)
    return folder / "x.glb"


def test_a_gltf_texture_in_ktx2_is_read_and_a_plain_one_beside_it_preferred(tmp_path: Path) -> None:
    pytest.importorskip("opengl_basisu")
    for plain, want in ((False, (200, 30, 10)), (True, (9, 8, 7))):
        asset = load(textured(tmp_path, plain))
        texture = asset.meshes[0].material.base_color_texture
        assert texture is not None
        assert tuple(texture.pixels[0, 0]) == want
        assert not [n for n in asset.notes if "basisu" in n]


def test_without_the_package_the_message_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "opengl_basisu", None)
    assert load(textured(tmp_path, True)).meshes[0].material.base_color_texture is not None
    with pytest.raises(InputError, match=r"opengl-basisu.*appearance-opt\[basisu\]"):
        load(textured(tmp_path, False))
