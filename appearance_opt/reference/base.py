"""What the fit asks of a reference renderer: where the object lies, and images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from appearance_opt.views import Views


class Reference(Protocol):
    """A black box that hands out images.

    ``bounds`` (2, 3): least and greatest corner of an axis-aligned box that holds all that it
    shows, in the coordinates of the views that it is given (right-handed, any unit of length, y up
    by glTF's convention). Views are framed to it.

    ``render`` returns (B, H, W, 4) float32: premultiplied linear radiance and coverage in [0, 1],
    averaged over the pixel's area (``samples`` says how finely), background black and uncovered.
    Rows run downward.
    """

    @property
    def bounds(self) -> NDArray[np.floating]: ...

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]: ...


@runtime_checkable
class PointReference(Reference, Protocol):
    """A reference that can also look along single rays.

    ``pair`` returns two images like that of ``render``: one averaged over the pixels' areas at
    least where outlines pass, and what the ray through the middle of each pixel sees, its textures
    filtered over ``width`` pixels. A fit that compares point with point needs one sample per pixel
    and sees no aliasing: both sides alias alike.
    """

    def pair(
        self, views: Views, resolution: int, samples: int, width: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]: ...
