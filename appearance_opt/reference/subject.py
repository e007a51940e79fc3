"""What a job works on: a reference in local coordinates, and all that is known of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.errors import ReferenceRenderError
from appearance_opt.placement import Placement
from appearance_opt.reference.base import PointReference
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.silhouettes import Silhouettes
from appearance_opt.reference.survey import MeshSurvey
from appearance_opt.views import ListedViews, Sampler, views_around

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.reference.base import Reference
    from appearance_opt.reference.folder import FolderReference
    from appearance_opt.reference.survey import Survey
    from appearance_opt.views import Views

OUTLINE = 192
"""Pixels per side of the silhouettes that tell where an object lies."""


@dataclass(frozen=True)
class Subject:
    """``reference`` draws it, within the unit sphere; ``placement``: where that lies in the world;
    ``sampler``: views of it. ``survey``: its surface, None of what only images are known of;
    ``asset``: what it was made from, in the world, None if that is no asset. ``static_light``: its
    light stands still, so that images tell colours with the light on them, and nothing else."""

    reference: Reference
    sampler: Sampler
    placement: Placement = field(default_factory=Placement)
    survey: Survey | None = None
    asset: Asset | None = None
    static_light: bool = False

    @classmethod
    def of_asset(
        cls, asset: Asset, seed: int = 0, light: str = "point", placement: Placement | None = None
    ) -> Subject:
        """An asset under a ``placement``, by default the one around it."""
        placement = Placement.around(asset.points()) if placement is None else placement
        reference = MeshReference(placement.local(asset))
        sampler = views_around(reference.merged.positions, seed, light)
        return cls(reference, sampler, placement, MeshSurvey(reference), asset)

    @classmethod
    def of_reference(cls, reference: Reference, seed: int = 0, light: str = "point") -> Subject:
        """Anything that has bounds and draws views, in coordinates of its own; its light stands
        still if it has ``static_light``. Raises ReferenceRenderError if its bounds are none."""
        corners = corners_of(reference.bounds)
        placement = Placement.around(corners)
        sampler = views_around(placement.to_local(corners), seed, light)
        static = bool(getattr(reference, "static_light", False))
        return cls(_placed(reference, placement), sampler, placement, static_light=static)

    @classmethod
    def of_pictures(cls, pictures: FolderReference, seed: int = 0) -> Subject:
        """A folder of pictures, in its own views. Raises InputError if its silhouettes have no
        volume in common."""
        bounds, views = pictures.bounds, pictures.views
        if bounds is None:
            images = pictures.render(views, OUTLINE, 1)
            bounds = Silhouettes.of(views, images).bounds()
        corners = corners_of(bounds)
        placement = Placement.around(corners)
        listed = ListedViews(
            placement.views_to_local(views), placement.to_local(corners), seed=seed
        )
        reference = PlacedReference(Boxed(pictures, bounds), placement)
        return cls(reference, listed, placement, static_light=pictures.static_light)

    def with_likeness(self, asset: Asset) -> Subject:
        """The same, with what is known of the surface taken from ``asset`` in the world; unlit
        where the light stands still."""
        if self.static_light:
            plain = (replace(m, material=replace(m.material, unlit=True)) for m in asset.meshes)
            asset = replace(asset, meshes=tuple(plain))
        return replace(self, survey=MeshSurvey(MeshReference(self.placement.local(asset))))

    @property
    def unlit(self) -> bool:
        """Does all of it show its base colour whatever the light?"""
        return self.static_light or (self.survey is not None and self.survey.unlit)


@dataclass(frozen=True)
class Boxed:
    """A reference whose ``bounds`` were found elsewhere."""

    reference: FolderReference
    bounds: NDArray[np.floating]

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]:
        """See ``Reference``."""
        return self.reference.render(views, resolution, samples)


@dataclass(frozen=True)
class PlacedReference:
    """A reference of the world, asked in local coordinates."""

    reference: Reference
    placement: Placement

    @property
    def bounds(self) -> NDArray[np.floating]:
        """See ``Reference``."""
        return self.placement.to_local(np.asarray(self.reference.bounds))

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]:
        """See ``Reference``."""
        return self.reference.render(self.placement.views_to_world(views), resolution, samples)


@dataclass(frozen=True)
class PlacedPointReference(PlacedReference):
    """The same for one that can look along single rays."""

    reference: PointReference

    def pair(
        self, views: Views, resolution: int, samples: int, width: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See ``PointReference``."""
        placed = self.placement.views_to_world(views)
        return self.reference.pair(placed, resolution, samples, width)


def _placed(reference: Reference, placement: Placement) -> Reference:
    if isinstance(reference, PointReference):
        return PlacedPointReference(reference, placement)
    return PlacedReference(reference, placement)


def corners_of(bounds: NDArray) -> NDArray[np.float64]:
    """(8, 3) the corners of a box (2, 3). Raises ReferenceRenderError if it is none."""
    box = np.asarray(bounds, np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] <= box[1]).all():
        raise ReferenceRenderError(
            "the bounds of the reference must be two points, the least and the greatest corner of a "
            f"box: finite numbers of shape (2, 3), not {box.tolist()}"
        )
    if not (box[1] > box[0]).any():
        raise ReferenceRenderError(f"the bounds of the reference are one point, {box[0].tolist()}")
    return np.array(list(product(*box.T)))
