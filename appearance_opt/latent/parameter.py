"""Records of what is fitted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    import mitsuba as mi


@dataclass
class Parameter:
    """One fitted quantity: a flat device array of packets of ``channels`` floats.

    ``rate``: learning rates, one per channel (``channels`` values) or one per element (as wide as
    ``value``). ``low``, ``high``: bounds per channel, or None. ``smooth``: a symmetric linear map
    that preconditions its steps (see ``latent.smoothing``), or None.
    """

    name: str
    value: mi.Float
    channels: int
    rate: mi.Float
    low: mi.Float | None = None
    high: mi.Float | None = None
    smooth: Callable[[mi.Float], mi.Float] | None = None


@dataclass(frozen=True)
class Rates:
    """Learning rates at the start of a fit. ``position``: in units of the local edge length;
    ``displacement``: in units of the mean edge length of the finest tessellation; the others in the
    units of their maps (colours: square root of linear)."""

    position: float = 0.01
    normal: float = 0.01
    base_color: float = 0.005
    material: float = 0.005
    displacement: float = 0.01
    weight: float = 0.05
    opacity: float = 0.01
