"""A distance field as a reference: sphere tracing, then our own shading."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.render import outlines
from appearance_opt.render.brdf import MaterialSample
from appearance_opt.render.camera import camera_of, direction
from appearance_opt.render.lattice import sub_pixel_offsets
from appearance_opt.render.math import clamp
from appearance_opt.render.pixels import Batch, Grid, add_colors
from appearance_opt.render.rays import positions_in_pixels
from appearance_opt.render.shading import illuminate
from appearance_opt.sdf.check import Tracing
from appearance_opt.sdf.normals import normal
from appearance_opt.sdf.trace import Hit, clip, sphere_trace

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from appearance_opt.sdf.shape import Field
    from appearance_opt.views import Views

MAX_PIXELS = 1 << 20
"""Pixels rendered at once."""


@dataclass
class Rays:
    """Rays through positions of images: ``view``, position (``x``, ``y``) in pixels."""

    view: mi.UInt32
    x: mi.Float
    y: mi.Float


class SdfReference:
    """Renders a field that lies about in the unit sphere. A ``PointReference``: ``average`` of a
    pair is exact where the depth jumps between pixels. Materials are taken at points, unfiltered.
    """

    def __init__(self, field: Field, tracing: Tracing | None = None) -> None:
        self.field, self.tracing = field, tracing or Tracing()
        self._grid: Grid | None = None
        self._safety = dr.opaque(mi.Float, self.tracing.safety)

    @property
    def bounds(self) -> NDArray[np.floating]:
        """See ``Reference``."""
        return np.asarray(self.field.bounds)

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]:
        """See ``Reference.render``."""
        drawn = []
        with dr.suspend_grad():
            for batch in self._batches(views, resolution):
                image = dr.zeros(mi.Float, batch.grid.pixels * 4)
                for dx, dy in sub_pixel_offsets(samples):
                    rays = _through(batch, dx, dy)
                    hit = self._see(batch, rays)
                    self._add(image, batch, rays, hit, 1 / samples)
                drawn.append(_host(image, batch.grid))
        return np.concatenate(drawn)

    def pair(
        self, views: Views, resolution: int, samples: int, width: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See ``PointReference.pair``."""
        pairs = []
        with dr.suspend_grad():
            for batch in self._batches(views, resolution):
                both = self._pair(batch, samples)
                pairs.append([_host(image, batch.grid) for image in both])
        average, points = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
        return average, points

    def trace(self, origin: mi.Point3f, way: mi.Vector3f) -> Hit:
        """What rays (unit directions) meet first."""
        start, end = self.clip(origin, way)
        return sphere_trace(self.field.distance, origin, way, start, end, self._safety)

    def clip(self, origin: mi.Point3f, way: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """(start, end) of the part of rays that lies in the bounds."""
        return clip(self.field, origin, way)

    def normal(self, p: mi.Point3f) -> mi.Vector3f:
        """Unit normals of the surface, outward."""
        return normal(self.field.distance, p, self.tracing.by_derivative)

    def material(self, p: mi.Point3f) -> MaterialSample:
        """What the surface is made of."""
        color, roughness, metalness = self.field.material(p)
        return MaterialSample(
            dr.fmax(mi.Color3f(color), 0), clamp(roughness, 0, 1), clamp(metalness, 0, 1)
        )

    def _pair(self, batch: Batch, samples: int) -> tuple[mi.Float, mi.Float]:
        grid, pixels = batch.grid, batch.grid.pixels
        rays = _through(batch, 0.5, 0.5)
        hit = self._see(batch, rays)
        points = dr.zeros(mi.Float, pixels * 4)
        self._add(points, batch, rays, hit, 1.0)
        far = dr.select(hit.valid, hit.t, mi.Float(outlines.NOTHING))
        outlined = outlines.find(far, grid.index, grid.rows, pixels)
        each = dr.arange(mi.UInt32, pixels * 4) // 4
        average = dr.select(dr.gather(mi.Bool, outlined, each), 0, points)
        index = dr.compress(dr.gather(mi.Bool, outlined, grid.index))
        dr.eval(average)
        if dr.width(index):
            ray = dr.arange(mi.UInt32, dr.width(index) * samples)
            dr.eval(ray)
            fine = Rays(*positions_in_pixels(batch, index, ray, samples))
            self._add(average, batch, fine, self._see(batch, fine), 1 / samples)
        return average, points

    def _see(self, batch: Batch, rays: Rays) -> Hit:
        camera = camera_of(batch.records, rays.view)
        way = dr.normalize(direction(camera, rays.x, rays.y, batch.grid.size))
        hit = self.trace(camera.eye, way)
        dr.eval(hit)
        return hit

    def _add(self, image: mi.Float, batch: Batch, rays: Rays, hit: Hit, weight: float) -> None:
        """Add the radiance and coverage of what rays have met to an image (pixels * 4), in
        place."""
        some = dr.compress(hit.valid)
        if not dr.width(some):
            return
        view = dr.gather(mi.UInt32, rays.view, some)
        x, y, t = (dr.gather(mi.Float, a, some) for a in (rays.x, rays.y, hit.t))
        camera = camera_of(batch.records, view)
        way = dr.normalize(direction(camera, x, y, batch.grid.size))
        p = dr.fma(way, t, camera.eye)
        color = illuminate(self.material(p), self.normal(p), p, -way, camera)
        rows = batch.grid.rows
        pixel = (view * rows + mi.UInt32(y)) * rows + mi.UInt32(x)
        add_colors(image, color, dr.opaque(mi.Float, weight), pixel, dr.ReduceMode.Local)
        dr.eval(image)

    def _batches(self, views: Views, resolution: int) -> Iterator[Batch]:
        step = max(1, MAX_PIXELS // (resolution * resolution))
        for start in range(0, len(views), step):
            part = views[start : start + step]
            grid = self._grid
            if grid is None or (grid.views, grid.resolution) != (len(part), resolution):
                grid = self._grid = Grid(len(part), resolution)
            yield Batch(part.records(), grid)


def _through(batch: Batch, dx: float, dy: float) -> Rays:
    """One ray in every pixel."""
    grid = batch.grid
    dx, dy = dr.opaque(mi.Float, float(dx)), dr.opaque(mi.Float, float(dy))
    rays = Rays(grid.view, mi.Float(grid.column) + dx, mi.Float(grid.row) + dy)
    dr.eval(rays)
    return rays


def _host(image: mi.Float, grid: Grid) -> NDArray[np.float32]:
    return np.array(image).reshape(grid.views, grid.resolution, grid.resolution, 4)
