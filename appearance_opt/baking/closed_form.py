"""The closed-form bake: for every texel, a ray finds the point of the heavy mesh that it stands
for.

No image, no optimisation: seconds. Worked off in bands of rows, so that memory does not grow with
the size of the maps, but for the maps themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.asset.packing import EMISSION
from appearance_opt.baking.occlusion import exposed, openness
from appearance_opt.baking.reach import automatic_reach
from appearance_opt.baking.texel_points import Points, TexelPoints
from appearance_opt.initial.fill import fill, nearest_charts
from appearance_opt.render.lattice import sub_pixel_offsets
from appearance_opt.render.passing import blocked
from appearance_opt.render.surface import face_normal

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.reference.survey import Found, Pick, Survey
    from appearance_opt.render.surface import Hit

FIELDS: dict[str, tuple[str, ...]] = {
    "material": ("red", "green", "blue", "roughness", "metalness"),
    "normal": ("normal_x", "normal_y", "normal_z"),
    "object-normal": ("object_x", "object_y", "object_z"),
    "displacement": ("displacement",),
    "ao": ("occlusion",),
    "curvature": ("curvature",),
    "emission": EMISSION,
}
"""What can be baked, and the channels of each."""

FAR = 4.0
"""Nothing lies farther than this where the object has radius 1."""


@dataclass(frozen=True)
class Settings:
    """What to bake and how. ``fields``: names of ``FIELDS``. ``samples``: rays per texel.
    ``reach``: how far rays go outward and inward, None for the automatic cage. ``fill_hidden``:
    texels that nothing outside can see, or whose point of the reference nothing can see, are filled
    from their neighbours: where parts touch, two surfaces coincide, and rays would find one or the
    other at random. Lengths in local units."""

    size: int
    fields: tuple[str, ...] = ("material", "normal")
    samples: int = 1
    reach: float | None = None
    pick: Pick = "nearest"
    ao_rays: int = 64
    ao_distance: float = float("inf")
    fill_hidden: bool = False


@dataclass(frozen=True)
class BakedMaps:
    """``maps``: channel name -> (size, size) float32, natural units (linear colours, normals in
    [-1, 1], lengths in local units), filled everywhere. ``covered``: texels that belong to a
    triangle of the atlas. ``missed``: those among them whose rays found nothing. ``hidden``: those
    that nothing outside can see, if that was asked for (they do not count as missed). ``reach``:
    how far rays went."""

    maps: dict[str, NDArray[np.float32]]
    covered: NDArray[np.bool_]
    missed: NDArray[np.bool_]
    hidden: NDArray[np.bool_]
    reach: float

    @property
    def missed_share(self) -> float:
        """Fraction of the covered texels whose rays found nothing."""
        return float(self.missed.sum() / max(int(self.covered.sum()), 1))


def bake(survey: Survey, mesh: LatentMesh, settings: Settings) -> BakedMaps:
    """The maps of ``mesh``, whose atlas must lie in the unit square, from the surface of a reference."""
    size = settings.size
    names = [c for f in settings.fields for c in FIELDS[f]]
    values = np.empty((size, size, len(names)), np.float32)
    found, covered, hidden = (np.empty((size, size), bool) for _ in range(3))
    with dr.suspend_grad():
        reach = (
            automatic_reach(survey, mesh.positions, mesh.faces)
            if settings.reach is None
            else settings.reach
        )
        run = _Run(survey, TexelPoints(mesh, size, settings.samples), settings, reach)
        for row in range(0, size, run.points.rows):
            sums = run.band(row)[: size - row]
            here = slice(row, row + len(sums))
            hits = sums[..., len(names)]
            values[here] = sums[..., : len(names)] / np.maximum(hits, 1)[..., None]
            found[here], covered[here], hidden[here] = (
                sums[..., len(names) + k] > 0 for k in range(3)
            )
    hidden &= ~found
    maps: dict[str, NDArray[np.float32]] = {}
    nearest = nearest_charts(covered) if covered.any() else ...
    start = 0
    for field in settings.fields:
        channels = FIELDS[field]
        own = values[..., start : start + len(channels)]
        start += len(channels)
        if field in ("normal", "object-normal"):
            length = np.linalg.norm(own, axis=-1, keepdims=True)
            own = (own / np.maximum(length, 1e-6)).astype(np.float32)
        filled = fill(own, found)[nearest]
        maps.update({c: np.ascontiguousarray(filled[..., k]) for k, c in enumerate(channels)})
    return BakedMaps(maps, covered, covered & ~found & ~hidden, hidden, reach)


class _Run:
    """What every band needs."""

    def __init__(
        self, survey: Survey, points: TexelPoints, settings: Settings, reach: float
    ) -> None:
        self.survey, self.points, self.settings = survey, points, settings
        self.reach = dr.opaque(mi.Float, reach)
        self.width = 1 << (sum(len(FIELDS[f]) for f in settings.fields) + 2).bit_length()

    def band(self, row: int) -> NDArray[np.float32]:
        """(rows, size, width) sums over the samples of each texel: channels, hits, samples inside a
        chart, hits that nothing outside can see (which count as no hits)."""
        rows, size = self.points.rows, self.points.size
        total = dr.zeros(mi.Float, rows * size * self.width)
        for k, (dx, dy) in enumerate(sub_pixel_offsets(self.settings.samples)):
            points = self.points.band(row, float(dx), float(dy))
            if points is not None:
                self._add(total, points, (row * size) * self.settings.samples + k)
        return np.array(total).reshape(rows, size, self.width)

    def _add(self, total: mi.Float, points: Points, seed: int) -> None:
        found = self.survey.find(points.here.position, points.along, self.reach, self.settings.pick)
        dr.eval(found, points)
        hidden = mi.Bool(False)
        if self.settings.fill_hidden:
            hidden = self._hidden(points, found)
            found.valid &= ~hidden
        rows = [dr.select(found.valid, x, 0) for x in self._values(points, found, seed)]
        rows += [
            dr.select(found.valid, mi.Float(1), 0),
            mi.Float(1),
            dr.select(hidden, mi.Float(1), 0),
        ]
        rows += [mi.Float(0)] * (self.width - len(rows))
        # one sample of each texel: no two threads meet
        dr.scatter_reduce(
            dr.ReduceOp.Add, total, mi.ArrayXf(rows), points.texel, mode=dr.ReduceMode.NoConflicts
        )
        dr.eval(total)

    def _hidden(self, points: Points, found: Found) -> mi.Bool:
        """Points of the mesh that nothing outside can see, or whose point of the reference nothing
        can see."""
        flat = face_normal(self.points.surface, points.triangle, mi.Bool(True))
        flat *= dr.rsqrt(dr.fmax(dr.squared_norm(flat), 1e-30))
        all_ = dr.full(mi.Bool, True, dr.width(points.texel))
        front_only = self._front_only(points)
        see = partial(blocked, self.points.scene)
        out = exposed(see, points.here.position, flat, all_, FAR, front_only)
        both = out & found.valid
        there = self.survey.geometry(found)
        front_only = self.survey.front_only(found)
        return ~out | (
            both
            & ~exposed(self.survey.blocked, there.position, there.normal, both, FAR, front_only)
        )

    def _front_only(self, points: Points) -> mi.Bool | None:
        """Is each point not to be seen from behind? None if all may be."""
        culled = self.points.surface.culled
        return None if culled is None else dr.gather(mi.Bool, culled, points.triangle)

    def _values(self, points: Points, found: Found, seed: int) -> list[mi.Float]:
        """All channels of the wanted fields, in order."""
        fields = self.settings.fields
        out: dict[str, list[mi.Float]] = {}
        if {"material", "normal", "object-normal"} & set(fields):
            s = self.survey.appearance(found, points.area)
            color = s.base_color
            normal = dr.select(dr.dot(s.normal, points.here.normal) < 0, -s.normal, s.normal)
            out["material"] = [color.x, color.y, color.z, s.roughness, s.metalness]
            out["normal"] = to_tangent_space(points.here, normal)
            out["object-normal"] = [normal.x, normal.y, normal.z]
        out["displacement"] = [found.distance]
        if "ao" in fields:
            o = self.settings
            number = points.texel + dr.opaque(mi.UInt32, seed % 2**32)
            out["ao"] = [openness(self.survey, found, number, o.ao_rays, o.ao_distance, FAR)]
        if "emission" in fields:
            out["emission"] = self.survey.emission(found, points.area)
        if "curvature" in fields:
            out["curvature"] = [self.survey.curvature(found)]
        return [x for f in fields for x in out[f]]


def to_tangent_space(here: Hit, normal: mi.Vector3f) -> list[mi.Float]:
    """A world-space normal in the shader's tangent basis, whose tangent need not be perpendicular
    to the interpolated normal. It never points below the surface."""
    n, t = here.normal, here.tangent
    assert t is not None and here.handedness is not None
    bitangent = dr.cross(n, t) * here.handedness
    c = dr.dot(n, t)
    scale = dr.rcp(dr.fmax(1 - c * c, 1e-3))
    x = (dr.dot(normal, t) - c * dr.dot(normal, n)) * scale
    y = dr.dot(normal, bitangent) * scale
    z = (dr.dot(normal, n) - c * dr.dot(normal, t)) * scale
    return [x, y, dr.fmax(z, 0.05)]
