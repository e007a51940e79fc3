"""Images of a slow reference, kept: what is rendered once serves every stage of a job, at any size,
and a job that goes on later."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.digest import digest
from appearance_opt.reference.pool import check_images
from appearance_opt.views import Views

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.reference.base import Reference
    from appearance_opt.views import Sampler

BLOCK = 8
"""Views of a ``Numbered`` sampler that are drawn at a time."""

SAMPLES = 9
"""Rays per pixel of images that are kept, at least: the first stage that sees a view may need
fewer than the last."""

MOST = 2 << 30
"""Bytes of images that are kept in memory; later ones are rendered whenever they are asked for."""


class Album:
    """A reference (see ``Reference``) whose images are kept.

    They are rendered with ``resolution`` pixels per side; smaller ones are averaged from them,
    larger ones are rendered each time. ``folder``: keeps them on disk, too, as half floats, for a
    job that goes on (None: does not); ``job`` says to which job they belong, so that no other takes
    them for its own.
    """

    def __init__(
        self, reference: Reference, resolution: int, folder: Path | None = None, job: str = ""
    ) -> None:
        self.reference, self.resolution, self.folder, self.job = reference, resolution, folder, job
        self._kept: dict[str, NDArray[np.float16]] = {}
        self._seconds, self._rendered = 0.0, 0
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    @property
    def bounds(self) -> NDArray[np.floating]:
        """See ``Reference``."""
        return self.reference.bounds

    @property
    def seconds(self) -> float:
        """Time that a view takes, as far as any was rendered."""
        return self._seconds / max(self._rendered, 1)

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]:
        """See ``Reference``."""
        if resolution > self.resolution:
            return self._rendered_now(views, resolution, samples)
        keys = [self._key(views[k : k + 1]) for k in range(len(views))]
        images: dict[str, NDArray] = {}
        for key in keys:
            image = self._find(key)
            if image is not None:
                images[key] = image
        missing = [k for k, key in enumerate(keys) if key not in images]
        # one by one: each is kept at once, whatever becomes of the next
        for k in missing:
            image = self._rendered_now(views[k : k + 1], self.resolution, max(samples, SAMPLES))[0]
            images[keys[k]] = self._keep(keys[k], image)
        shrink = averaging(self.resolution, resolution)
        return np.stack([_shrunk(images[key].astype(np.float32), shrink) for key in keys])

    def has(self, views: Views) -> int:
        """How many of the first views it has without rendering, up to the first that it lacks."""
        for k in range(len(views)):
            if self._find(self._key(views[k : k + 1])) is None:
                return k
        return len(views)

    def _rendered_now(self, views: Views, resolution: int, samples: int) -> NDArray[np.float32]:
        began = time.perf_counter()
        images = self.reference.render(views, resolution, samples)
        self._seconds += time.perf_counter() - began
        self._rendered += len(views)
        return images

    def _key(self, view: Views) -> str:
        return digest([self.job, self.resolution, *vars(view).values()])[:32]

    def _find(self, key: str) -> NDArray | None:
        if key in self._kept:
            return self._kept[key]
        path = self._path(key)
        if path is None or not path.is_file():
            return None
        try:
            image = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError):  # half written when an earlier run was killed
            return None
        if image.shape != (self.resolution, self.resolution, 4) or image.dtype != np.float16:
            return None
        self._kept[key] = image
        return image

    def _keep(self, key: str, image: NDArray[np.float32]) -> NDArray:
        check_images(image[None], 1, self.resolution, "one that is kept")
        halved = np.minimum(image, np.float32(65504)).astype(np.float16)
        if len(self._kept) * halved.nbytes < MOST:
            self._kept[key] = halved
        path = self._path(key)
        if path is not None:
            with path.open("wb") as file:
                np.save(file, halved)
        return halved

    def _path(self, key: str) -> Path | None:
        return None if self.folder is None else self.folder / f"{key}.npy"


def averaging(before: int, after: int) -> NDArray[np.float32]:
    """(after, before) weights that average rows of pixels over larger ones."""
    edges = np.arange(after + 1) * (before / after)
    pixels = np.arange(before)
    low, high = np.maximum(edges[:-1, None], pixels), np.minimum(edges[1:, None], pixels + 1)
    return (np.maximum(high - low, 0) * (after / before)).astype(np.float32)


def _shrunk(image: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    if weights.shape[0] == weights.shape[1]:
        return image
    rows = np.tensordot(weights, image, axes=(1, 0))
    return np.ascontiguousarray(np.tensordot(rows, weights, axes=(1, 1)).transpose(0, 2, 1))


@dataclass(frozen=True)
class Numbered:
    """A ``Sampler`` whose views are one sequence, however many are drawn at a time: stages of a job
    that draw differently see the same views."""

    sampler: Sampler

    @property
    def centre(self) -> tuple[float, float, float]:
        """See ``Sampler``."""
        return self.sampler.centre

    @property
    def radius(self) -> float:
        """See ``Sampler``."""
        return self.sampler.radius

    @property
    def seed(self) -> int:
        """See ``Sampler``."""
        return self.sampler.seed

    @property
    def stream(self) -> int:
        """See ``Sampler``."""
        return self.sampler.stream

    @property
    def hull(self) -> NDArray | None:
        """See ``Sampler``."""
        return self.sampler.hull

    @property
    def listed(self) -> int | None:
        """See ``Sampler``."""
        return self.sampler.listed

    def held_out(self, stream: int) -> Numbered:
        """See ``Sampler``."""
        return replace(self, sampler=self.sampler.held_out(stream))

    def draw(self, iteration: int, count: int) -> Views:
        """See ``Sampler``."""
        first, end = iteration * count, (iteration + 1) * count
        blocks = range(first // BLOCK, -(-end // BLOCK))
        drawn = Views.concatenate([self.sampler.draw(b, BLOCK) for b in blocks])
        return drawn[first - blocks.start * BLOCK : end - blocks.start * BLOCK]
