"""Which faces are seen from one side only."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Mesh


def single_sided(meshes: tuple[Mesh, ...]) -> NDArray[np.bool_]:
    """(F,) faces of all meshes, one mesh after the other, that are seen from their front only."""
    return np.repeat([not m.material.double_sided for m in meshes], [len(m.faces) for m in meshes])
