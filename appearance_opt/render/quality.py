"""How finely a batch of images is sampled, and by what estimator silhouettes get their
gradients."""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt

VISIBILITY = ("edges", "pairs", "none")


@dataclass(frozen=True)
class Quality:
    """How visibility is sampled, and how its derivative is found.

    ``visibility``: "edges" (``silhouette``), "pairs" (``pairs``), or "none" (silhouettes have no
    gradient). ``edge_density``: silhouette points per pixel of silhouette (0: none);
    ``edge_samples``: camera rays in each pixel that a silhouette crosses; both for "edges" only.
    ``samples``: rays in all (other) pixels; for "pairs" a square number, as neighbours are compared
    on a regular grid. ``sample_width``, ``point_width``: texture filter in pixels of a pixel that
    is averaged, and of one that is a single point. ``intersections``: "edges" follow surfaces that
    run into each other, too, as pairs always do, by comparing neighbouring rays (price:
    docs/accuracy.md).
    """

    edge_density: float = 1.0
    edge_samples: int = 8
    samples: int = 1
    sample_width: float = 1.0
    point_width: float = 0.4
    visibility: str = "edges"
    intersections: bool = False

    def __post_init__(self) -> None:
        if self.visibility not in VISIBILITY:
            raise ValueError(f"visibility '{self.visibility}' is none of {', '.join(VISIBILITY)}")
        if self.visibility == "pairs" and isqrt(self.samples) ** 2 != self.samples:
            raise ValueError(f"pairs need a square number of samples per pixel, not {self.samples}")

    @property
    def walks(self) -> bool:
        """Are edge lists needed that can be walked over (``silhouette.walkable``)?"""
        return self.visibility == "pairs" or self.intersections
