"""Reference images that are rendered once and used many times."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.errors import ReferenceRenderError
from appearance_opt.views import Views

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.reference.base import Reference
    from appearance_opt.views import ViewSampler


@dataclass
class ReferencePool:
    """``capacity`` views drawn from ``sampler``, their images rendered when first asked for.

    A fit visits each view many times, so a slow reference, or finely sampled images of a fast one, cost
    nothing in the long run. Which views an iteration sees is a pure function of the seed and the iteration:
    a resumed fit sees the same, and re-renders what it needs. Images are kept in half precision.
    """

    reference: Reference
    sampler: ViewSampler
    capacity: int
    batch: int
    resolution: int
    samples: int
    _images: dict[int, mi.Float16] = field(default_factory=dict)
    _views: dict[int, Views] = field(default_factory=dict)

    def draw(self, iteration: int) -> tuple[Views, mi.Float]:
        """The views of an iteration and their images, flat (batch * pixels * 4)."""
        groups = max(1, self.capacity // self.batch)
        if iteration < groups:  # the first pass fills the pool, a whole batch at a time
            members = np.arange(self.batch) + iteration * self.batch
        else:
            rng = np.random.default_rng([self.sampler.seed, self.sampler.stream, iteration, 1])
            members = rng.choice(groups * self.batch, self.batch, replace=False)
        missing = [int(k) for k in members if int(k) not in self._images]
        if missing:
            self._render(sorted({k // self.batch for k in missing}))
        views = Views.concatenate([self._views[int(k)] for k in members])
        return views, mi.Float(dr.concat([self._images[int(k)] for k in members]))

    def _render(self, groups: list[int]) -> None:
        for group in groups:
            views = self.sampler.draw(group, self.batch)
            images = checked(self.reference.render(views, self.resolution, self.samples), f"pool batch {group}")
            for k in range(self.batch):
                member = group * self.batch + k
                half = np.minimum(images[k], np.finfo(np.float16).max).astype(np.float16)
                self._images[member] = mi.Float16(half.ravel())
                self._views[member] = views[k : k + 1]


def checked(images: NDArray[np.float32], what: str) -> NDArray[np.float32]:
    """The images, if every pixel is finite and not negative; ReferenceRenderError naming the first view
    that is not."""
    ok = np.isfinite(images) & (images >= 0)
    if ok.all():
        return images
    bad = np.flatnonzero(~ok.reshape(len(images), -1).all(axis=1))
    count = int((~ok[bad[0]]).any(axis=-1).sum())
    raise ReferenceRenderError(
        f"the reference renderer returned {count} NaN, infinite or negative pixels in view {bad[0]} ({what})"
    )
