"""What estimators of visibility have in common: what they see, and the boundaries in it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import drjit as dr
import mitsuba as mi

# not only for the type checker: Dr.Jit resolves the annotations of data classes when it looks for
# arrays
from appearance_opt.render.samples import Samples, Weighted, Whole

if TYPE_CHECKING:
    from appearance_opt.render.drawn import Drawn, Shown
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.pixels import Batch, Grid
    from appearance_opt.render.sampling import Sampling


class Boundary(Protocol):
    """Points at which what is seen jumps, and which move with the surface: a data class.

    ``pixel``: index of the pixel that changes; ``inside``, ``outside``: what is seen on the two
    sides; ``contrast``: colour inside less that outside, premultiplied RGB and coverage, None until
    they are shaded.
    """

    pixel: mi.UInt32
    inside: Samples
    outside: Samples
    contrast: mi.ArrayXf | None

    @property
    def measure(self) -> mi.Float:
        """Return the length or area that each point stands for, in pixels, per unit of
        ``motion``."""
        ...

    def motion(self, shown: Shown, batch: Batch) -> mi.Float:
        """Return where each point lies across the boundary, outward; differentiable in the
        vertices. Only its derivative means anything."""
        ...

    def corrected(self, image: mi.Float, rays: int, grid: Grid) -> mi.Float:
        """Return the image (pixels * 4) with what ``rays`` rays in each crossed pixel miss of the
        covered area, as far as these points know it."""
        ...


@dataclass
class Seen:
    """What an estimator sees of a batch.

    ``averaged``: the covered camera rays that are averaged in the image; ``whole``: pixels that are
    left out of it, with all of their rays (see ``Sampling.defer``); ``crossed``: indices of the
    pixels that boundaries change, each once; None without any. ``width``: texture filter of
    contrasts in pixels. ``rays``: in each crossed pixel, if boundaries are to correct the image for
    what these miss; None if nothing is missed. ``image``: (pixels * 4) that of ``averaged``, if the
    estimator had to shade it to see; the contrasts of its boundaries are known then.
    """

    averaged: Weighted | None
    whole: Whole | None
    crossed: mi.UInt32 | None
    width: mi.Float
    rays: int | None = None
    boundaries: list[Boundary] = field(default_factory=list)
    image: mi.Float | None = None


class Estimator:
    """How visibility is sampled and differentiated. ``walks``: does it need edges that can be
    walked over (``edge_list.walkable``)?"""

    @property
    def walks(self) -> bool:
        return False

    def check(self, sampling: Sampling) -> None:
        """Raise ValueError if it cannot do with such a sampling."""

    def see(self, drawn: Drawn, batch: Batch, sampling: Sampling, seed: int, run: Run) -> Seen:
        """Find what is seen, without gradients. ``seed``: of everything random; ``run``: how stages
        are called (see ``freezing``)."""
        raise NotImplementedError


class Finder(Protocol):
    """Looks for boundaries of one kind. ``walks``: as for ``Estimator``."""

    @property
    def walks(self) -> bool: ...

    def find(
        self, drawn: Drawn, batch: Batch, sampling: Sampling, seed: int, run: Run
    ) -> Boundary | None:
        """Find the boundaries, without their contrast; None without any. Arguments as for
        ``Estimator.see``."""
        ...


def changed_pixels(pixels: list[mi.UInt32], count: int) -> mi.Bool:
    """Mark (count,) which pixels of a batch are among lists of indices."""
    out = dr.zeros(mi.Bool, count)
    for some in pixels:
        dr.scatter(out, mi.Bool(True), some)
    dr.eval(out)
    return out
