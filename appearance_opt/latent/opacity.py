"""Opacity as a map of its own: what is not fitted with it has neither the channel nor its kernels.

Stored as it is, within [0, 1]. Mip levels are means, so that what a surface keeps back of the light
behind it stays the same from afar.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from appearance_opt.latent.texels import OPACITY, PackedMaps
from appearance_opt.render.material import Coverage

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from appearance_opt.latent.parameter import Rates
    from appearance_opt.render.material import TexelLayer


class Opacity(PackedMaps):
    """The opacity ``image`` (size, size) of the atlas, fitted or not."""

    def __init__(self, image: NDArray, fitted: bool) -> None:
        super().__init__(OPACITY, {OPACITY: image}, fitted)
        self.channels = (OPACITY,)
        self._image = image

    def coverage(self, decoded: TexelLayer) -> Coverage:
        return Coverage(decoded)

    def set_rates(self, rates: Rates) -> None:
        assert self.parameter is not None
        self.parameter.rate = self.codec.per_channel({OPACITY: rates.opacity})

    def export(self) -> dict[str, NDArray[np.float32]]:
        if self.parameter is None:
            return {OPACITY: self._image.astype("float32")}
        return self.codec.to_maps(self.parameter.value)
