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
