"""What each step of a fit is to do: all that is random or scheduled in it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from appearance_opt.optimize.schedule import laplacian_weight, learning_rate
from appearance_opt.render.display import BACKGROUND as GREY
from appearance_opt.render.quality import Quality

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from appearance_opt.latent.parts import Pose

T = TypeVar("T")

LOSS_EVERY = 8
"""Steps between two evaluations of the loss: it is only shown, the gradient does not need it."""

FIXED_BACKGROUNDS = {"black": (0.0,) * 3, "white": (1.0,) * 3, "grey": (GREY,) * 3}
"""Linear RGB."""

Background = str | tuple[float, float, float]
"""random, black, white, grey, or linear RGB."""


@dataclass(frozen=True)
class FitOptions:
    """How to fit. ``steps``/``seconds``: when to stop (at least one, or ValueError). ``loss``: a
    name of ``losses.LOSSES``. ``laplacian``: weight relative to the first image loss, at a
    deviation of a tenth of an edge length (0: none). ``relative``: the start is a likeness: hold
    its Laplacian rather than 0, and hand out nothing that has left it in a way that images do not
    punish (see ``latent.folds``). ``decay``: powers of ten by which the rates fall over the fit.
    ``background``: behind latent and reference. ``quality``: how the latent is sampled; its point
    width is the pool's. ``validate_every``: fraction of the fit between looks at the held-out
    views. ``seed``: of backgrounds, poses and silhouette points; views have the sampler's."""

    steps: int | None = None
    seconds: float | None = None
    loss: str = "log-srgb-l1"
    laplacian: float = 0.25
    relative: bool = True
    decay: float = 1.5
    background: Background = "random"
    quality: Quality = field(default_factory=Quality)
    validate_every: float = 0.125
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps is None and self.seconds is None:
            raise ValueError("a fit needs an end: steps, seconds, or both")


@dataclass(frozen=True)
class StepPlan:
    """What a step is to do. ``background`` (B, 3): linear RGB behind each view; ``rate`` multiplies
    the rates of the parameters; ``laplacian``: in units of the regularizer's first weight;
    ``seed``: of silhouette points; ``want_loss``: evaluate the loss, too."""

    pose: Pose
    background: NDArray[np.float32]
    rate: float
    laplacian: float
    seed: int
    want_loss: bool


@dataclass(frozen=True)
class Plan:
    """The steps of a fit of ``views`` each. ``poses``: those that are drawn; ``rate``,
    ``laplacian``: see ``StepPlan``, by the part of the fit that is done (0 to 1)."""

    poses: tuple[Pose, ...]
    views: int
    background: Background
    seed: int
    rate: Callable[[float], float]
    laplacian: Callable[[float], float]

    @classmethod
    def of(cls, options: FitOptions, poses: tuple[Pose, ...], views: int) -> Plan:
        """The usual plan."""
        rate = partial(learning_rate, decades=options.decay)
        laplacian = partial(laplacian_weight, 1.0)
        return cls(poses, views, options.background, options.seed, rate, laplacian)

    def at(self, iteration: int, progress: float) -> StepPlan:
        """The plan of an iteration, when ``progress`` of the fit is done: the same whenever it is
        replayed."""
        return StepPlan(
            pose_of(self.poses, self.seed, iteration),
            backgrounds(self.background, self.views, self.seed, iteration),
            self.rate(progress),
            self.laplacian(progress),
            seed_of(self.seed, iteration),
            iteration % LOSS_EVERY == 0,
        )


def seed_of(seed: int, iteration: int) -> int:
    """Seed of an iteration's silhouette points: 32 bits, the same whenever it is replayed."""
    return int(np.random.default_rng([seed, 17, iteration]).integers(2**32))


def pose_of(poses: Sequence[T], seed: int, iteration: int) -> T:
    """The pose of an iteration: drawn at random, the same whenever it is replayed."""
    if len(poses) == 1:
        return poses[0]
    return poses[int(np.random.default_rng([seed, 13, iteration]).integers(len(poses)))]


def backgrounds(
    background: Background, count: int, seed: int, iteration: int
) -> NDArray[np.float32]:
    """(count, 3) linear colours behind the views of an iteration. Random ones make every silhouette
    visible, whatever the colour of the object."""
    if background == "random":
        return np.random.default_rng([seed, 7, iteration]).random((count, 3)).astype(np.float32)
    color = FIXED_BACKGROUNDS[background] if isinstance(background, str) else background
    return np.tile(np.asarray(color, np.float32), (count, 1))
