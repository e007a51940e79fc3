"""Reference images that are rendered once and used many times."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.backend import to_device
from appearance_opt.errors import ReferenceRenderError
from appearance_opt.reference.base import PointReference
from appearance_opt.render.math import LARGEST_HALF, at_most
from appearance_opt.views import Views

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.reference.base import Reference
    from appearance_opt.views import Sampler


FIRST = 8
"""Batches that are new one after the other at the beginning."""


@dataclass(frozen=True)
class Targets:
    """Reference images of a batch, flat (batch * pixels * 4): ``average`` over the pixels' areas,
    and what the rays through their middles see (``points``), or None where the reference cannot
    tell. ``frame``: number of the frame of an animation that they show, None without one."""

    average: mi.Float
    points: mi.Float | None = None
    frame: int | None = None


@dataclass
class ReferencePool:
    """At most ``capacity`` views drawn from ``sampler`` at a time, their images rendered when first
    asked for.

    The first iterations see new views, ``first`` batches of them. From then on every ``reuse``-th
    iteration does, and its views take the place of the oldest ones as soon as ``capacity`` is
    reached; the others draw at random from those that are there. So each view is seen about
    ``reuse`` times: enough to spare most of the rendering, and few enough that maps of a million
    texels are not fitted to the noise of a few hundred images. With 0, which is for references that
    are slow, a first pass sees ``capacity`` views, which then stay for ever.

    Which views an iteration sees is a pure function of the seed and the iteration: a resumed fit
    sees the same, and re-renders what it needs. Images are kept in half precision.
    """

    reference: Reference
    sampler: Sampler
    capacity: int
    batch: int
    resolution: int
    samples: int
    point_width: float = 0.4
    reuse: int = 0
    first: int = FIRST
    _images: dict[int, NDArray[np.float16]] = field(default_factory=dict)
    _points: dict[int, NDArray[np.float16]] = field(default_factory=dict)
    _views: dict[int, Views] = field(default_factory=dict)

    def draw(self, iteration: int) -> tuple[Views, Targets]:
        """The views of an iteration and their images."""
        newest, fresh = self._newest(iteration)
        oldest = max(newest - self._groups + 1, 0)
        if fresh:  # a whole batch at a time
            members = np.arange(self.batch) + newest * self.batch
        else:
            rng = np.random.default_rng([self.sampler.seed, self.sampler.stream, iteration, 1])
            members = self._chosen(rng, oldest, newest)
        self._forget(oldest * self.batch)
        missing = [int(k) for k in members if int(k) not in self._images]
        if missing:
            self._render(sorted({k // self.batch for k in missing}))
        views = Views.concatenate([self._views[int(k)] for k in members])
        images, points = (
            # joined on the host: dr.concat compiles a kernel for every layout of its inputs
            mi.Float(mi.Float16(np.concatenate([kept[int(k)] for k in members]))) if kept else None
            for kept in (self._images, self._points)
        )
        assert images is not None
        return views, Targets(images, points, self._frame_of(int(members[0]) // self.batch))

    def _chosen(self, rng: np.random.Generator, oldest: int, newest: int) -> NDArray[np.int64]:
        """(batch,) numbers of views that are there, in batches from ``oldest`` to ``newest``."""
        there = (newest - oldest + 1) * self.batch
        return oldest * self.batch + rng.choice(there, self.batch, replace=False)

    def _frame_of(self, group: int) -> int | None:
        """The frame that a batch shows."""
        return None

    def _source(self, group: int) -> tuple[Reference, Sampler]:
        """What draws a batch, and its views."""
        return self.reference, self.sampler

    @property
    def _groups(self) -> int:
        """Batches that are there at a time, at most."""
        return max(1, self.capacity // self.batch)

    def _newest(self, iteration: int) -> tuple[int, bool]:
        """(number of the newest batch, does the iteration see that one?)"""
        first = self._groups if self.reuse == 0 else min(self.first, self._groups)
        later = iteration - first
        if later < 0:
            return iteration, True
        if self.reuse == 0:
            return first - 1, False
        return first + later // self.reuse, later % self.reuse == 0

    def _forget(self, first: int) -> None:
        """Drop views with numbers below ``first``."""
        for kept in (self._images, self._points, self._views):
            for k in [k for k in kept if k < first]:
                del kept[k]

    def _render(self, groups: list[int]) -> None:
        for group in groups:
            reference, sampler = self._source(group)
            views = sampler.draw(group, self.batch)
            if isinstance(reference, PointReference):
                images, points = reference.pair(
                    views, self.resolution, self.samples, self.point_width
                )
                self._keep(self._points, group, points)
            else:
                images = reference.render(views, self.resolution, self.samples)
            self._keep(self._images, group, images)
            for k in range(self.batch):
                self._views[group * self.batch + k] = views[k : k + 1]

    def _keep(
        self, kept: dict[int, NDArray[np.float16]], group: int, images: NDArray[np.float32]
    ) -> None:
        what = f"pool batch {group}"
        check_shape(images, self.batch, self.resolution, what)
        # on the device: NumPy takes ten times as long to halve the precision
        radiance = to_device(images)
        if not dr.all(dr.isfinite(radiance) & (radiance >= 0)):
            check_images(images, self.batch, self.resolution, what)
        halved = np.array(mi.Float16(at_most(radiance, LARGEST_HALF)))
        kept.update(enumerate(halved.reshape(self.batch, -1), group * self.batch))


def check_shape(images: NDArray[np.float32], count: int, resolution: int, what: str) -> None:
    """Raises ReferenceRenderError unless there are ``count`` square images of four channels."""
    wanted = (count, resolution, resolution, 4)
    if np.shape(images) != wanted:
        raise ReferenceRenderError(
            f"the reference renderer returned an array of shape {np.shape(images)} ({what}); expected {wanted}: views, "
            "rows, columns, and premultiplied linear RGB with coverage"
        )


def check_images(
    images: NDArray[np.float32], count: int, resolution: int, what: str
) -> NDArray[np.float32]:
    """The images, if there are ``count`` of them and every pixel is finite and not negative;
    ReferenceRenderError naming the first view that is not."""
    check_shape(images, count, resolution, what)
    ok = np.isfinite(images) & (images >= 0)
    if ok.all():
        return images
    bad = np.flatnonzero(~ok.reshape(len(images), -1).all(axis=1))
    count = int((~ok[bad[0]]).any(axis=-1).sum())
    raise ReferenceRenderError(
        f"the reference renderer returned {count} NaN, infinite or negative pixels in view {bad[0]} ({what})"
    )
