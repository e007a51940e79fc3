"""How finely a batch of images is sampled, and by what estimator boundaries get their
gradients."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.boundary.estimator import Estimator
from appearance_opt.render.boundary.peeled import Peeled
from appearance_opt.render.sampling import Sampling


@dataclass(frozen=True)
class Quality(Sampling):
    """A ``Sampling``, and how visibility and its derivative are found: ``CameraRays`` with the
    finders of boundaries that it is given, or ``Pairs``. Raises ValueError where the two do not fit
    together."""

    visibility: Estimator = field(default_factory=CameraRays)

    def __post_init__(self) -> None:
        self.visibility.check(self)

    def peeling(self) -> Quality:
        """Return the same for what is seen through: layers are peeled, if they are not yet."""
        if isinstance(self.visibility, Peeled):
            return self
        return replace(self, visibility=Peeled())

    @property
    def walks(self) -> bool:
        """Are edge lists needed that can be walked over (``edge_list.walkable``)?"""
        return self.visibility.walks
