"""The usual reference: a mesh with materials, drawn by our own renderer without gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.asset.alpha import seen_through
from appearance_opt.asset.batch import Batch, fill_normals, replace_chosen
from appearance_opt.asset.sides import culled, single_sided
from appearance_opt.asset.tangents import any_tangent, split_and_tangents
from appearance_opt.reference.textures import coverage_maps, emission_maps, material_maps
from appearance_opt.render import deferred, layers, upload
from appearance_opt.render.freezing import Frozen
from appearance_opt.render.material import UNLIT
from appearance_opt.render.pixels import Grid
from appearance_opt.render.surface import Surface

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset, Mesh
    from appearance_opt.views import Views

MAX_PIXELS = 1 << 20
"""Pixels rendered at once: more saves no time and costs memory."""


@dataclass(frozen=True)
class MergedMesh:
    """All meshes of an asset as one, vertices split where attributes differ. See
    ``asset.types.Mesh``; ``colors`` (V, 4) have alpha. ``material``: (F,) index into the asset's
    materials, in the order of its meshes."""

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    uvs: NDArray[np.float32]
    tangents: NDArray[np.float32] | None
    colors: NDArray[np.float32] | None
    faces: NDArray[np.int32]
    material: NDArray[np.int32]


class MeshReference:
    """Renders an asset. ``survey.MeshSurvey`` answers what its surface looks like.

    ``merged``: the host arrays; ``single`` (F,): faces that are seen from their front only;
    ``scene``: for tracing rays; ``surface``, ``maps``: device data; ``emission``: what the
    materials emit, which is not rendered; None if they do not; ``coverage``: what light the
    materials keep back; None if all of it.
    """

    def __init__(self, asset: Asset) -> None:
        by_id = {id(m.material): m.material for m in asset.meshes}
        number = {key: k for k, key in enumerate(by_id)}
        self.maps = material_maps(list(by_id.values()))
        self.emission = emission_maps(list(by_id.values()))
        self.coverage = coverage_maps(list(by_id.values()))
        self.merged = merge(
            asset, [number[id(m.material)] for m in asset.meshes], self.maps.has_normal_map
        )
        m = self.merged
        self.single = single_sided(asset.meshes)
        passing = None
        if self.coverage is not None:
            passing = np.repeat(
                [seen_through(m) for m in asset.meshes], [len(m.faces) for m in asset.meshes]
            )
        hidden_backs = culled(m.positions, m.faces, self.single, passing)
        self.scene = upload.scene_of(m.positions, m.faces, hidden_backs)
        if m.tangents is None:
            frames = upload.packets(2, m.uvs)
        else:
            frames = upload.packets(
                8, m.uvs, m.tangents[:, 3], np.zeros(len(m.uvs)), m.tangents[:, :3]
            )
        padding = np.zeros(len(m.positions))
        self.surface = Surface(
            faces=upload.index_packets(m.faces, m.material),
            vertices=upload.packets(8, m.positions, padding, m.normals),
            frames=frames if self._needs_uvs() else None,
            colors=None if m.colors is None else upload.packets(4, m.colors),
            has_tangents=m.tangents is not None,
            culled=None if hidden_backs is None else mi.Bool(hidden_backs),
        )
        self._run = Frozen(self.surface, self.maps, self.coverage)
        self._grid: Grid | None = None

    @property
    def bounds(self) -> NDArray[np.floating]:
        """See ``Reference``."""
        p = self.merged.positions
        return np.stack([p.min(axis=0), p.max(axis=0)])

    @property
    def unlit(self) -> bool:
        """Does all of it show its base colour whatever the light?"""
        return UNLIT in self.maps.constants

    def _needs_uvs(self) -> bool:
        """Does any material look up a texture?"""
        emits = self.emission is not None and bool(self.emission.layers)
        return bool(self.maps.layers) or emits or self.coverage is not None

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]:
        """See ``Reference.render``."""
        parts = self._parts(views, resolution)
        images = [_host(self.render_device(p.records(), g, samples), g) for p, g in parts]
        return np.concatenate(images)

    def pair(
        self, views: Views, resolution: int, samples: int, width: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See ``PointReference.pair``."""
        pairs = []
        with dr.suspend_grad():
            for part, grid in self._parts(views, resolution):
                records, drawn = part.records(), (self.scene, self.surface, self.maps)
                if self.coverage is not None:  # outlines of what is seen through may lie anywhere
                    settings = (samples, None), (1, width)
                    both = [self.render_device(records, grid, n, w) for n, w in settings]
                else:
                    both = [*deferred.render_pair(*drawn, records, grid, samples, width, self._run)]
                pairs.append([_host(image, grid) for image in both])
        average, points = (np.concatenate(images) for images in zip(*pairs, strict=True))
        return average, points

    def _parts(self, views: Views, resolution: int) -> Iterator[tuple[Views, Grid]]:
        """Views in batches of at most ``MAX_PIXELS`` pixels, with their grids."""
        step = max(1, MAX_PIXELS // (resolution * resolution))
        for start in range(0, len(views), step):
            part = views[start : start + step]
            yield part, self._grid_of(len(part), resolution)

    def _grid_of(self, views: int, resolution: int) -> Grid:
        """The pixels of a batch; the last ones are kept, for batches come in equal sizes."""
        if self._grid is None or (self._grid.views, self._grid.resolution) != (views, resolution):
            self._grid = Grid(views, resolution)
        return self._grid

    def render_device(
        self, records: mi.Float, grid: Grid, samples: int, width: float | None = None
    ) -> mi.Float:
        """The same for a batch whose records are on the device; the image stays there, flat.
        ``width``: as for ``deferred.render_image``."""
        with dr.suspend_grad():
            drawn = self.scene, self.surface, self.maps
            if self.coverage is not None:
                return layers.render_image(
                    *drawn, self.coverage, records, grid, samples, width, self._run
                )
            return deferred.render_image(*drawn, records, grid, samples, width, self._run)


def _host(image: mi.Float, grid: Grid) -> NDArray[np.float32]:
    return np.array(image).reshape(grid.views, grid.resolution, grid.resolution, 4)


def merge(asset: Asset, material_of: list[int], need_tangents: bool) -> MergedMesh:
    """Concatenate the meshes of an asset; computes what a mesh lacks (angle-weighted normals,
    MikkTSpace tangents where a normal map needs them, zero UVs, white vertex colours)."""
    meshes = fill_normals(asset.meshes)
    if need_tangents:
        lacking = [m.tangents is None for m in meshes]
        mapped = [m.material.normal_texture is not None and m.uvs is not None for m in meshes]
        meshes = replace_chosen(
            meshes, [a and b for a, b in zip(lacking, mapped, strict=True)], _with_tangents
        )
    batch = Batch(meshes)
    normals = batch.joined("normals")
    tangents = None
    if need_tangents:
        tangents = batch.joined("tangents")
        free = ~np.any(tangents, axis=1)  # no normal map reads them
        tangents[free] = np.concatenate(
            [any_tangent(normals[free]), np.ones((int(free.sum()), 1))], axis=1
        )
    return MergedMesh(
        positions=batch.joined("positions"),
        normals=normals,
        uvs=batch.joined("uvs"),
        tangents=tangents,
        colors=_joined_colors(batch),
        faces=batch.faces.astype(np.int32),
        material=np.array(material_of, np.int32)[batch.mesh_of_face],
    )


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
