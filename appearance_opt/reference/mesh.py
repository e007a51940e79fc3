"""The usual reference: a mesh with materials, drawn by our own renderer without gradients."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.asset.alpha import seen_through
from appearance_opt.asset.batch import Batch, fill_normals, replace_chosen
from appearance_opt.asset.hierarchy import owners
from appearance_opt.asset.sides import culled, single_sided
from appearance_opt.asset.tangents import any_tangent, split_and_tangents
from appearance_opt.reference.textures import coverage_maps, emission_maps, material_maps
from appearance_opt.render import pixels
from appearance_opt.render.drawn import Drawn
from appearance_opt.render.freezing import Frozen
from appearance_opt.render.layers import renderer_of
from appearance_opt.render.material import UNLIT, MaterialMaps
from appearance_opt.render.surface import Surface
from appearance_opt.render.upload import MeshArrays

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset, Mesh
    from appearance_opt.render.images import Renderer
    from appearance_opt.render.passing import Scene
    from appearance_opt.views import Views

MAX_PIXELS = 1 << 20
"""Pixels rendered at once: more saves no time and costs memory."""


class MeshReference:
    """Renders an asset. ``survey.MeshSurvey`` answers what its surface looks like.

    ``merged``: the host arrays; ``single`` (F,): faces that are seen from their front only;
    ``owner`` (F,): number of the node to which each face belongs, None for an asset without nodes;
    ``drawn``: the same on the device; ``emission``: what the materials emit, which is not rendered;
    None if they do not; ``coverage``: what light the materials keep back; None if all of it.
    """

    def __init__(self, asset: Asset) -> None:
        by_id = {id(m.material): m.material for m in asset.meshes}
        number = {key: k for k, key in enumerate(by_id)}
        maps = material_maps(list(by_id.values()))
        self.emission = emission_maps(list(by_id.values()))
        self.coverage = coverage_maps(list(by_id.values()))
        self._material_of = [number[id(m.material)] for m in asset.meshes]
        self.merged = merge(asset, self._material_of, maps.has_normal_map)
        m = self.merged
        self.single, self.owner = single_sided(asset.meshes), owners(asset)
        passing = None
        if self.coverage is not None:
            passing = np.repeat(
                [seen_through(m) for m in asset.meshes], [len(m.faces) for m in asset.meshes]
            )
        self._hidden_backs = culled(m.positions, m.faces, self.single, passing)
        uvs = m.uvs if self._needs_uvs(maps) else None
        self.drawn = Drawn.of(replace(m, uvs=uvs, culled=self._hidden_backs), maps)
        self._renderer: Renderer = renderer_of(self.coverage)
        self._run = Frozen(self.surface, self.maps, self.coverage)
        self._grid: pixels.Grid | None = None

    def moved(self, asset: Asset) -> MeshReference:
        """The same with its vertices elsewhere. ``asset``: the one it was made of, ``completed``
        before, moved."""
        out, maps = copy(self), self.maps
        out.merged = m = merge(asset, self._material_of, maps.has_normal_map)
        uvs = m.uvs if self._needs_uvs(maps) else None
        out.drawn = Drawn.of(replace(m, uvs=uvs, culled=self._hidden_backs), maps)
        out._run = Frozen(out.surface, out.maps, out.coverage)
        return out

    @property
    def scene(self) -> Scene:
        """The mesh, for tracing rays."""
        return self.drawn.scene

    @property
    def surface(self) -> Surface:
        """The mesh, for shading."""
        return self.drawn.surface

    @property
    def maps(self) -> MaterialMaps:
        """Its materials."""
        return self.drawn.maps

    @property
    def bounds(self) -> NDArray[np.floating]:
        """See ``Reference``."""
        p = self.merged.positions
        return np.stack([p.min(axis=0), p.max(axis=0)])

    @property
    def unlit(self) -> bool:
        """Does all of it show its base colour whatever the light?"""
        return UNLIT in self.maps.constants

    def _needs_uvs(self, maps: MaterialMaps) -> bool:
        """Does any material look up a texture?"""
        emits = self.emission is not None and bool(self.emission.layers)
        return bool(maps.layers) or emits or self.coverage is not None

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]:
        """See ``Reference.render``."""
        parts = self._parts(views, resolution)
        drawn = [
            _host(self.render_device(pixels.Batch(p.records(), g), samples), g) for p, g in parts
        ]
        return np.concatenate(drawn)

    def pair(
        self, views: Views, resolution: int, samples: int, width: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See ``PointReference.pair``."""
        pairs = []
        with dr.suspend_grad():
            for part, grid in self._parts(views, resolution):
                batch = pixels.Batch(part.records(), grid)
                both = self._renderer.render_pair(self.drawn, batch, samples, width, self._run)
                pairs.append([_host(image, grid) for image in both])
        average, points = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
        return average, points

    def _parts(self, views: Views, resolution: int) -> Iterator[tuple[Views, pixels.Grid]]:
        """Views in batches of at most ``MAX_PIXELS`` pixels, with their grids."""
        step = max(1, MAX_PIXELS // (resolution * resolution))
        for start in range(0, len(views), step):
            part = views[start : start + step]
            yield part, self._grid_of(len(part), resolution)

    def _grid_of(self, views: int, resolution: int) -> pixels.Grid:
        """The pixels of a batch; the last ones are kept, for batches come in equal sizes."""
        if self._grid is None or (self._grid.views, self._grid.resolution) != (views, resolution):
            self._grid = pixels.Grid(views, resolution)
        return self._grid

    def render_device(
        self, batch: pixels.Batch, samples: int, width: float | None = None
    ) -> mi.Float:
        """The same for a batch on the device; the image stays there, flat. ``width``: as for
        ``images.render_image``."""
        with dr.suspend_grad():
            return self._renderer.render_image(self.drawn, batch, samples, width, self._run)


def _host(image: mi.Float, grid: pixels.Grid) -> NDArray[np.float32]:
    return np.array(image).reshape(grid.views, grid.resolution, grid.resolution, 4)


def merge(asset: Asset, material_of: list[int], need_tangents: bool) -> MeshArrays:
    """Concatenate the meshes of an asset, vertices split where attributes differ; computes what a
    mesh lacks (angle-weighted normals, MikkTSpace tangents where a normal map needs them, zero UVs,
    white vertex colours)."""
    batch = Batch(completed(asset.meshes, need_tangents))
    normals = batch.joined("normals")
    tangents = None
    if need_tangents:
        tangents = batch.joined("tangents")
        free = ~np.any(tangents, axis=1)  # no normal map reads them
        tangents[free] = np.concatenate(
            [any_tangent(normals[free]), np.ones((int(free.sum()), 1))], axis=1
        )
    return MeshArrays(
        positions=batch.joined("positions"),
        normals=normals,
        uvs=batch.joined("uvs"),
        tangents=tangents,
        colors=_joined_colors(batch),
        faces=batch.faces.astype(np.int32),
        material=np.array(material_of, np.int32)[batch.mesh_of_face],
    )


def completed(meshes: Sequence[Mesh], need_tangents: bool) -> list[Mesh]:
    """The meshes with normals, and where ``need_tangents`` and a normal map reads them tangents."""
    out = fill_normals(meshes)
    if not need_tangents:
        return out
    lacking = [m.tangents is None for m in out]
    mapped = [m.material.normal_texture is not None and m.uvs is not None for m in out]
    chosen = [a and b for a, b in zip(lacking, mapped, strict=True)]
    return replace_chosen(out, chosen, _with_tangents)


def _with_tangents(batch: Batch) -> list[Mesh]:
    positions, normals, uvs = (batch.joined(name) for name in ("positions", "normals", "uvs"))
    index, faces, tangents = split_and_tangents(
        positions, normals, uvs, batch.faces, batch.mesh_of_vertex
    )
    return batch.reindexed(index, faces, tangents=tangents)


def _joined_colors(batch: Batch) -> NDArray[np.float32] | None:
    """(V, 4) vertex colours, white where a mesh has none; the alpha of opaque modes means
    nothing."""
    if not batch.have("colors").any():
        return None
    given = batch.joined("colors", 1.0)
    out = np.ones((len(given), 4), np.float32)
    out[:, : given.shape[1]] = given
    opaque = np.array([m.material.alpha_mode == "opaque" for m in batch.meshes], bool)
    out[opaque[batch.mesh_of_vertex], 3] = 1.0
    return out
