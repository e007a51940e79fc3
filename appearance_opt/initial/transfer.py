"""Closed-form transfer: the start of a fit, the reference's appearance in the maps of a simpler
mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

from appearance_opt.baking.closed_form import BakedMaps, Settings, bake

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.reference.survey import Survey

SAMPLES = 1
"""Rays per texel. More blur the maps: a texel is read bilinearly, which averages once already."""


def transfer(survey: Survey, mesh: LatentMesh, size: int, fill_hidden: bool = True) -> BakedMaps:
    """Base colour, roughness, metalness and tangent-space normals of the reference in ``size`` x
    ``size`` maps of ``mesh``. ``fill_hidden``: smooth where nothing outside can see the
    reference."""
    return bake(survey, mesh, Settings(size, samples=SAMPLES, fill_hidden=fill_hidden))


def transfer_emission(survey: Survey, mesh: LatentMesh, size: int) -> dict[str, NDArray | float]:
    """What the reference emits, in maps of ``mesh`` by channel name, or as numbers where it is the
    same everywhere; empty if it does not. Images under a light do not show it, so that no fit
    changes it."""
    if not survey.emits:
        return {}
    if survey.uniform_emission is not None:
        return {**survey.uniform_emission}
    return {
        **bake(survey, mesh, Settings(size, ("emission",), samples=SAMPLES, fill_hidden=True)).maps
    }
