"""A Mitsuba scene as a reference: any shapes, any materials, any integrator."""

from __future__ import annotations

import math
import re
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.errors import InputError, ReferenceRenderError
from appearance_opt.reference.plugins import check_compiler
from appearance_opt.render.camera import camera_of, direction

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from appearance_opt.views import Views

BRIGHTEST = 10.0
"""Radiance of a single path at most: rare ones that are brighter (fireflies) would draw the fit
after them, and no picture shows what lies above 1."""

BEFORE = 1e-4
"""How far before the surface a path begins, in units of its distance from the camera."""

LAYERS = 8
"""Surfaces with holes that a ray passes through at most."""

MAX_RAYS = 1 << 21
"""Paths that are traced at a time: memory grows with them."""


class SceneReference:
    """A Mitsuba scene (see ``Reference``), in its own coordinates and unit of length.

    ``scene``: an .xml file, or a loaded ``mi.Scene``. ``shape``: the id of the only shape that is
    shown; None: all of them but lights. ``light``: "scene", the scene's own lights, which stand
    still, with the shadows and reflections of all its shapes; "point": that of each view instead,
    with what is shown alone. ``samples``: paths per pixel at least.

    Paths begin at the shape that is shown, so that nothing hides it, and coverage is what their
    cameras see of it: lights and environments are no part of the picture. Paths are random, and
    the same whenever a view is drawn again. Raises InputError for what cannot be loaded, or has
    nothing to show.
    """

    def __init__(
        self,
        scene: str | Path | mi.Scene,
        shape: str | None = None,
        light: str = "scene",
        samples: int = 64,
    ) -> None:
        check_compiler()
        self.name = str(scene) if isinstance(scene, (str, Path)) else "scene"
        loaded = _load(Path(scene)) if isinstance(scene, (str, Path)) else scene
        shown = self._chosen(loaded.shapes(), shape)
        self.samples, self.static_light = samples, light == "scene"
        self._integrator = loaded.integrator()
        if not isinstance(self._integrator, mi.SamplingIntegrator):
            raise InputError(
                f"{self.name}: its integrator traces no paths from the camera; use direct or path"
            )
        if self.static_light and not loaded.emitters():
            raise InputError(
                f"{self.name}: has no light; add an emitter, or let each view bring its own "
                "(--light point)"
            )
        self._lit = loaded if self.static_light else _with_point_light(shown)
        self._shown = mi.load_dict({"type": "scene", **_numbered(shown)})
        self._holes = any(_has_holes(s) for s in shown)
        box = self._shown.bbox()
        self.bounds = np.array([np.array(box.min), np.array(box.max)], np.float64).reshape(2, 3)
        if not np.isfinite(self.bounds).all() or not (self.bounds[0] < self.bounds[1]).any():
            raise InputError(f"{self.name}: what it shows has no finite extent")

    def _chosen(self, shapes: Sequence[mi.Shape], name: str | None) -> list[mi.Shape]:
        if name is None:
            shown = [s for s in shapes if not s.is_emitter()]
            if not shown:
                raise InputError(f"{self.name}: has no shapes to show")
            return shown
        shown = [s for s in shapes if s.id() == name]
        if not shown:
            there = ", ".join(sorted({s.id() for s in shapes})) or "none"
            raise InputError(f"{self.name}: has no shape '{name}'; it has {there}")
        return shown

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]:
        """See ``Reference``."""
        side = math.ceil(math.sqrt(max(samples, self.samples)))
        out = []
        for k in range(len(views)):
            view = views[k : k + 1]
            if not self.static_light:
                self._place_light(view)
            try:
                out.append(self._picture(view, resolution, side))
            except RuntimeError as error:
                raise ReferenceRenderError(
                    f"{self.name}: view {k} could not be rendered: {_reason(error)}"
                ) from error
        return np.stack(out)

    def _place_light(self, view: Views) -> None:
        params = mi.traverse(self._lit)
        params["light.position"] = mi.Point3f([float(x) for x in view.light[0]])
        kind = type(params["light.intensity.value"])
        params["light.intensity.value"] = kind(float(view.intensity[0]))
        params.update()

    def _picture(self, view: Views, resolution: int, side: int) -> NDArray[np.float32]:
        """(resolution, resolution, 4) of one view with a path in each of ``side`` squared cells of
        every pixel."""
        seed = zlib.crc32(b"".join(np.ascontiguousarray(a).tobytes() for a in vars(view).values()))
        records, size = view.records(), dr.opaque(mi.Float, resolution)
        cells, pixels = side * side, resolution * resolution
        step = max(1, min(cells, MAX_RAYS // pixels))
        image = dr.zeros(mi.Float, pixels * 4)
        for first in range(0, cells, step):
            count = min(step, cells - first)
            color, weight, pixel = self._paths(
                records, size, resolution, side, first, count, seed + first
            )
            value = mi.ArrayXf([color.x, color.y, color.z, weight]) / dr.opaque(mi.Float, cells)
            dr.scatter_reduce(dr.ReduceOp.Add, image, value, pixel)
            dr.eval(image)
        return np.array(image).reshape(resolution, resolution, 4)

    def _paths(
        self,
        records: mi.Float,
        size: mi.Float,
        resolution: int,
        side: int,
        first: int,
        count: int,
        seed: int,
    ) -> tuple[mi.Color3f, mi.Float, mi.UInt32]:
        """(radiance, coverage, pixel) of one path for ``count`` cells of every pixel."""
        width = count * resolution * resolution
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, seed & 0xFFFFFFFF), width)
        index = dr.arange(mi.UInt32, width)
        many, rows = dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, resolution)
        columns = dr.opaque(mi.UInt32, side)
        pixel = index // many
        cell = index - pixel * many + dr.opaque(mi.UInt32, first)
        row, cell_row = pixel // rows, cell // columns
        jitter = sampler.next_2d()
        x = mi.Float(pixel - row * rows) + (mi.Float(cell - cell_row * columns) + jitter.x) / side
        y = mi.Float(row) + (mi.Float(cell_row) + jitter.y) / side
        camera = camera_of(records, dr.zeros(mi.UInt32, width))
        way = dr.normalize(direction(camera, x, y, size))
        covered, distance = self._first_hit(camera.eye, way, sampler)
        start = mi.Point3f(camera.eye + way * (distance * (1 - BEFORE)))
        ray = mi.RayDifferential3f(mi.Ray3f(start, way))
        color, _, _ = self._integrator.sample(self._lit, sampler, ray, None, covered)
        rgb = [
            dr.select(covered & dr.isfinite(c), dr.clip(c, 0.0, BRIGHTEST), 0.0)
            for c in mi.Color3f(color)
        ]
        return mi.Color3f(rgb), dr.select(covered, mi.Float(1), mi.Float(0)), pixel

    def _first_hit(
        self, origin: mi.Point3f, way: mi.Vector3f, sampler: mi.Sampler
    ) -> tuple[mi.Bool, mi.Float]:
        """(is anything there, how far away it is): holes of masked surfaces are looked through."""
        ray = mi.Ray3f(origin, way)
        if not self._holes:
            hit = self._shown.ray_intersect_preliminary(ray, coherent=True)
            valid = hit.is_valid()
            return valid, dr.select(valid, hit.t, 0.0)
        start, found = mi.Float(0), mi.Bool(False)
        searching, distance = mi.Bool(True), mi.Float(0)
        for _ in range(LAYERS):
            onward = mi.Ray3f(mi.Point3f(origin + way * start), way)
            seen = self._shown.ray_intersect(onward, active=searching)
            searching &= seen.is_valid()
            through = seen.bsdf().eval_null_transmission(seen, searching)
            at = start + seen.t
            stops = searching & (sampler.next_1d(searching) >= dr.mean(through))
            distance = dr.select(stops, at, distance)
            found |= stops
            searching &= ~stops
            start = dr.select(searching, at * (1 + BEFORE), start)
            dr.eval(found, searching, distance, start)
        return found, distance


def _load(path: Path) -> mi.Scene:
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    try:
        # merged shapes would lose their names
        scene = mi.load_file(str(path), optimize=False)
    except (RuntimeError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: Mitsuba cannot load it: {_reason(error)}") from error
    if not isinstance(scene, mi.Scene):
        raise InputError(f"{path}: is no scene, but a {type(scene).__name__}")
    return scene


def _with_point_light(shapes: Sequence[mi.Shape]) -> mi.Scene:
    light = {"type": "point", "position": [0.0, 0.0, 0.0]}
    return mi.load_dict({"type": "scene", "light": light, **_numbered(shapes)})


def _reason(error: Exception) -> str:
    """What Mitsuba says, without the places in its own source."""
    return " ".join(re.sub(r"\[\w+\.cpp:\d+\]", "", str(error)).split())


def _numbered(shapes: Sequence[mi.Shape]) -> dict[str, Any]:
    return {f"shown{k}": shape for k, shape in enumerate(shapes)}


def _has_holes(shape: mi.Shape) -> bool:
    bsdf = shape.bsdf()
    return bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
