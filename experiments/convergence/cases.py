"""What is fitted: a reference, a start that is wrong in its own way, and how a fit would treat
it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset import load
from appearance_opt.config import simplify_options
from appearance_opt.initial.sphere import random_maps
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.positions import Positions
from appearance_opt.optimize.plan import FitOptions
from appearance_opt.optimize.validation import Validation
from appearance_opt.reference.pool import ReferencePool
from appearance_opt.reference.subject import Subject
from appearance_opt.stages import growth
from appearance_opt.stages.decimated import decimate_start
from appearance_opt.stages.fitting import POOL_SAMPLES, VALIDATION_VIEWS, fit_policy, point_width
from appearance_opt.stages.start import Start
from appearance_opt.views import VALIDATION
from experiments.common import Placed, asset

if TYPE_CHECKING:
    from pathlib import Path

TEXTURE = 512
LOOKED_AT = 128
"""Resolution of the held-out views: 9 rays in each pixel."""


@dataclass(frozen=True)
class Case:
    """``make`` returns a fresh model at its start; ``pool`` holds all its images already;
    ``options`` lack the time."""

    name: str
    make: Callable[[], Latent]
    pool: ReferencePool
    validation: Validation
    options: FitOptions


def names() -> list[str]:
    return ["sphere", "decimated", "sub-pixel"]


def source(name: str) -> Path:
    """The reference of the case of that name. Raises ``common.Missing``."""
    return asset("spot/spot.obj" if name == "sphere" else "flight_helmet/FlightHelmet.gltf")


def make_case(name: str, seed: int) -> Case:
    """The case of that name, its reference rendered. ``seed``: of views, backgrounds and random
    maps."""
    placed = Placed(load(source(name)), seed)
    make = {"sphere": _from_sphere, "decimated": _decimated, "sub-pixel": _sub_pixel}[name]
    case = make(placed.subject, seed)
    for group in range(case.pool.capacity // case.pool.batch):
        case.pool.draw(group)
    return case


def _validation(subject: Subject) -> Validation:
    views = subject.sampler.held_out(VALIDATION).draw(0, VALIDATION_VIEWS)
    return Validation(subject.reference, views, LOOKED_AT)


def _from_sphere(subject: Subject, seed: int) -> Case:
    """A sphere of 4,212 triangles becomes spot, with the preconditioned steps of
    ``stages.growth``."""
    mesh = growth.first_shape(1404, subject.sampler, growth.TEXTURE)
    maps = random_maps(growth.TEXTURE, seed, True)

    def make() -> Latent:
        model = latent_of(mesh, maps, frozenset(("shape", "normal", "material")), growth.RATES)
        positions = model.fitted(Positions)
        assert positions is not None
        positions.precondition(*growth.smoothing(len(mesh.faces)))
        return model

    pool = ReferencePool(
        subject.reference,
        subject.sampler,
        growth.POOL,
        growth.VIEWS,
        growth.RESOLUTION,
        growth.POOL_SAMPLES,
        growth.POINT_WIDTH,
    )
    options = FitOptions(laplacian=0.0, decay=1.0, seed=seed)
    return Case("sphere", make, pool, _validation(subject), options)


def _decimated(subject: Subject, seed: int) -> Case:
    """flight_helmet with 1,367 triangles, 4 views of 256^2 pixels: the usual fit."""
    return _from_mesh("decimated", subject, seed, 1367, 256, 4, None)


def _sub_pixel(subject: Subject, seed: int) -> Case:
    """flight_helmet with 9,000 triangles on 64^2 pixels: smaller than a pixel each. Bent by waves
    of 2 % of the object's radius, for a good start has no shape to find."""
    return _from_mesh("sub-pixel", subject, seed, 9000, 64, 16, 0.02)


def _from_mesh(
    name: str,
    subject: Subject,
    seed: int,
    triangles: int,
    resolution: int,
    views: int,
    bend: float | None,
) -> Case:
    options = simplify_options("default", triangles=triangles, texture_size=TEXTURE, reallocate=0)
    start = decimate_start(subject, options, triangles)
    if bend is not None:
        start = _bent(start, bend)
    pool = ReferencePool(
        subject.reference,
        subject.sampler,
        320,
        views,
        resolution,
        POOL_SAMPLES,
        point_width(resolution, TEXTURE),
    )
    validation = _validation(subject)

    def fresh(rates: Rates) -> Latent:
        return latent_of(start.mesh, start.maps, frozenset(("shape", "normal", "material")), rates)

    _, rates = fit_policy(validation.psnr(fresh(Rates())), True)
    # a bent start must not be held in its shape
    fit_options = FitOptions(laplacian=options.fit.laplacian if bend is None else 0.0, seed=seed)
    return Case(name, lambda: fresh(rates), pool, validation, fit_options)


def _bent(start: Start, amount: float) -> Start:
    """The same start under a smooth deformation: a plane wave along each axis."""
    p = start.mesh.positions.astype(np.float64)
    waves: NDArray = np.sin(
        p @ np.array([[4.1, 1.9, 0.6], [1.1, 3.7, 2.2], [2.5, 0.8, 4.4]]).T + [0.3, 1.7, 2.9]
    )
    return replace(
        start, mesh=replace(start.mesh, positions=(p + amount * waves).astype(np.float32))
    )
