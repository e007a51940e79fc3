"""Where textures read: affine transforms of texture coordinates, as files give them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray


def affine(transform: Mapping[str, Any] | None) -> NDArray[np.float64]:
    """(2, 3) matrix of KHR_texture_transform: offset, then rotation, then scale, as the extension
    composes them."""
    t = transform or {}
    angle = float(t.get("rotation", 0.0))
    c, s = np.cos(angle), np.sin(angle)
    linear = np.array([[c, s], [-s, c]]) @ np.diag(np.array(t.get("scale", (1, 1)), np.float64))
    return np.concatenate([linear, np.array(t.get("offset", (0, 0)), np.float64)[:, None]], axis=1)


def usd_affine(
    scale: Sequence[float], rotation: float, translation: Sequence[float]
) -> NDArray[np.float64]:
    """(2, 3) matrix of UsdTransform2d (scale, then rotation in degrees, then translation), which
    counts v upward, for coordinates that count it downward."""
    angle = np.radians(rotation)
    c, s = np.cos(angle), np.sin(angle)
    (a, b), (p, q) = np.array([[c, -s], [s, c]]) @ np.diag(np.array(scale, np.float64))
    return np.array([[a, -b, b + translation[0]], [-p, q, 1 - q - translation[1]]])


def compose(then: NDArray, first: NDArray) -> NDArray[np.float64]:
    """(2, 3) matrix of two transforms after each other."""
    return np.concatenate(
        [then[:, :2] @ first[:, :2], (then[:, :2] @ first[:, 2] + then[:, 2])[:, None]], axis=1
    )


def apply(matrix: NDArray, points: NDArray) -> NDArray[np.float64]:
    """(N, 2) points under a (2, 3) matrix."""
    return points @ matrix[:, :2].T + matrix[:, 2]


@dataclass(frozen=True)
class UvTransform:
    """Where a texture reads: at ``matrix`` (2, 3) times the coordinates of the set number
    ``coordinates``.

    Until ``uv_unification.unify``, meshes whose material reads several sets hold them side by side
    in ``uvs``: (V, 2 * sets).
    """

    matrix: NDArray[np.float64] = field(default_factory=lambda: affine(None))
    coordinates: int = 0

    def of(self, uvs: NDArray) -> NDArray[np.float64]:
        """(V, 2) places in the texture."""
        return apply(self.matrix, uvs[:, 2 * self.coordinates : 2 * self.coordinates + 2])


@dataclass(frozen=True)
class Place:
    """The same for a set of coordinates that has a name, ``primvar``, and no number yet."""

    primvar: str = "st"
    matrix: NDArray[np.float64] = field(default_factory=lambda: affine(None))

    def equals(self, other: Place) -> bool:
        return self.primvar == other.primvar and np.allclose(self.matrix, other.matrix)

    def then(self, matrix: NDArray) -> Place:
        """The place after one more transform."""
        return replace(self, matrix=compose(matrix, self.matrix))


def stack_sets(sets: Sequence[NDArray | None]) -> NDArray | None:
    """Sets of texture coordinates (V, 2) side by side; what a mesh lacks is taken from the first
    that it has. None if it has none of them."""
    there = next((s for s in sets if s is not None), None)
    return (
        None if there is None else np.concatenate([there if s is None else s for s in sets], axis=1)
    )
