"""Starts whose shape is far from its goal: grown from a sphere, where there is no mesh to decimate,
or mended from a mesh that another tool has spoilt.

The sphere gets several times the triangles of the budget, small maps, small views and
preconditioned steps (``latent.smoothing``): shape first. What comes out is decimated to the budget
like any other mesh, which puts triangles where the shape needs them (a sphere that was pulled into
limbs has few at their ends), and its maps are transferred to an atlas of full size.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.config import with_values
from appearance_opt.errors import InputError
from appearance_opt.initial.atlas import unwrap
from appearance_opt.initial.decimate import decimate
from appearance_opt.initial.sphere import SMALLEST, random_maps, sphere
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.displacement import DISPLACEMENT
from appearance_opt.latent.export import to_asset
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.positions import Positions
from appearance_opt.optimize.loop import FitResult, fit
from appearance_opt.optimize.plan import FitOptions
from appearance_opt.optimize.validation import Validation
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.pool import ReferencePool
from appearance_opt.reference.survey import MeshSurvey
from appearance_opt.stages.displacement import flat_map
from appearance_opt.stages.fitting import VALIDATION_VIEWS, clean_maps, paced, pool_size
from appearance_opt.stages.hull import hull_mesh
from appearance_opt.stages.run import Run
from appearance_opt.stages.start import (
    Start,
    normals_of,
    require_survey,
    select_told,
    transfer_appearance,
)
from appearance_opt.views import VALIDATION

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from appearance_opt.config import SimplifyOptions
    from appearance_opt.reference.subject import Subject
    from appearance_opt.views import Sampler

log = logging.getLogger(__name__)

SHARE = 0.35
"""Part of the time (or of the steps) that goes into the shape."""

OVERSAMPLING = 3
"""Triangles of the sphere in units of the budget."""

TEXTURE, RESOLUTION, VIEWS, POOL, POOL_SAMPLES, POINT_WIDTH = 256, 160, 8, 320, 16, 0.7
TRIANGLES_PER_STRENGTH = 1500
"""Smoothing strength of the steps grows with the triangles, so that the same part of the surface
moves together."""

INSIDE, ROUND = 0.95, 0.6
"""Size of the first ellipsoid in units of the box of the object, and of the sphere in units of its
radius."""

RATES = Rates(normal=0.01, base_color=0.02, material=0.01)

POSITION_RATE = 0.12  # docs/trials.md: spheres
"""Rate of the positions for smoothing of strength 1, in units of the object's radius:
preconditioned steps know no edge length. It grows with the square root of the strength, for the
largest gradient sets the step of all vertices, and more smoothing takes more off it."""

MENDING = 0.5
"""Rate for a mesh that is spoilt, not unknown, in units of that of a sphere: it has less far to
go."""


@dataclass(frozen=True)
class Effort:
    """How long the shape is fitted (whichever comes first), and the job that it is a part of."""

    seconds: float | None
    steps: int | None
    run: Run = field(default_factory=Run)


def sphere_start(subject: Subject, options: SimplifyOptions, triangles: int) -> Start:
    """A sphere that knows nothing of the reference, with random maps and a flat displacement if
    there is to be one. Raises InputError if it would have too few triangles to be one."""
    if triangles < SMALLEST:
        raise InputError(f"--init sphere needs at least {SMALLEST} triangles, not {triangles}")
    size, sampler = options.texture.size, subject.sampler
    mesh = sphere(triangles, sampler.centre, 0.6 * sampler.radius, size)
    maps = unknown_maps(subject, options, size)
    known = np.zeros((size, size), bool)
    if not options.displacement.fitted:
        return Start(mesh, maps, False, known)
    return Start(
        mesh, {**maps, DISPLACEMENT: flat_map(mesh, options)}, False, known, options.levels()
    )


def unknown_maps(
    subject: Subject, options: SimplifyOptions, size: int
) -> dict[str, NDArray | float]:
    """Random maps where nothing is known of those of the reference."""
    with_normals = options.texture.normal_map and "normal" in options.fit.parts
    return select_told(subject.unlit, random_maps(size, options.views.seed, with_normals))


def grow_start(
    subject: Subject,
    options: SimplifyOptions,
    triangles: int,
    effort: Effort,
    hull: bool = False,
) -> tuple[Start, bool]:
    """(start, interrupted), grown from a sphere, or from the ``hull`` that silhouettes leave. Only
    images of the reference are used."""
    texture = min(TEXTURE, options.texture.size)
    if hull:
        mesh = hull_mesh(subject, OVERSAMPLING * triangles, texture)
    else:
        mesh = first_shape(triangles, subject.sampler, texture)
    maps = unknown_maps(subject, options, texture)
    pace = MENDING if hull else 1.0
    model, result = _fit_shape(subject, options, mesh, maps, pace, effort)
    likeness = to_asset(
        mesh, model.host_positions(), clean_maps(model, np.zeros((texture, texture), bool)), "grown"
    )
    source = MeshSurvey(MeshReference(likeness))
    grown = source.triangles
    positions, faces = decimate(grown.positions, grown.faces, triangles)
    if not len(faces):
        raise InputError("nothing is left of the grown mesh at that budget; ask for more triangles")
    follow = normals_of(source, options)
    atlas = unwrap(positions, faces, options.texture.size, follow=follow)
    start = transfer_appearance(source, atlas, options)
    return replace(start, grown=True), result.interrupted


def mend_start(
    subject: Subject,
    options: SimplifyOptions,
    spoilt: LatentMesh,
    effort: Effort,
) -> tuple[Start, bool]:
    """(start, interrupted): a spoilt mesh moved to where images want it, its triangles kept; atlas
    and maps are made anew. Neighbours move together, so that lost volume comes back and a patch
    that lies off moves as a whole, where steps of single vertices would crumple it."""
    small = with_values(options, texture_size=min(TEXTURE, options.texture.size))
    survey = require_survey(subject)
    maps = transfer_appearance(survey, spoilt, small).maps
    model, result = _fit_shape(subject, options, spoilt, maps, MENDING, effort)
    mesh = unwrap(
        model.host_positions(),
        spoilt.faces,
        options.texture.size,
        single=spoilt.single,
        follow=normals_of(survey, options),
    )
    return transfer_appearance(survey, mesh, options), result.interrupted


def _fit_shape(
    subject: Subject,
    options: SimplifyOptions,
    mesh: LatentMesh,
    maps: Mapping[str, NDArray | float],
    pace: float,
    effort: Effort,
) -> tuple[Latent, FitResult]:
    """A mesh with maps after preconditioned steps, ``pace`` times as large as for a sphere; the
    model is left at its best state."""
    reference, sampler = subject.reference, subject.sampler
    model = latent_of(mesh, maps, frozenset(options.fit.parts), RATES)
    strength, rate = smoothing(len(mesh.faces))
    positions = model.fitted(Positions)
    if positions is not None:
        positions.precondition(strength, pace * rate)
    pool = ReferencePool(
        reference,
        sampler,
        pool_size(sampler, POOL, VIEWS),
        VIEWS,
        RESOLUTION,
        POOL_SAMPLES,
        POINT_WIDTH,
        *paced(reference, sampler, options.views.reuse, VIEWS, RESOLUTION, effort.run),
    )
    validation = Validation(
        reference, sampler.held_out(VALIDATION).draw(0, VALIDATION_VIEWS), RESOLUTION
    )
    fit_options = FitOptions(
        steps=effort.steps,
        seconds=effort.seconds,
        loss=options.fit.loss,
        laplacian=0.0,
        relative=False,
        decay=1.0,
        background=options.views.background_color(),
        seed=options.views.seed,
    )
    effort.run.interrupts.protect()
    observers = effort.run.observers(resumable=False)
    result = fit(model, pool, validation, fit_options, observers)
    log.info(
        "shape by preconditioned steps: %d of them, %.2f dB", result.steps, result.curve[-1].psnr
    )
    return model, result


def smoothing(triangles: int) -> tuple[float, float]:
    """(strength, rate) of the preconditioned steps of a growing mesh."""
    strength = triangles / TRIANGLES_PER_STRENGTH
    return strength, POSITION_RATE * strength**0.5


def first_shape(triangles: int, sampler: Sampler, texture: int) -> LatentMesh:
    """What grows into a mesh of ``triangles``."""
    return stretch(sphere(OVERSAMPLING * triangles, (0.0, 0.0, 0.0), 1.0, texture), sampler)


def stretch(ball: LatentMesh, sampler: Sampler) -> LatentMesh:
    """The unit sphere around the origin as an ellipsoid that nearly fills the box that views are
    framed to (a sphere of ``ROUND`` of the sampler's radius where they are not framed). A round one
    leaves the ends of a long object to a few vertices, which do not arrive there while the steps
    are still large."""
    centre, half = np.asarray(sampler.centre, np.float64), np.full(3, ROUND * sampler.radius)
    if sampler.hull is not None:
        low, high = sampler.hull.min(axis=0), sampler.hull.max(axis=0)
        # not too flat: steps are limited, and opposite sides must not pass through each other
        centre, half = (low + high) / 2, INSIDE * np.maximum((high - low) / 2, 0.1 * sampler.radius)
    return replace(ball, positions=(ball.positions * half + centre).astype(np.float32))
