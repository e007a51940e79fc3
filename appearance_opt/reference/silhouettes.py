"""What silhouettes alone tell of a shape: the visual hull (Laurentini 1994), and where it lies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import distance_transform_edt

from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.views import Views

SEEN = 0.5
"""Coverage of a pixel that counts as inside."""

COARSE, SEARCHES = 40, 3
"""Cells per side of the grids that search for the bounds, and how many, each within what the one
before has left."""

FAR = 4.0
"""Cells outside beyond which a distance is not told more exactly."""


@dataclass(frozen=True)
class Silhouettes:
    """Coverage (B, R, R) in ``views``. ``open`` (B,): views whose border cuts the object off, so
    that what lies beyond it is unknown; beyond that of others there is nothing."""

    views: Views
    coverage: NDArray[np.float32]
    open: NDArray[np.bool_]

    @classmethod
    def of(cls, views: Views, images: NDArray[np.float32]) -> Silhouettes:
        """From images (B, R, R, 4), see ``Reference``. Raises InputError if one is empty."""
        coverage = np.ascontiguousarray(images[..., 3])
        empty = ~(coverage > SEEN).any(axis=(1, 2))
        if empty.any():
            raise InputError(f"view {int(empty.argmax())} shows nothing: its mask is empty")
        border = [coverage[:, 0], coverage[:, -1], coverage[:, :, 0], coverage[:, :, -1]]
        return cls(views, coverage, np.any([(b > SEEN).any(axis=1) for b in border], axis=0))

    @cached_property
    def _signed(self) -> NDArray[np.float32]:
        """(B, R, R) distance to the outline in pixels, positive inside."""
        inside = self.coverage > SEEN
        each = [distance_transform_edt(m) - distance_transform_edt(~m) for m in inside]
        # an outline lies between pixels; how far is what the coverage of the last one says
        near = np.clip(self.coverage - SEEN, -0.5, 0.5)
        return np.stack([e - 0.5 * np.sign(e) + n for e, n in zip(each, near, strict=True)]).astype(
            np.float32
        )

    def distances(
        self, low: NDArray, cell: float, shape: tuple[int, int, int]
    ) -> NDArray[np.float32]:
        """(X, Y, Z) about the signed distance to the hull, positive inside, at the nodes
        ``low + cell * index``: the least of those to the outlines of all views. Beyond ``FAR``
        cells outside it is cut off."""
        axes = [low[k] + cell * np.arange(n) for k, n in enumerate(shape)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        nodes = nodes.astype(np.float32)
        out = np.full(len(nodes), np.inf, np.float32)
        left = np.arange(len(nodes))
        for k in range(len(self.views)):
            out[left] = np.minimum(out[left], self._distance(k, nodes[left]))
            left = left[out[left] > -FAR * cell]
            if not len(left):
                break
        return np.maximum(out, -FAR * cell).reshape(shape)

    def _distance(self, k: int, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """(N,) the same of one view. Behind a camera nothing is known."""
        v, signed, n = self.views, self._signed[k], self.coverage.shape[1]
        toward = points - v.eye[k]
        depth = toward @ v.forward[k]
        square = float(v.right[k] @ v.right[k])
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = (
                (toward @ a[k] / (depth * square) + 1) * (n / 2) - 0.5 for a in (v.right, v.down)
            )
        ahead = depth > 1e-6
        x, y = (np.where(ahead, a, 0.0) for a in (x, y))
        inner_x, inner_y = (np.clip(a, 0, n - 1) for a in (x, y))
        beyond = np.hypot(x - inner_x, y - inner_y)
        x0, y0 = (np.minimum(a.astype(np.int64), n - 2) for a in (inner_x, inner_y))
        fx, fy = inner_x - x0, inner_y - y0
        upper = signed[y0, x0] * (1 - fx) + signed[y0, x0 + 1] * fx
        lower = signed[y0 + 1, x0] * (1 - fx) + signed[y0 + 1, x0 + 1] * fx
        pixels = upper * (1 - fy) + lower * fy
        outside = np.where(
            beyond > 0.5, np.inf if self.open[k] else np.minimum(pixels, -beyond), pixels
        )
        size = depth * (2 * np.sqrt(square) / n)
        return np.where(ahead, outside * size, np.inf).astype(np.float32)

    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) a box around the hull. Raises InputError if the outlines have no volume in
        common, which is so where images and cameras do not belong together."""
        middle, half = self._first_guess()
        low, high = middle - half, middle + half
        for _ in range(SEARCHES):
            cell = float((high - low).max()) / COARSE
            shape = tuple(int(s) for s in np.ceil((high - low) / cell).astype(int) + 1)
            # a node counts if the hull may reach into one of the cells around it
            near = self.distances(low, cell, shape) > -cell  # type: ignore[arg-type]
            if not near.any():
                raise InputError(
                    "the silhouettes of the images have no volume in common: images, masks and "
                    "cameras do not belong together"
                )
            found = np.argwhere(near)
            low, high = low + cell * (found.min(axis=0) - 1), low + cell * (found.max(axis=0) + 1)
        return np.stack([low, high])

    def _first_guess(self) -> tuple[NDArray[np.float64], float]:
        """(middle, half the width) of a cube that holds all that the views show: around the point
        that is nearest to the axes of all of them."""
        v = self.views
        forward, eye = v.forward.astype(np.float64), v.eye.astype(np.float64)
        across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
        middle = np.linalg.lstsq(
            across.sum(axis=0), np.einsum("bij,bj->i", across, eye), rcond=None
        )[0]
        distance = np.linalg.norm(eye - middle, axis=1)
        reach = distance * np.linalg.norm(v.right, axis=1)
        return middle, float((3.0 if self.open.any() else 1.5) * reach.max())
