"""Films: pictures one after the other, as an animated GIF that every browser shows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

FASTEST = 50
"""Pictures per second that a GIF can show: its unit is a hundredth of a second, and browsers slow
down films of one."""


def write_film(path: Path, pictures: Sequence[NDArray[np.uint8]], rate: float) -> None:
    """Write pictures (H, W, 3), all of one size, of which ``rate`` are shown per second. Raises
    OSError when the disk refuses."""
    import OpenImageIO as oiio

    height, width, channels = pictures[0].shape
    spec = oiio.ImageSpec(width, height, channels, "uint8")
    spec.attribute("oiio:Movie", 1)
    per_second = [int(np.clip(round(rate), 1, FASTEST)), 1]
    spec.attribute("FramesPerSecond", oiio.TypeDesc("rational"), per_second)
    out = oiio.ImageOutput.create(str(path))
    if out is None or not out.open(str(path), tuple([spec] * len(pictures))):
        raise OSError(f"{path}: the film could not be written ({oiio.geterror()})")
    for k, picture in enumerate(pictures):
        if k and not out.open(str(path), spec, "AppendSubimage"):
            raise OSError(f"{path}: the film could not be written ({out.geterror()})")
        if not out.write_image(np.ascontiguousarray(picture)):
            raise OSError(f"{path}: the film could not be written ({out.geterror()})")
    out.close()


def bone_colors(bones: int) -> NDArray[np.float32]:
    """(bones, 3) linear colours that tell neighbours apart: hues a golden angle apart."""
    hue = (np.arange(bones) * 0.61803398875) % 1.0
    phase = (hue[:, None] * 6 + np.array([0.0, 4.0, 2.0])) % 6
    saturated = np.clip(np.abs(phase - 3) - 1, 0, 1)
    light = np.where(np.arange(bones) % 2, 0.35, 0.8)[:, None]
    return (light * (0.15 + 0.85 * saturated)).astype(np.float32)
