"""What a latent is made of: parts, each of which knows one kind of content and nobody else does.

A part says how what is stored of it becomes what is drawn (``decode``), how gradients come back
(``pull_back``), and what it adds to a drawing: where vertices are (``place``), and maps
(``layers``). ``decode``, ``place``, ``layers``, ``track`` and ``pull_back`` are pure, so that their
kernels can be recorded (``render.freezing``): they read no array but their arguments and what
``fixed`` names.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

# not only for the type checker: Dr.Jit resolves the annotations of data classes when it looks for
# arrays
import mitsuba as mi

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.latent.parameter import Parameter, Rates
    from appearance_opt.render.material import Coverage, TexelLayer


@dataclass(frozen=True, eq=False)
class Pose:
    """What of a latent is drawn: the tessellation ``level``, of which each has its own kernels, and
    the ``frame`` of an animation (opaque, width 1: another one has the same kernels; None without
    an animation)."""

    level: int = 0
    frame: mi.UInt32 | None = None


class Guard(Protocol):
    """Keeps the values of a parameter out of states that images do not punish."""

    def undo(self, values: mi.Float, safe: mi.Float) -> tuple[mi.Float, int]:
        """(values without what is wrong, how much was wrong). ``safe``: values where nothing is;
        what was wrong goes back towards them."""


class Part:
    """A part of a latent, fitted or fixed.

    ``parameter``: what is stored of it, and its rates and bounds; None for a part that is fixed,
    which has no gradient and no moments, but a ``constant``: its decoded value. ``places``: whether
    it has a say in where vertices are. ``channels``: those of the material that it draws.
    """

    places = False

    def __init__(self, name: str, parameter: Parameter | None = None, constant: Any = None) -> None:
        self.name, self.parameter, self.constant = name, parameter, constant
        self.channels: tuple[str, ...] = ()

    def decode(self, stored: mi.Float) -> Any:
        """What is drawn of ``stored`` values: arrays, or a data class of such."""
        return stored

    def track(self, decoded: Any) -> Any:
        """A copy of a decoded value with gradients attached."""
        raise NotImplementedError

    def pull_back(self, tracked: Any, stored: mi.Float) -> mi.Float:
        """Gradient of the ``stored`` values, after the backward pass of a tracked value."""
        raise NotImplementedError

    def mesh(self, before: LatentMesh, level: int) -> LatentMesh:
        """The mesh that is drawn at a level. ``before``: what the parts before it draw."""
        return before

    def place(self, vertices: mi.Float, decoded: Any, pose: Pose) -> mi.Float:
        """Flat positions of the vertices of ``mesh``, differentiable in ``vertices`` (those of the
        parts before it; empty for the first) and in the decoded value."""
        return vertices

    def layers(self, decoded: Any) -> tuple[TexelLayer, ...]:
        """The maps that it adds to the material."""
        return ()

    def coverage(self, decoded: Any) -> Coverage | None:
        """What the material keeps back of the light behind it, if this part says so."""
        return None

    def fixed(self) -> tuple:
        """Everything that the pure functions read and that no step changes."""
        return (self.constant,)

    def set_rates(self, rates: Rates) -> None:
        """Take over learning rates. Called only if it is fitted."""

    def guard(self) -> Guard | None:
        """What keeps its values in order, relative to the start; None if nothing has to."""
        return None

    def export(self) -> dict[str, NDArray[np.float32]]:
        """Its current value on the host, in natural units, by name."""
        return {}

    def now(self) -> Any:
        """Its current decoded value."""
        return self.constant if self.parameter is None else self.decode(self.parameter.value)
