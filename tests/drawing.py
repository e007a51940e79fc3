"""What a model shows, for tests that draw it without a fit."""

from __future__ import annotations

import mitsuba as mi

from appearance_opt.fit.model import Model
from appearance_opt.render.drawn import Drawn


def drawn_of(model: Model, positions: mi.Float | None = None, walkable: bool = False) -> Drawn:
    """The model as it is now; its surface at flat ``positions`` (3 V), which may carry gradients,
    instead of its own. ``walkable``: with edges that can be walked over."""
    surface = model.surface(model.positions() if positions is None else positions)
    edges = model.topology.walkable if walkable else model.topology.edges
    return Drawn(model.scene, surface, model.maps(model.fitted_layer()), edges)
