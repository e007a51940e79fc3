"""What is simplified: assets under the placement of a fit, their held-out views, and their starts,
made once and kept."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset import load
from appearance_opt.config import as_dict, simplify_options
from appearance_opt.evaluate.comparison import render_asset
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.initial.atlas import unwrap
from appearance_opt.initial.sphere import random_maps
from appearance_opt.stages import growth
from appearance_opt.stages.decimated import decimate_start
from appearance_opt.stages.displacement import gutter
from appearance_opt.stages.start import (
    Start,
    budget,
    require_survey,
    transfer_appearance,
)
from appearance_opt.views import MEASURED
from experiments import common
from experiments.common import Placed, source_of

if TYPE_CHECKING:
    from pathlib import Path

    from appearance_opt.asset.types import Asset
    from appearance_opt.evaluate.metrics import Metrics
    from appearance_opt.latent.latent import Latent

OUT = common.OUT / "speed_vs_error"

VIEWS, RESOLUTION, SAMPLES = 8, 256, 9


@dataclass(frozen=True)
class Subject:
    """One asset and how it is simplified: ``ratio`` of its triangles, or ``triangles`` from a
    sphere."""

    name: str
    source: str
    ratio: float | None = None
    triangles: int | None = None

    @property
    def grown(self) -> bool:
        """Does it start from a sphere?"""
        return self.triangles is not None

    @property
    def arguments(self) -> list[str]:
        """The same for the command line."""
        if self.triangles is not None:
            return ["--init", "sphere", "--triangles", str(self.triangles)]
        return ["--ratio", str(self.ratio)]

    def path(self) -> Path:
        """The file; the embedded scene is written when first asked for. Raises
        ``common.Missing``."""
        return source_of(self.source)


SUBJECTS = (
    Subject("spot, from a sphere", "spot", triangles=3000),
    Subject("flight_helmet", "flight_helmet", ratio=0.015),
    Subject("chess_king", "chess_king", ratio=0.015),
    Subject("demo scene", "relic", ratio=0.02),
)
"""``demo scene``: as in ``make demo``."""


class Bench:
    """A subject ready to be fitted and measured."""

    def __init__(self, subject: Subject) -> None:
        self.subject, self._path = subject, subject.path()
        placed = Placed(load(self._path))
        self.placed, self.placement, self.asset = placed.subject, placed.placement, placed.asset
        self.reference, self.sampler = placed.reference, placed.sampler
        self._views = self.sampler.held_out(MEASURED).draw(0, VIEWS)
        self._starts: dict[int, Start] = {}
        self._measured: dict[tuple[int, bool], Metrics] = {}

    @cached_property
    def images(self) -> np.ndarray:
        """The reference in the held-out views."""
        return self.reference.render(self._views, RESOLUTION, SAMPLES)

    def start(self, texture: int) -> Start:
        """The start with an atlas of ``texture`` texels: a sphere with random maps as it is grown,
        or the decimated mesh of the preset ``default`` with maps transferred in closed form."""
        if texture not in self._starts:
            self._starts[texture] = (
                self._sphere(texture) if self.subject.grown else self._decimated(texture)
            )
        return self._starts[texture]

    def measure(self, model: Latent) -> Metrics:
        """A model in the held-out views."""
        return compare_images(self.images, self._camera.render(model))

    def measure_start(self, which: tuple[int, bool], model: Latent) -> Metrics:
        """The same for a start, once for each of those that ``which`` tells apart."""
        if which not in self._measured:
            self._measured[which] = self.measure(model)
        return self._measured[which]

    def measure_asset(self, asset: Asset) -> Metrics:
        """The same for a result as it was written, in the units of the source."""
        return compare_images(
            self.images, render_asset(self.placement.local(asset), self._views, RESOLUTION, SAMPLES)
        )

    @cached_property
    def _camera(self):
        from appearance_opt.optimize.validation import Validation

        return Validation(self.reference, self._views, RESOLUTION, SAMPLES)

    def _sphere(self, texture: int) -> Start:
        assert self.subject.triangles is not None
        mesh = growth.first_shape(self.subject.triangles, self.sampler, texture)
        return Start(
            mesh, {**random_maps(texture, 0, True)}, False, np.zeros((texture, texture), bool)
        )

    def _decimated(self, texture: int) -> Start:
        # a number of steps instead of a budget: a slow machine must not drop rounds of reallocation
        options = simplify_options("default", ratio=self.subject.ratio, steps=0)
        first = options.texture.size

        def make() -> tuple[Start, bool]:
            if texture == first:
                count = budget(options, self.asset.triangle_count)
                return decimate_start(self.placed, options, count), False
            mesh = self.start(first).mesh  # the same triangles in another atlas
            other = simplify_options(
                "default", ratio=self.subject.ratio, steps=0, texture_size=texture
            )
            atlas = unwrap(mesh.positions, mesh.faces, texture, gutter(len(mesh.faces), other))
            return transfer_appearance(require_survey(self.placed), atlas, other), False

        key = hashlib.sha256(
            json.dumps(as_dict(options), sort_keys=True).encode() + self._path.read_bytes()
        )
        folder = OUT / "starts"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self._path.stem}_{texture}.npz"
        return growth.kept(path, key.hexdigest(), make)[0]
