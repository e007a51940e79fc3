"""The start of a fit: a mesh with an atlas and maps, from what the options ask for."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.normals import unit, weld
from appearance_opt.asset.sides import single_sided
from appearance_opt.errors import InputError
from appearance_opt.initial.atlas import unwrap
from appearance_opt.initial.influences import closest_points
from appearance_opt.initial.transfer import transfer
from appearance_opt.initial.vertex_normals import follow_normals
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.render.material import COLORS, UNLIT
from appearance_opt.stages.displacement import (
    REACH,
    bake_displacement,
    gutter,
    median_edge,
    require_memory,
)
from appearance_opt.stages.parts import split

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from appearance_opt.asset.origin import Origin
    from appearance_opt.asset.types import Asset
    from appearance_opt.config import SimplifyOptions
    from appearance_opt.initial.vertex_normals import Follow
    from appearance_opt.placement import Placement
    from appearance_opt.reference.subject import Subject
    from appearance_opt.reference.survey import Survey, Triangles

log = logging.getLogger(__name__)


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


def budget(options: SimplifyOptions, available: int | None) -> int:
    """Triangles asked for. Raises InputError when the input has fewer (None: it has none to be
    counted), or when their tessellation does not fit into memory."""
    count = options.start.triangles
    if available is None:
        if count is None:
            raise InputError(
                "--ratio: the reference has no triangles to be counted; give --triangles"
            )
    elif count is None:
        assert options.start.ratio is not None
        count = min(max(4, round(options.start.ratio * available)), available)
    elif count > available:
        raise InputError(
            f"--triangles {count}: the input has only {available} triangles; ask for fewer"
        )
    require_memory(count, options)
    return count


def require_survey(subject: Subject) -> Survey:
    """The surface of a subject. Raises InputError if only images are known of it."""
    if subject.survey is None:
        raise InputError(
            "images are all that is known of this reference: start from its hull, a sphere, or a file"
        )
    return subject.survey


def localize(mesh: LatentMesh, placement: Placement, origin: Origin) -> LatentMesh:
    """A mesh of the world, relative to ``origin``, in local coordinates."""
    local = placement.relative_to(origin).to_local(mesh.positions)
    return replace(mesh, positions=local.astype(np.float32))


def normals_of(survey: Survey, options: SimplifyOptions) -> Follow | None:
    """What gives a mesh vertex normals that follow the reference's. None where nothing is lit, and
    for displaced meshes: the normals of those are the ones of the displaced surface."""
    if survey.unlit or options.displacement.fitted:
        return None
    return partial(follow_normals, survey)


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


def inherit_owners(start: Start, heavy: Triangles) -> Start:
    """A start whose triangles stem from none of the reference's: each belongs to the part of the
    closest one that faces the same way."""
    if start.mesh.owner is not None or heavy.owner is None:
        return start
    mesh, finest = start.mesh, start.finest
    corners = mesh.positions[mesh.faces].astype(np.float64)
    facing = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    closest, _ = closest_points(corners.mean(axis=1), facing, heavy.positions, heavy.faces)
    owner = heavy.owner[closest]
    if finest is not None:  # the children of a triangle lie one after the other
        children = len(finest.faces) // len(mesh.faces)
        finest = replace(finest, owner=np.repeat(owner, children))
    return replace(start, mesh=replace(mesh, owner=owner), finest=finest)


def atlas_of(
    given: Asset, subject: Subject, options: SimplifyOptions
) -> tuple[LatentMesh, list[str]]:
    """(the mesh that ``options.start.init`` names, beside the subject, with a new atlas; notes).

    If all triangles of the subject are seen from their front only, or none is, so it is with the
    mesh; else its file decides. Transparent parts are left out, for those of the input pass into
    the result. Raises InputError when it has more triangles than were asked for."""
    parts = split(given, f"--init {options.start.init}", "start from", by_light=False)
    asset, survey, o = parts.fitted, subject.survey, options.start
    single = single_sided(asset.meshes)
    if survey is not None:
        sides, available = survey.triangles.single, len(survey.triangles.faces)
        if sides.all() or not sides.any():
            single[:] = sides.all()
        asked = o.triangles is not None or o.ratio is not None
        if asked and asset.triangle_count > (most := budget(options, available)):
            raise InputError(
                f"--init {o.init}: has {asset.triangle_count} triangles, more than the {most} "
                "asked for"
            )
    offsets = np.cumsum([0] + [len(m.positions) for m in asset.meshes[:-1]])
    p = np.concatenate([m.positions for m in asset.meshes]).astype(np.float64)
    f = np.concatenate([m.faces + o for m, o in zip(asset.meshes, offsets, strict=True)])
    first, place = weld(p)
    faces = place[f].astype(np.int32)
    require_memory(len(faces), options)
    mesh = unwrap(
        subject.placement.relative_to(asset.origin).to_local(p[first]),
        faces,
        options.texture.size,
        gutter(len(faces), options),
        single,
        None if survey is None else normals_of(survey, options),
    )
    return mesh, parts.describe_kept(
        "of --init are left out: those of the input pass into the result"
    )
