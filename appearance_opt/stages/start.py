"""The start of a fit: a mesh with an atlas and maps, from what the options ask for."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.sides import culled
from appearance_opt.errors import InputError
from appearance_opt.initial.atlas import make_charts, pack_charts, unwrap
from appearance_opt.initial.clustering import cluster
from appearance_opt.initial.decimate import decimate_with_source
from appearance_opt.initial.density import chart_scales
from appearance_opt.initial.reallocate import StartError, weights
from appearance_opt.initial.sphere import SMALLEST as SMALLEST_SPHERE
from appearance_opt.initial.sphere import random_maps, sphere
from appearance_opt.initial.transfer import transfer
from appearance_opt.initial.visibility import importance, pixel_counts
from appearance_opt.latent.displacement import DISPLACEMENT
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.render import upload
from appearance_opt.render.material import COLORS, UNLIT
from appearance_opt.stages.displacement import (
    REACH,
    bake_displacement,
    flat_map,
    gutter,
    median_edge,
    require_memory,
)
from appearance_opt.stages.parts import split
from appearance_opt.views import START, VISIBILITY

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.config import SimplifyOptions
    from appearance_opt.placement import Placement
    from appearance_opt.reference.subject import Subject
    from appearance_opt.reference.survey import Survey

log = logging.getLogger(__name__)

VISIBILITY_VIEWS = 160

REALLOCATION_SHARE = 0.4  # docs/trials.md: reallocation
"""Part of the time left after the first start that moving triangles may take."""

REALLOCATION_EXTRA = 1.5  # docs/trials.md: reallocation
"""What moving triangles takes apart from its rounds, in first starts: images of the reference, and
the spread of the texels."""

WORTHWHILE = 0.98  # docs/trials.md: reallocation
"""Error of a start with moved triangles, relative to the one before, up to which it takes its
place."""

SECONDS_PER_FACE, COARSE_SHARE = 2e-5, 0.25  # docs/trials.md: decimation
"""What decimation takes per face of the reference, and the part of a time budget from which it
begins with a coarse round (see ``clustering``). The same on every machine, so that the same options
make the same start."""

CLUSTERS, LEAST_CLUSTERS = 40, 100_000
"""Vertices that a coarse round leaves, per triangle that is asked for, and at the least."""

TIGHT_TRIANGLES = 10_000
"""Largest mesh whose atlas is packed by trying every place: the time grows with the square of the
charts."""


@dataclass(frozen=True)
class Start:
    """``maps``: channel name -> image or number; ``relative``: may the Laplacian keep this shape?
    ``known``: texels whose values mean something. ``levels``: tessellation levels at which it is
    drawn; ``finest``: the displaced mesh of the finest one, None without displacement. ``grown``:
    was it found by fitting (from a sphere)? ``charts``: the mesh with its charts as they were
    before they were packed, if they were kept. ``notes``: what the user should know of how it was
    made."""

    mesh: LatentMesh
    maps: dict[str, NDArray | float]
    relative: bool
    known: NDArray[np.bool_]
    levels: tuple[int, ...] = (0,)
    finest: LatentMesh | None = None
    grown: bool = False
    charts: LatentMesh | None = None
    notes: tuple[str, ...] = ()

    @property
    def drawn(self) -> LatentMesh:
        """The mesh that is seen."""
        return self.mesh if self.finest is None else self.finest


def budget(options: SimplifyOptions, available: int) -> int:
    """Triangles asked for. Raises InputError when the input has fewer, or when their tessellation
    does not fit into memory."""
    count = options.start.triangles
    if count is None:
        assert options.start.ratio is not None
        count = min(max(4, round(options.start.ratio * available)), available)
    if count > available:
        raise InputError(
            f"--triangles {count}: the input has only {available} triangles; ask for fewer"
        )
    require_memory(count, options)
    return count


def make_start(
    subject: Subject,
    options: SimplifyOptions,
    triangles: int,
    seconds: float | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> Start:
    """Sphere, or decimated reference. ``seconds``: what is left for start and fit (None: no limit).
    ``tell``: called with what begins, in a few words."""
    size, sampler = options.texture.size, subject.sampler
    if options.start.init == "sphere":
        if triangles < SMALLEST_SPHERE:
            raise InputError(
                f"--init sphere needs at least {SMALLEST_SPHERE} triangles, not {triangles}"
            )
        mesh = sphere(triangles, sampler.centre, 0.6 * sampler.radius, size)
        maps = select_told(
            subject.unlit,
            random_maps(
                size,
                options.views.seed,
                options.texture.normal_map and "normal" in options.fit.parts,
            ),
        )
        known = np.zeros((size, size), bool)
        if options.displacement.fitted:
            return Start(
                mesh,
                {**maps, DISPLACEMENT: flat_map(mesh, options)},
                False,
                known,
                options.levels(),
            )
        return Start(mesh, {**maps}, False, known)
    starts = _Decimated(subject, options, triangles, tell)
    began = time.perf_counter()
    start = starts.decimate(starts.weight)
    taken = time.perf_counter() - began
    if starts.coarse:
        left_out = "decimation began with a coarse round, and triangles were not moved to where they are missed"
        many = f"{starts.given:,} triangles are many for --budget {options.fit.budget:g}"
        return replace(start, notes=(f"{many}: {left_out}",))
    rounds = affordable(
        options.start.reallocate, taken, None if seconds is None else seconds - taken
    )
    if not rounds:
        return start
    judge = StartError(subject.reference, starts.survey.triangles, starts.views)
    start, error = starts.move_triangles(start, judge, rounds)
    again = starts.spread_texels(start, len(start.mesh.faces) <= TIGHT_TRIANGLES)
    return again if judge.measure(again.drawn, again.maps)[0] < error else start


def affordable(rounds: int, taken: float, left: float | None) -> int:
    """Rounds of reallocation, of those asked for, that leave most of the time that is ``left`` to
    the fit when one takes about as long as the first start has ``taken``, and all of them
    ``REALLOCATION_EXTRA`` times as long besides. Both in seconds; None: no limit."""
    if left is None or taken <= 0:
        return rounds
    return min(rounds, max(int(REALLOCATION_SHARE * left / taken - REALLOCATION_EXTRA), 0))


def is_coarse(faces: int, vertices: int, clusters: int, budget: float | None) -> bool:
    """Does decimation of a mesh begin with a coarse round? If it would take much of the time budget
    (seconds), and if that leaves half of the vertices at the most."""
    return (
        budget is not None
        and SECONDS_PER_FACE * faces > COARSE_SHARE * budget
        and 2 * clusters < vertices
    )


class _Decimated:
    """Starts from the reference with fewer triangles. ``coarse``: is it clustered first, as it is
    too large for the time budget? ``given``: faces of the reference; ``positions``, ``faces``,
    ``single``: what is decimated, its own or the clusters'; ``weight``: importance of these faces
    by how much is seen of them; ``visible``: those that are decimated at all; ``views``: views that
    neither the fit nor its validation uses."""

    positions: NDArray
    faces: NDArray

    def __init__(
        self,
        subject: Subject,
        options: SimplifyOptions,
        triangles: int,
        tell: Callable[[str], None],
    ) -> None:
        self.tell, self.options, self.triangles = tell, options, triangles
        self.survey, sampler = require_survey(subject), subject.sampler
        self.views = sampler.held_out(START)
        heavy = self.survey.triangles
        self.positions, self.faces, self.single = heavy.positions, heavy.faces, heavy.single
        scene, self.given = heavy.scene, len(heavy.faces)
        clusters = max(CLUSTERS * triangles, LEAST_CLUSTERS)
        self.coarse = is_coarse(self.given, len(heavy.positions), clusters, options.fit.budget)
        if self.coarse:
            tell("clustering vertices")
            self.positions, self.faces, source = cluster(self.positions, self.faces, clusters)
            self.single = self.single[source]
            scene = upload.scene_of(
                self.positions, self.faces, culled(self.positions, self.faces, self.single)
            )
        count = len(self.faces)
        self.weight, self.visible = np.ones(count), np.ones(count, bool)
        if not options.start.keep_hidden:
            tell("looking for what can be seen")
            pixels = pixel_counts(scene, count, sampler.held_out(VISIBILITY), VISIBILITY_VIEWS)
            self.weight, seen = importance(self.positions, self.faces, pixels)
            self.visible = seen if seen.sum() >= triangles else self.visible

    def decimate(self, weight: NDArray) -> Start:
        """The reference decimated with these importances of its faces (F,)."""
        single = self.single[self.visible]
        positions, faces, source = decimate_with_source(
            self.positions,
            self.faces[self.visible],
            self.triangles,
            weight[self.visible],
            single,
            told=lambda left: self.tell(f"decimating: {left:,} triangles left"),
        )
        if not len(faces):
            raise InputError("nothing is left of this mesh at that budget; ask for more triangles")
        self.tell(f"unwrapping {len(faces):,} triangles")
        return self._pack_and_bake(
            make_charts(positions, faces, single[source]), np.ones(len(faces)), False
        )

    def move_triangles(self, start: Start, judge: StartError, rounds: int) -> tuple[Start, float]:
        """The best of a start and those with triangles moved to where its image error is, and its
        error."""
        heavy, weight = self.survey.triangles, self.weight
        best, (error, by_face) = start, judge.measure(start.drawn, start.maps)
        for number in range(1, rounds + 1):
            weight = weight * weights(heavy.positions, heavy.faces, by_face, self.visible)
            candidate = self.decimate(weight)
            again, by_face = judge.measure(candidate.drawn, candidate.maps)
            log.info(
                "triangles moved, round %d: squared error of the start %.3g -> %.3g",
                number,
                error,
                again,
            )
            if again < WORTHWHILE * error:
                best, error = candidate, again
        return best, error

    def spread_texels(self, start: Start, tight: bool) -> Start:
        """The same triangles, with texels moved to where they are seen to be missing.
        ``tight``: see ``pack_charts``."""
        assert start.charts is not None
        scale = np.ones(len(start.mesh.faces))
        # displaced vertices read the rim of a chart on both of its sides, which asks for the same
        # texels everywhere
        if not self.options.displacement.fitted:
            scale = chart_scales(start.mesh, start.maps, self.views)
        return self._pack_and_bake(start.charts, scale, tight)

    def _pack_and_bake(self, charts: LatentMesh, scale: NDArray, tight: bool) -> Start:
        options = self.options
        self.tell("packing the atlas and baking its maps")
        mesh = pack_charts(
            charts, scale, options.texture.size, gutter(len(charts.faces), options), tight
        )
        return replace(transfer_appearance(self.survey, mesh, options), charts=charts)


def require_survey(subject: Subject) -> Survey:
    """The surface of a subject. Raises InputError if only images are known of it."""
    if subject.survey is None:
        raise InputError(
            "images are all that is known of this reference: start from a mesh or a sphere"
        )
    return subject.survey


def select_told(unlit: bool, maps: Mapping[str, NDArray | float]) -> dict[str, NDArray | float]:
    """Those of a start's maps that images of the reference tell of: where it is ``unlit``, colours
    alone."""
    return {**{n: maps[n] for n in COLORS}, UNLIT: 1.0} if unlit else dict(maps)


def transfer_appearance(survey: Survey, mesh: LatentMesh, options: SimplifyOptions) -> Start:
    """A mesh with the reference's appearance in its maps."""
    finest = None
    displacement: dict[str, NDArray] = {}
    if options.displacement.fitted:
        finest, displacement = bake_displacement(survey, mesh, options, REACH * median_edge(mesh))
    result = transfer(
        survey,
        mesh if finest is None else finest,
        options.texture.size,
        not options.start.keep_hidden,
    )
    missed = result.missed.sum() / max(int(result.covered.sum()), 1)
    if missed > 0.01:
        log.warning(
            "the transfer found no reference point for %.1f %% of the texels; they were filled",
            100 * missed,
        )
    maps = {
        n: v
        for n, v in result.maps.items()
        if options.texture.normal_map or not n.startswith("normal")
    }
    return Start(
        mesh,
        {**select_told(survey.unlit, maps), **displacement},
        True,
        result.covered,
        options.levels(),
        finest,
    )


def inherit_sides(start: Start, single: NDArray[np.bool_]) -> Start:
    """A start whose triangles stem from none of the reference's, of which those in ``single`` are
    seen from their front only: so are all of its triangles if all of these are."""
    if start.mesh.single is not None or not single.all():
        return start
    meshes = (
        None if m is None else replace(m, single=np.ones(len(m.faces), bool))
        for m in (start.mesh, start.finest)
    )
    mesh, finest = meshes
    assert mesh is not None
    return replace(start, mesh=mesh, finest=finest)


def atlas_of(
    given: Asset,
    placement: Placement,
    available: int,
    options: SimplifyOptions,
    sides: NDArray[np.bool_],
) -> tuple[LatentMesh, list[str]]:
    """(the mesh that ``options.start.init`` names, moved to a ``placement``, with a new atlas; notes).
    ``available``: triangles of the reference; ``sides``: those that are seen from their front only.
    If either all or none are, so it is with the mesh; else its file decides. Transparent parts are
    left out, for those of the input pass into the result. Raises InputError when it has more
    triangles than were asked for."""
    from appearance_opt.asset.normals import weld
    from appearance_opt.asset.sides import single_sided

    parts = split(given, f"--init {options.start.init}", "start from", by_light=False)
    asset = parts.fitted
    most = (
        None
        if options.start.triangles is None and options.start.ratio is None
        else budget(options, available)
    )
    if most is not None and asset.triangle_count > most:
        raise InputError(
            f"--init {options.start.init}: has {asset.triangle_count} triangles, more than the {most} asked for"
        )
    offsets = np.cumsum([0] + [len(m.positions) for m in asset.meshes[:-1]])
    p = np.concatenate([m.positions for m in asset.meshes]).astype(np.float64)
    f = np.concatenate([m.faces + o for m, o in zip(asset.meshes, offsets, strict=True)])
    first, place = weld(p)
    faces = place[f].astype(np.int32)
    require_memory(len(faces), options)
    single = single_sided(asset.meshes)
    if sides.all() or not sides.any():
        single[:] = sides.all()
    mesh = unwrap(
        placement.relative_to(asset.origin).to_local(p[first]),
        faces,
        options.texture.size,
        gutter(len(faces), options),
        single,
    )
    return mesh, parts.describe_kept(
        "of --init are left out: those of the input pass into the result"
    )
