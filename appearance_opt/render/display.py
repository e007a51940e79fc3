"""What a screen shows of a rendered image: the values in which errors are measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.types import linear_to_srgb

if TYPE_CHECKING:
    from numpy.typing import NDArray

BACKGROUND = 0.18
"""Linear grey behind the object."""


def display(image: NDArray) -> NDArray[np.float32]:
    """Turn (..., 4) premultiplied linear radiance and coverage to (..., 3) sRGB values in [0, 1]
    over grey."""
    return linear_to_srgb(
        np.clip(image[..., :3] + BACKGROUND * (1 - image[..., 3:]), 0, 1).astype(np.float32)
    )
