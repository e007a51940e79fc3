"""Where a job's own coordinates lie in the world.

A fit works on an object of radius 1 around the origin, so that no threshold in it and no digit of a
float depends on the scale and place of the input. This is the one place that knows the way there
and back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.origin import ZERO

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.views import Views


@dataclass(frozen=True)
class Placement:
    """World = centre + scale * local, in double precision. ``centre`` in the world, ``scale``:
    metres per unit."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    @classmethod
    def around(cls, points: NDArray) -> Placement:
        """The local origin in the middle of the axis-aligned box around ``points`` (N, 3), and as
        its unit the radius of the sphere around it that holds them all."""
        points = np.asarray(points, np.float64)
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        radius = float(np.sqrt(np.max(np.sum((points - centre) ** 2, axis=1))))
        return cls((float(centre[0]), float(centre[1]), float(centre[2])), max(radius, 1e-12))

    def to_local(self, points: NDArray) -> NDArray[np.float64]:
        """(N, 3) points of the world."""
        return (np.asarray(points, np.float64) - np.array(self.centre)) / self.scale

    def to_world(self, points: NDArray) -> NDArray[np.float64]:
        """(N, 3) local points."""
        return np.asarray(points, np.float64) * self.scale + np.array(self.centre)

    def views_to_world(self, views: Views) -> Views:
        """Local views: the same pictures of the same thing at its size and place in the world."""
        eye, light = (self.to_world(p).astype(np.float32) for p in (views.eye, views.light))
        intensity = (views.intensity * self.scale**2).astype(np.float32)
        return replace(views, eye=eye, light=light, intensity=intensity)

    def views_to_local(self, views: Views) -> Views:
        """The reverse."""
        eye, light = (self.to_local(p).astype(np.float32) for p in (views.eye, views.light))
        intensity = (views.intensity / self.scale**2).astype(np.float32)
        return replace(views, eye=eye, light=light, intensity=intensity)

    def local(self, asset: Asset) -> Asset:
        """The asset in local coordinates; it has no origin of its own then."""
        relative = self.relative_to(asset.origin)
        moved = (
            replace(m, positions=relative.to_local(m.positions).astype(np.float32))
            for m in asset.meshes
        )
        return replace(asset, meshes=tuple(moved), origin=ZERO)

    def relative_to(self, origin: tuple[float, float, float]) -> Placement:
        """The same placement in a world that is counted from ``origin`` (see ``Asset.origin``)."""
        x, y, z = np.array(self.centre) - np.array(origin)
        return Placement((float(x), float(y), float(z)), self.scale)
