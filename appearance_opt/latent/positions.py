"""The part that says where the vertices of the base mesh are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.latent.folds import Folds
from appearance_opt.latent.mesh import local_edge_length
from appearance_opt.latent.parameter import Parameter
from appearance_opt.latent.parts import Part
from appearance_opt.latent.smoothing import Smoother

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.latent.parameter import Rates
    from appearance_opt.latent.parts import Pose

POSITIONS = "positions"
"""Name of the part."""


class Positions(Part):
    """Flat positions (3 V) of the welded vertices of a mesh, which starts where it is."""

    places = True

    def __init__(self, mesh: LatentMesh, fitted: bool) -> None:
        start = mi.Float(np.ascontiguousarray(mesh.positions, np.float32).ravel())
        parameter = Parameter(POSITIONS, start, 1, mi.Float(0)) if fitted else None
        super().__init__(POSITIONS, parameter, None if fitted else start)
        self._mesh = mesh

    def track(self, decoded: mi.Float) -> mi.Float:
        positions = mi.Float(decoded)
        dr.enable_grad(positions)
        return positions

    def pull_back(self, tracked: mi.Float, stored: mi.Float) -> mi.Float:
        return dr.grad(tracked)

    def place(self, vertices: mi.Float, decoded: mi.Float, pose: Pose) -> mi.Float:
        return decoded

    def set_rates(self, rates: Rates) -> None:
        assert self.parameter is not None
        edges = local_edge_length(self._mesh.positions, self._mesh.faces)
        self.parameter.rate = mi.Float(np.repeat(edges * rates.position, 3).astype(np.float32))

    def precondition(self, strength: float, rate: float) -> None:
        """Smooth the steps (see ``latent.smoothing``), with a ``rate`` in units of the
        positions."""
        assert self.parameter is not None
        mesh = self._mesh
        self.parameter.smooth = Smoother(len(mesh.positions), mesh.faces, strength)
        self.parameter.rate = mi.Float(rate)

    def guard(self) -> Folds:
        return Folds(self._mesh.positions, self._mesh.faces)

    def export(self) -> dict[str, NDArray[np.float32]]:
        return {POSITIONS: np.array(self.now()).reshape(-1, 3)}
