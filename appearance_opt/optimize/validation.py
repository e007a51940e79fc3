"""Held-out views during a fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.errors import DivergedError
from appearance_opt.reference.pool import check_images
from appearance_opt.render.display import display
from appearance_opt.render.layers import renderer_of
from appearance_opt.render.pixels import Batch, Grid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from appearance_opt.latent.latent import Latent
    from appearance_opt.reference.base import Reference
    from appearance_opt.views import Views


class Validation:
    """Fixed views that the fit never sees, and the score of a latent on them."""

    def __init__(
        self, reference: Reference, views: Views, resolution: int, samples: int = 9
    ) -> None:
        self.views, self.resolution, self.samples = views, resolution, samples
        self._grid = Grid(len(views), resolution)
        images = check_images(
            reference.render(views, resolution, samples), len(views), resolution, "held-out views"
        )
        self._reference = display(images)
        self._covered = images[..., 3] > 0

    def render(self, latent: Latent) -> NDArray[np.float32]:
        """The latent in the held-out views: (B, H, W, 4) premultiplied linear radiance and
        coverage."""
        batch = Batch(self.views.records(), self._grid)
        drawn = latent.drawn()
        image = renderer_of(drawn.maps.coverage).render_image(drawn, batch, self.samples)
        return np.array(image).reshape(len(self.views), self.resolution, self.resolution, 4)

    def psnr(self, latent: Latent) -> float:
        """Mean over views and poses of the PSNR in dB of display values (sRGB, clipped) over the
        pixels that either image covers. Raises DivergedError if the latent's own image is not
        finite."""
        current = latent.pose
        each = []
        try:
            for pose in latent.poses:
                latent.select(pose)
                each.append(self.score(latent))
        finally:
            latent.select(current)
        return float(np.mean(each))

    def score(self, latent: Latent) -> float:
        """The same for the pose that is drawn now."""
        image = self.render(latent)
        finite = np.isfinite(image).all(axis=(1, 2, 3))
        if not finite.all():
            raise DivergedError(
                f"the fitted model's own image is not finite in held-out view {int(finite.argmin())}"
            )
        error = np.mean((display(image) - self._reference) ** 2, axis=-1)
        either = self._covered | (image[..., 3] > 0)
        each = [e[m].mean() if m.any() else 1e-10 for e, m in zip(error, either, strict=True)]
        return float(np.mean([-10 * np.log10(max(e, 1e-10)) for e in each]))


class FrameValidation:
    """Held-out views of some frames of an animation. ``frames``: number of the frame, and its
    views."""

    def __init__(self, frames: Sequence[tuple[int, Validation]]) -> None:
        self.frames = tuple(frames)

    def scores(self, latent: Latent) -> list[float]:
        """PSNR in dB of each of its frames. Raises DivergedError as ``Validation`` does."""
        current, each = latent.pose, []
        try:
            for frame, validation in self.frames:
                latent.select(latent.poses[frame])
                each.append(validation.score(latent))
        finally:
            latent.select(current)
        return each

    def psnr(self, latent: Latent) -> float:
        """Mean over its frames of the PSNR in dB (see ``Validation``)."""
        return float(np.mean(self.scores(latent)))
