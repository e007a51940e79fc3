"""Written characters, posed by UsdSkel itself, stand where we say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import load, save
from appearance_opt.asset.rig import Skin
from experiments.animation.evaluators import farthest, pose_by_us, pose_by_usdskel
from scenes.creature import creature


@pytest.mark.parametrize("clip", ["walk", "look"])
def test_usdskel_poses_written_characters_as_we_do(tmp_path: Path, clip: str) -> None:
    """At keys and between them, to 1e-5 of the height; and the check sees what is wrong."""
    save(creature(900, 16), tmp_path / "creature.usdc")
    asset = load(tmp_path / "creature.usdc", keep_rig=True)
    times = [0.0, 0.25, 0.6104]
    ours = pose_by_us(asset, clip, times)
    theirs = pose_by_usdskel(tmp_path / "creature.usdc", clip, times)
    height = np.ptp(np.concatenate(ours)[:, 1])
    assert max(map(farthest, ours, theirs)) < 1e-5 * height
    spine = asset.meshes[0]
    assert spine.skin is not None
    wrong = replace(spine, skin=Skin(spine.skin.bones * 0, spine.skin.weights))
    broken = pose_by_us(replace(asset, meshes=(wrong, *asset.meshes[1:])), clip, times)
    assert farthest(broken[1], theirs[1]) > 1e-2 * height
