"""Validators of others find no fault with anything that is written. Those that are not installed
are skipped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from appearance_opt.asset import FileOptions, ktx2, save
from appearance_opt.asset.file_options import parse_textures
from appearance_opt.asset.height import displacement_of
from appearance_opt.asset.types import Asset, Texture, Volume
from tests.test_written_files import painted, part, waves
from tests.validators import UNKNOWN_TO_IT, khronos_messages, usd_messages

glow = Texture(waves(16), "srgb")
WAYS: dict[str, FileOptions] = {
    "plain": FileOptions(),
    "jpeg": parse_textures("jpeg"),
    "webp": parse_textures("webp"),
    "quantised": FileOptions(quantize=True),
    "compressed": FileOptions(compress="meshopt"),
    "both": FileOptions(quantize=True, compress="meshopt"),
}


def everything() -> Asset:
    """Materials of all kinds that are written."""
    changes: dict[str, Any] = {
        "plain": {},
        "one side": {"double_sided": False},
        "constant": {"base_color_texture": None, "orm_texture": None, "normal_texture": None},
        "mask": {"alpha_mode": "mask", "base_color_texture": Texture(waves(channels=4), "srgb")},
        "glass": {
            "transmission": 0.8,
            "ior": 1.3,
            "volume": Volume(0.1, 2.0, (0.9, 0.8, 0.7)),
            "double_sided": False,
        },
        "glow": {"emission": (2.0, 1.0, 0.5), "emission_texture": glow},
        "sign": {"unlit": True},
        "high": {"displacement": displacement_of(np.zeros((8, 8), np.float32))},
    }
    materials = [replace(painted(**c), name=name) for name, c in changes.items()]
    return Asset(tuple(part(m, 2.5 * k, m.name) for k, m in enumerate(materials)), "everything")


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize("way", list(WAYS))
def test_the_khronos_validator_is_content(tmp_path: Path, way: str, suffix: str) -> None:
    if WAYS[way].compress == "meshopt":
        pytest.importorskip("meshopt")
    save(everything(), tmp_path / f"a{suffix}", WAYS[way])
    assert khronos_messages(tmp_path / f"a{suffix}") == []


def test_the_khronos_validator_finds_no_fault_but_that_it_does_not_know_ktx2(
    tmp_path: Path,
) -> None:
    if ktx2.encoder() is None:
        pytest.skip("no encoder of KTX 2.0 on the path")
    save(everything(), tmp_path / "a.glb", parse_textures("ktx2"))
    messages = khronos_messages(tmp_path / "a.glb")
    rest = [
        m
        for m in messages
        if m["code"] != "IMAGE_UNRECOGNIZED_FORMAT"
        and not any(word in m["message"] for word in UNKNOWN_TO_IT)
    ]
    assert rest == []


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
@pytest.mark.parametrize("codec", ["png", "jpeg"])
def test_the_validators_of_usd_are_content(tmp_path: Path, suffix: str, codec: str) -> None:
    save(everything(), tmp_path / f"a{suffix}", parse_textures(codec))
    assert usd_messages(tmp_path / f"a{suffix}") == []
