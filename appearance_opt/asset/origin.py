"""Where an asset lies: an offset in double precision, so that positions relative to it stay small.

Scans and buildings come at map coordinates, up to 1e7 m from the origin: single precision has steps
of half a metre there, and swallows a detail of a millimetre. Readers give positions in double
precision, and what is far away for its size is moved to an origin of its own.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Mesh

    Origin = tuple[float, float, float]

ZERO: Origin = (0.0, 0.0, 0.0)

ROUNDING = 2.0**-24
"""Half a step of single precision, relative to the number."""

SHARE = 1e-6
"""Rounding of the farthest coordinate, as a share of the asset's longest side, from which on an
asset gets an origin of its own: that of what lies 17 times its size away."""


def settle(meshes: Sequence[Mesh], note: Callable[[str], None]) -> tuple[list[Mesh], Origin]:
    """(the meshes with positions in single precision, relative to an origin; that origin).

    ``meshes``: with positions of the world in double precision. ``note``: told of an origin. It is
    zero unless single precision would round the world's positions by more than ``SHARE`` of the
    asset's longest side. Otherwise it is the centre of the box around what faces use, rounded to a
    multiple of a power of two near the asset's size, so that programs which keep the place of a
    node in single precision move the asset by as little as possible.
    """
    origin = _origin_of(_boxes(meshes))
    if any(origin):
        place = ", ".join(f"{x:.15g}" for x in origin)
        note(f"it lies far from the origin: positions are kept relative to ({place}) m")
    offset = np.array(origin)
    moved = (m.positions - offset if any(origin) else m.positions for m in meshes)
    placed = [p.astype(np.float32) for p in moved]
    return [replace(m, positions=p) for m, p in zip(meshes, placed, strict=True)], origin


def _boxes(meshes: Iterable[Mesh]) -> NDArray[np.float64]:
    """(N, 3) corners of the boxes around the vertices that the faces of each mesh use. Faces and
    positions that ``repair`` will refuse do not count."""
    corners = [np.empty((0, 3))]
    for mesh in meshes:
        count = len(mesh.positions)
        used = np.zeros(count, bool)
        used[mesh.faces[(mesh.faces >= 0) & (mesh.faces < count)]] = True
        p = mesh.positions[used]
        p = p[np.isfinite(p).all(axis=1)]
        if len(p):
            corners.append(np.stack([p.min(axis=0), p.max(axis=0)]))
    return np.concatenate(corners).astype(np.float64)


def _origin_of(corners: NDArray[np.float64]) -> Origin:
    if not len(corners):
        return ZERO
    low, high = corners.min(axis=0), corners.max(axis=0)
    farthest, size = float(np.abs(corners).max()), float((high - low).max())
    if not 0 < size < np.inf or farthest * ROUNDING <= SHARE * size:
        return ZERO
    step = 2.0 ** np.floor(np.log2(size))
    x, y, z = (float(c) for c in np.rint((low / 2 + high / 2) / step) * step + 0.0)
    return (x, y, z)
