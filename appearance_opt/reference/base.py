"""What the fit asks of a reference renderer: images, nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from appearance_opt.views import Views


class Reference(Protocol):
    """A black box that hands out images.

    ``render`` returns (B, H, W, 4) float32: premultiplied linear radiance and coverage in [0, 1],
    averaged over the pixel's area (``samples`` says how finely), background black and uncovered.
    Rows run downward.
    """

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]: ...
