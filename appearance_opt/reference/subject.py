"""What a job works on: a reference in local coordinates, and all that is known of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.errors import ReferenceRenderError
from appearance_opt.placement import Placement
from appearance_opt.reference.base import PointReference
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.survey import MeshSurvey
from appearance_opt.views import ViewSampler, views_around

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.reference.base import Reference
    from appearance_opt.reference.survey import Survey
    from appearance_opt.views import Views


@dataclass(frozen=True)
class Subject:
    """``reference`` draws it, within the unit sphere; ``placement``: where that lies in the world;
    ``sampler``: views of it. ``survey``: its surface, None of what only images are known of;
    ``asset``: what it was made from, in the world, None if that is no asset."""

    reference: Reference
    sampler: ViewSampler
    placement: Placement = field(default_factory=Placement)
    survey: Survey | None = None
    asset: Asset | None = None

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
        """Anything that has bounds and draws views, in coordinates of its own. Raises
        ReferenceRenderError if its bounds are none."""
        corners = corners_of(reference.bounds)
        placement = Placement.around(corners)
        sampler = views_around(placement.to_local(corners), seed, light)
        kind = PlacedPointReference if isinstance(reference, PointReference) else PlacedReference
        return cls(kind(reference, placement), sampler, placement)  # type: ignore[arg-type]

    @property
    def unlit(self) -> bool:
        """Does all of it show its base colour whatever the light?"""
        return self.survey is not None and self.survey.unlit


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
