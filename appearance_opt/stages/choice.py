"""Which start a fit gets, by what the options ask for."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, TypeVar

from appearance_opt.config import SimplifyOptions, with_values
from appearance_opt.stages.decimated import decimate_start
from appearance_opt.stages.growth import SHARE, Effort, grow_start, mend_start, sphere_start
from appearance_opt.stages.start import (
    budget,
    inherit_owners,
    inherit_sides,
    require_survey,
    transfer_appearance,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.reference.subject import Subject
    from appearance_opt.stages.run import Run
    from appearance_opt.stages.start import Start


Chosen = TypeVar("Chosen", bound=SimplifyOptions)


def choose_start(
    subject: Subject, given: LatentMesh | None, options: Chosen, run: Run
) -> tuple[Start, Chosen]:
    """(start, options of the fit that follows). ``given``: the mesh that ``options.start.init``
    names, None if it names none. A shape that is far from its goal is fitted first, in a part of
    the time or the steps."""
    o, survey = options, subject.survey
    available = None if survey is None else len(survey.triangles.faces)
    alone = "shape" in o.fit.parts and not o.displacement.fitted
    if given is not None and o.fit.relative is False and alone:
        start, o = _fit_shape(lambda effort: mend_start(subject, options, given, effort), o, run)
        o = with_values(o, relative=None)  # the mended shape is a likeness
    elif given is not None:
        start = _make(lambda: transfer_appearance(require_survey(subject), given, options), run)
    elif o.start.init == "sphere" and alone:
        count = budget(o, available)
        start, o = _fit_shape(lambda effort: grow_start(subject, options, count, effort), o, run)
    elif o.start.init == "hull" or (o.start.init == "auto" and survey is None):
        count = budget(o, available)
        grow = partial(grow_start, subject, options, count, hull=True)
        start, o = _fit_shape(grow, o, run)
    elif o.start.init == "sphere":
        count = budget(o, available)
        start = _make(lambda: sphere_start(subject, options, count), run)
    else:
        count, left = budget(o, available), run.seconds_left()
        start = _make(lambda: decimate_start(subject, options, count, left, run.begin), run)
    if survey is None:
        return start, o
    start = inherit_sides(start, survey.triangles.single)
    return inherit_owners(start, survey.triangles), o


def _make(make: Callable[[], Start], run: Run) -> Start:
    return run.make_or_resume(lambda: (make(), False))[0]


def _fit_shape(
    make: Callable[[Effort], tuple[Start, bool]], options: Chosen, run: Run
) -> tuple[Start, Chosen]:
    """(a start whose shape is fitted first, options of what is left of the fit)."""
    seconds = run.seconds_left()
    steps = 1000 if options.fit.steps is None and seconds is None else options.fit.steps
    share = None if steps is None else round(SHARE * steps)
    effort = Effort(None if seconds is None else SHARE * seconds, share, run)
    start, interrupted = run.make_or_resume(lambda: make(effort))
    if interrupted:  # Ctrl-C ends both fits
        return start, with_values(options, steps=0)
    if steps is None or share is None:
        return start, options
    return start, with_values(options, steps=steps - share)
