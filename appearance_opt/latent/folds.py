"""Triangles that a fit has turned over, and how they are turned back.

Steps along image gradients know nothing of triangles: small ones fold over their neighbours and
show their backs. To keep every step from it would cost each step time. Instead what a fit looks at,
and may hand out, is unfolded: vertices of folded triangles go back part of their way towards the
best state so far, which has no folds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

HALVINGS = 6
"""How often the way of a vertex is halved before it is undone."""


class Folds:
    """Folds of a mesh of fixed connectivity, relative to its start: a triangle is folded when its
    normal has turned by 90 degrees or more. ``positions`` (V, 3) of the start, ``faces`` (F, 3)."""

    def __init__(self, positions: NDArray, faces: NDArray) -> None:
        self._faces = faces
        self._normals = _normals(positions, faces)
        self._proper = np.any(self._normals != 0, axis=1)

    def folded(self, positions: NDArray) -> NDArray[np.bool_]:
        """(F,) folded triangles at ``positions`` (V, 3). Those without area at the start are
        none."""
        return self._proper & (
            np.sum(_normals(positions, self._faces) * self._normals, axis=1) <= 0
        )

    def undo(self, positions: mi.Float, safe: mi.Float) -> tuple[mi.Float, int]:
        """(flat positions (3 V) without folds, how many triangles were folded). Vertices of folded
        triangles go back half of their way to the positions ``safe``, where nothing is folded, then
        half of the rest, and so on; their neighbours follow if they have to. Without folds
        ``positions`` are handed back."""
        p, q = (np.array(x, np.float64).reshape(-1, 3) for x in (positions, safe))
        folded = self.folded(p)
        count = int(folded.sum())
        if not count:
            return positions, 0
        backs = np.zeros(len(p), np.int64)
        share = np.ones(len(p))
        while folded.any():
            here = np.unique(self._faces[folded])
            if not share[here].any():  # rounding: the safe positions themselves lie at the limit
                break
            backs[here] += 1
            share[here] = np.where(backs[here] > HALVINGS, 0.0, 0.5 * share[here])
            folded = self.folded((q + (p - q) * share[:, None]).astype(np.float32))
        way = mi.Float(np.repeat(share, 3).astype(np.float32))
        out = dr.fma(positions - safe, way, safe)
        dr.eval(out)
        return out, count


def _normals(positions: NDArray, faces: NDArray) -> NDArray[np.float64]:
    a, b, c = (np.asarray(positions, np.float64)[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)
