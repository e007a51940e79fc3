"""A heavy and a light mesh under one placement: what is baked, and what it is baked onto."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt import backend
from appearance_opt.asset.alpha import seen_through
from appearance_opt.baking import check
from appearance_opt.baking.align import align
from appearance_opt.baking.target_mesh import prepare, unwrap_asset
from appearance_opt.errors import InputError
from appearance_opt.placement import Placement
from appearance_opt.reference.subject import Subject
from appearance_opt.stages.start import localize, require_survey
from appearance_opt.views import ViewSampler, views_around

if TYPE_CHECKING:
    from appearance_opt.asset.types import Asset
    from appearance_opt.baking.closed_form import BakedMaps
    from appearance_opt.baking.target_mesh import Low
    from appearance_opt.config import BakeOptions, JointOptions
    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.reference.survey import Survey
    from appearance_opt.stages.parts import Parts
    from appearance_opt.stages.run import Run

MISSED_NOTE, MISSED_ERROR = 0.01, 0.5
"""Shares of missed texels from which on the user is told, and the bake is refused."""


@dataclass(frozen=True)
class Pair:
    """``subject``: what of HIGH is baked; ``high``: all of it, where it was aligned. ``low``: what
    it is baked onto, ``mesh``: the same in local coordinates; ``low_parts``: with what of LOW is
    left alone. ``cage`` in local units, None for the automatic one. ``notes``: what the user should
    know of both."""

    subject: Subject
    high: Asset
    low: Low
    mesh: LatentMesh
    low_parts: Parts
    cage: float | None
    notes: list[str]

    @classmethod
    def of(
        cls, high: Parts, low: Parts, name: str, options: BakeOptions | JointOptions, run: Run
    ) -> Pair:
        """Check that the two belong together. ``name`` of LOW, for messages. Raises InputError."""
        heavy, light, whole, o = high.fitted, low.fitted, high.whole, options.baking
        notes = [*heavy.notes, *high.describe_kept("of HIGH are not baked")]
        notes += [
            *(f"LOW: {n}" for n in light.notes),
            *low.describe_kept("of LOW stay as they are"),
        ]
        if o.align:
            heavy, whole, told = align_parts(high, light)
            notes.append(told)
        check.check_place(heavy, light)
        if o.unwrap:
            light = unwrap_asset(light, options.texture.size)
        check.check_uvs(light, name)
        backend.select(options.device)
        prepared = prepare(light)
        if not o.unwrap:
            check.check_overlap(prepared.mesh, name)
        run.lap("check")
        placement = Placement.around(np.concatenate([heavy.points(), light.points()]))
        subject = Subject.of_asset(heavy, options.views.seed, options.views.light, placement)
        mesh = localize(prepared.mesh, placement, light.origin)
        run.lap("reference")
        cage = None if o.cage is None else o.cage / placement.scale
        return cls(subject, whole, prepared, mesh, low, cage, notes)

    @property
    def survey(self) -> Survey:
        """The surface of what is baked."""
        return require_survey(self.subject)

    @property
    def scale(self) -> float:
        """Metres per local unit."""
        return self.subject.placement.scale

    def check_missed(self, baked: BakedMaps) -> None:
        """Raise InputError if most rays found nothing; a note if some did."""
        reach, share = f"{baked.reach * self.scale:.4g} m", baked.missed_share
        if share > MISSED_ERROR:
            raise InputError(
                f"{100 * share:.0f} % of the rays found nothing of HIGH within {reach}: "
                "give a larger --cage, or --align if the two lie apart"
            )
        if share > MISSED_NOTE:
            self.notes.append(
                f"{100 * share:.1f} % of the texels found nothing within {reach} and were filled"
            )

    def shown(self) -> Subject:
        """What a report compares with: all of HIGH, in views that show transparent parts, too."""
        low, sampler = self.low_parts.whole, self.subject.sampler
        if not any(map(seen_through, (*self.high.meshes, *low.meshes))):
            return self.subject
        assert isinstance(sampler, ViewSampler)  # meshes are seen in random views
        points = np.concatenate([self.high.points(), low.points()])
        placement = Placement.around(points)
        framed = views_around(placement.to_local(points), sampler.seed, sampler.light)
        return replace(Subject.of_asset(self.high, placement=placement), sampler=framed)


def align_parts(high: Parts, low: Asset) -> tuple[Asset, Asset, str]:
    """(what of HIGH is baked, all of it, both aligned to what it is baked onto; a note)."""
    placed, scale, shift = align(high.fitted, low)
    from_world = shift + scale * np.array(high.fitted.origin) - low.origin
    kept = tuple(
        replace(
            m, positions=(m.positions.astype(np.float64) * scale + from_world).astype(np.float32)
        )
        for m in high.kept
    )
    moved = ", ".join(f"{x:.6g}" for x in shift)
    note = f"HIGH was scaled by {scale:.6g} and moved by {moved} m"
    return placed, replace(high, fitted=placed, kept=kept).whole, note
