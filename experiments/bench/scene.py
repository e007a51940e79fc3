"""What the benchmarks fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from appearance_opt.initial.sphere import random_maps, sphere
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.parameter import Rates
from appearance_opt.placement import Placement
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.views import ViewSampler
from scenes.analytic import bumpy_sphere


def set_up(
    latent: int, reference: int, maps: int, room: float = 1.0
) -> tuple[MeshReference, Latent, ViewSampler]:
    """A bumpy sphere, and a smooth coarse one with random maps as its latent. ``latent``,
    ``reference``: triangles; ``room``: width of a view in units of one that the sphere fills."""
    asset = bumpy_sphere(reference)
    source = MeshReference(Placement.around(asset.points()).local(asset))
    mesh = sphere(latent, (0.0, 0.0, 0.0), 0.93, maps)
    model = latent_of(
        mesh, random_maps(maps, 0, True), frozenset(("shape", "normal", "material")), Rates()
    )
    sampler = ViewSampler((0.0, 0.0, 0.0), 1.0)
    if room > 1:
        sampler = replace(
            sampler,
            hull=room * mesh.positions / np.linalg.norm(mesh.positions, axis=1, keepdims=True),
        )
    return source, model, sampler
