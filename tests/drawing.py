"""What a model shows, for tests that draw it without a fit."""

from __future__ import annotations

import mitsuba as mi

from appearance_opt.latent.latent import Latent
from appearance_opt.render.drawn import Drawn


def drawn_of(model: Latent, positions: mi.Float | None = None, walkable: bool = False) -> Drawn:
    """The model as it is now; its surface at flat ``positions`` (3 V), which may carry gradients,
    instead of its own. ``walkable``: with edges that can be walked over."""
    surface = None if positions is None else model.surface(positions)
    return model.drawn(surface=surface, walkable=walkable)
