"""What a start is decimated from: faces that are seen, weighed by how much, after a coarse round
where there are very many."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.sides import culled
from appearance_opt.errors import InputError
from appearance_opt.initial.atlas import make_charts
from appearance_opt.initial.clustering import cluster
from appearance_opt.initial.decimate import decimate_with_source
from appearance_opt.initial.visibility import importance, pixel_counts
from appearance_opt.render import upload
from appearance_opt.views import VISIBILITY, Sampler, ViewSampler

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from appearance_opt.initial.vertex_normals import Follow
    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.reference.survey import Triangles
    from appearance_opt.render.passing import Scene

VISIBILITY_VIEWS = 160

SECONDS_PER_FACE, COARSE_SHARE = 2e-5, 0.25  # docs/trials.md: decimation
"""What decimation takes per face of the reference, and the part of a time budget from which it
begins with a coarse round (see ``clustering``). The same on every machine, so that the same options
make the same start."""

CLUSTERS, LEAST_CLUSTERS = 40, 100_000
"""Vertices that a coarse round leaves, per triangle that is asked for, and at the least."""


def is_coarse(faces: int, vertices: int, clusters: int, budget: float | None) -> bool:
    """Does decimation of a mesh begin with a coarse round? If it would take much of the time budget
    (seconds), and if that leaves half of the vertices at the most."""
    return (
        budget is not None
        and SECONDS_PER_FACE * faces > COARSE_SHARE * budget
        and 2 * clusters < vertices
    )


class Decimation:
    """``positions``, ``faces``, ``single``, ``owner``: what is decimated, the reference's own triangles or,
    if that is ``coarse``, clusters of them; ``weight``: importance of these faces by how much is
    seen of them; ``visible``: those that are decimated at all."""

    positions: NDArray
    faces: NDArray

    def __init__(
        self,
        heavy: Triangles,
        triangles: int,
        budget: float | None,
        sampler: Sampler | None,
        tell: Callable[[str], None],
    ) -> None:
        """``triangles`` that are asked for within a ``budget`` of seconds (None: no limit).
        ``sampler``: of views that tell what is seen; None: everything counts alike. ``tell``:
        called with what begins."""
        self._tell, self._triangles = tell, triangles
        self.positions, self.faces, self.single = heavy.positions, heavy.faces, heavy.single
        self.owner = heavy.owner
        scene = heavy.scene
        clusters = max(CLUSTERS * triangles, LEAST_CLUSTERS)
        self.coarse = is_coarse(len(heavy.faces), len(heavy.positions), clusters, budget)
        if self.coarse:
            tell("clustering vertices")
            self.positions, self.faces, source = cluster(heavy.positions, heavy.faces, clusters)
            self.single = heavy.single[source]
            self.owner = None if heavy.owner is None else heavy.owner[source]
            hidden_backs = culled(self.positions, self.faces, self.single)
            scene = upload.scene_of(self.positions, self.faces, hidden_backs)
        count = len(self.faces)
        self.weight, self.visible = np.ones(count), np.ones(count, bool)
        if sampler is not None:
            tell("looking for what can be seen")
            pixels = self._pixels(heavy, scene, count, sampler.held_out(VISIBILITY))
            self.weight, seen = importance(self.positions, self.faces, pixels)
            self.visible = seen if seen.sum() >= triangles else self.visible

    def _pixels(
        self, heavy: Triangles, scene: Scene, count: int, sampler: Sampler
    ) -> NDArray[np.int64]:
        """(F,) pixels in which each face was seen, at all poses."""
        if self.coarse or not heavy.poses:
            return pixel_counts(scene, count, sampler, VISIBILITY_VIEWS)
        each = max(VISIBILITY_VIEWS // len(heavy.poses), 8)
        assert isinstance(sampler, ViewSampler)  # meshes are seen in random views
        free = replace(sampler, hull=None)  # which is that of the scene
        total = np.zeros(count, np.int64)
        for k, posed in enumerate(heavy.poses):
            total += pixel_counts(posed, count, replace(free, seed=free.seed + k), each)
        return total

    def charts(self, weight: NDArray, follow: Follow | None = None) -> LatentMesh:
        """The mesh decimated with these importances of its faces (F,), its charts not yet packed.
        ``follow``: see ``make_charts``. Raises InputError if nothing is left of it."""
        single = self.single[self.visible]
        owner = None if self.owner is None else self.owner[self.visible]
        positions, faces, source = decimate_with_source(
            self.positions,
            self.faces[self.visible],
            self._triangles,
            weight[self.visible],
            single,
            owner,
            told=lambda left: self._tell(f"decimating: {left:,} triangles left"),
        )
        if not len(faces):
            raise InputError("nothing is left of this mesh at that budget; ask for more triangles")
        self._tell(f"unwrapping {len(faces):,} triangles")
        charts = make_charts(positions, faces, single[source], follow)
        return charts if owner is None else replace(charts, owner=owner[source])
