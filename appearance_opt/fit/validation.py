"""Held-out views during a fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.errors import DivergedError
from appearance_opt.reference.pool import check_images
from appearance_opt.render.display import display
from appearance_opt.render.drawn import Drawn
from appearance_opt.render.images import render_image
from appearance_opt.render.pixels import Batch, Grid

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.fit.model import Model
    from appearance_opt.reference.base import Reference
    from appearance_opt.views import Views


class Validation:
    """Fixed views that the fit never sees, and the score of a model on them."""

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

    def render(self, model: Model) -> NDArray[np.float32]:
        """The model in the held-out views: (B, H, W, 4) premultiplied linear radiance and
        coverage."""
        surface = model.surface(model.posed())
        drawn = Drawn(model.scene, surface, model.maps(model.fitted_layer()))
        image = render_image(drawn, Batch(self.views.records(), self._grid), self.samples)
        return np.array(image).reshape(len(self.views), self.resolution, self.resolution, 4)

    def psnr(self, model: Model) -> float:
        """Mean over the views of the PSNR in dB of display values (sRGB, clipped) over the pixels
        that either image covers; with several tessellation levels also over those. Raises
        DivergedError if the model's own image is not finite."""
        current = model.level
        each = []
        try:
            for level in model.levels:
                model.select(level)
                each.append(self._psnr(model))
        finally:
            model.select(current)
        return float(np.mean(each))

    def _psnr(self, model: Model) -> float:
        image = self.render(model)
        finite = np.isfinite(image).all(axis=(1, 2, 3))
        if not finite.all():
            raise DivergedError(
                f"the fitted model's own image is not finite in held-out view {int(finite.argmin())}"
            )
        error = np.mean((display(image) - self._reference) ** 2, axis=-1)
        either = self._covered | (image[..., 3] > 0)
        each = [e[m].mean() if m.any() else 1e-10 for e, m in zip(error, either, strict=True)]
        return float(np.mean([-10 * np.log10(max(e, 1e-10)) for e in each]))
