"""A shape given by its distance field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray


class Material(NamedTuple):
    """What a surface is made of: ``base_color`` linear RGB, ``roughness`` and ``metalness`` in
    [0, 1]. Each may be a number (RGB: three) or an array."""

    base_color: mi.Color3f | Sequence[float]
    roughness: mi.Float | float = 0.5
    metalness: mi.Float | float = 0.0


class Field(Protocol):
    """A distance field with a look.

    ``bounds`` (2, 3): least and greatest corner of a box that holds the whole surface.
    ``distance(p)``: signed distance of points to the surface, negative inside, or a bound of it: of
    no more than the true one. ``material(p)``: what the surface is made of at points of it.
    Coordinates are right-handed, y up by glTF's convention, of any unit.
    """

    @property
    def bounds(self) -> NDArray[np.floating]: ...

    def distance(self, p: mi.Point3f) -> mi.Float: ...

    def material(self, p: mi.Point3f) -> Material: ...


GREY = Material((0.5, 0.5, 0.5))
"""Of a shape that names none."""


@dataclass(frozen=True)
class Shape:
    """A ``Field`` of functions. ``bounds``: ((x, y, z), (x, y, z)), least corner first."""

    distance: Callable[[mi.Point3f], mi.Float]
    bounds: NDArray[np.floating] | Sequence[Sequence[float]]
    material: Callable[[mi.Point3f], Material] = lambda _: GREY


@dataclass(frozen=True)
class Placed:
    """A field of the world in local coordinates: world = centre + scale * local."""

    field: Field
    centre: tuple[float, float, float]
    scale: float

    @property
    def bounds(self) -> NDArray[np.floating]:
        """See ``Field``."""
        box = np.asarray(self.field.bounds, np.float64)
        return (box - np.array(self.centre)) / self.scale

    def distance(self, p: mi.Point3f) -> mi.Float:
        """See ``Field``."""
        return mi.Float(self.field.distance(self._world(p))) / self.scale

    def material(self, p: mi.Point3f) -> Material:
        """See ``Field``; all parts of it are arrays."""
        color, roughness, metalness = Material(*self.field.material(self._world(p)))
        return Material(mi.Color3f(*color), mi.Float(roughness), mi.Float(metalness))

    def to_world(self, points: NDArray) -> NDArray[np.float64]:
        """(N, 3) points of the world."""
        return np.asarray(points, np.float64) * self.scale + np.array(self.centre)

    def _world(self, p: mi.Point3f) -> mi.Point3f:
        return p * self.scale + mi.Point3f(*self.centre)
