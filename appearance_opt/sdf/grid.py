"""Distance fields from values on a grid, as simulations, scans and other programs hand them out.

An .npz file (``numpy.savez``) holds ``distance`` (X, Y, Z): signed distances, negative inside, in
the unit of ``spacing`` (one number, or three); the value at [0, 0, 0] lies at ``origin`` (three
numbers, by default zero). Optional: ``color`` (X, Y, Z, 3): linear RGB as floats in [0, 1], or sRGB
as uint8; ``roughness`` and ``metalness`` (X, Y, Z) in [0, 1]; ``interpolation``: "linear" (the
default) or "cubic" (an interpolating B-spline: smooth normals, four times as slow). Pickled arrays
are refused, never opened: such a file can do no harm.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import spline_filter

from appearance_opt.asset.door import reading
from appearance_opt.asset.types import srgb_to_linear
from appearance_opt.errors import InputError
from appearance_opt.memory import available_memory
from appearance_opt.render.math import clamp
from appearance_opt.sdf.shape import GREY, Material

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

KEYS = ("distance", "spacing", "origin", "color", "roughness", "metalness", "interpolation")
INTERPOLATIONS = ("linear", "cubic")
CHANNELS = 8
"""Floats of a packet of material: RGB, roughness, metalness, nothing."""

PADDING = 3
"""Values beyond the border from which splines take their slopes there."""

SHARE = 0.25
"""Share of the free memory that a file's arrays may take."""


class GridField:
    """A ``Field`` of values on a grid, between which it interpolates; beyond its border they stay
    what they are there. ``distance`` (X, Y, Z); ``look`` (X, Y, Z, 5): linear RGB, roughness and
    metalness, None for grey; ``spacing``, ``origin``: three numbers each."""

    def __init__(
        self,
        distance: NDArray[np.floating],
        spacing: NDArray[np.floating],
        origin: NDArray[np.floating],
        look: NDArray[np.floating] | None = None,
        cubic: bool = False,
    ) -> None:
        size = np.array(distance.shape) - 1
        self.bounds = np.stack([origin, origin + spacing * size])
        self._cubic = cubic
        values, low = np.asarray(distance), origin
        if cubic:  # slopes go on over the border, where mirrored values would have none
            values = np.pad(values, PADDING, mode="reflect", reflect_type="odd")
            values, low = spline_filter(values, 3, np.float32, "mirror"), low - PADDING * spacing
        self._distance = Values.of(values[..., None], spacing, low)
        self._look = None
        if look is not None:
            packed = np.zeros((*look.shape[:3], CHANNELS), np.float32)
            packed[..., : look.shape[3]] = look
            self._look = Values.of(packed, spacing, origin)

    def distance(self, p: mi.Point3f) -> mi.Float:
        """See ``Field``."""
        return (self._distance.cubic(p) if self._cubic else self._distance.linear(p))[0]

    def material(self, p: mi.Point3f) -> Material:
        """See ``Field``."""
        if self._look is None:
            return GREY
        red, green, blue, roughness, metalness, *_ = self._look.linear(p)
        return Material(mi.Color3f(red, green, blue), roughness, metalness)


@dataclass(frozen=True)
class Values:
    """Packets of ``channels`` floats on a grid of ``shape`` points, on the device."""

    buffer: mi.Float
    shape: tuple[int, int, int]
    channels: int
    spacing: tuple[float, float, float]
    origin: tuple[float, float, float]

    @classmethod
    def of(cls, values: NDArray, spacing: NDArray, origin: NDArray) -> Values:
        """Upload (X, Y, Z, C) values."""
        x, y, z, channels = values.shape
        buffer = mi.Float(np.ascontiguousarray(values, np.float32).ravel())
        sx, sy, sz = spacing.tolist()
        ox, oy, oz = origin.tolist()
        return cls(buffer, (x, y, z), channels, (sx, sy, sz), (ox, oy, oz))

    def linear(self, p: mi.Point3f) -> list[mi.Float]:
        """The channels at points, trilinear."""
        cells, inside = self._cells(p)
        weights = [(1 - f, f) for f in inside]
        return self._sum(cells, weights, 0)

    def cubic(self, p: mi.Point3f) -> list[mi.Float]:
        """The same by cubic B-splines whose coefficients the values are; mirrored at the border,
        as ``scipy.ndimage.spline_filter`` does it."""
        cells, inside = self._cells(p)
        weights = []
        for f in inside:
            g = 1 - f
            weights.append(
                (
                    g * g * g / 6,
                    (4 - 6 * f * f + 3 * f * f * f) / 6,
                    (4 - 6 * g * g + 3 * g * g * g) / 6,
                    f * f * f / 6,
                )
            )
        return self._sum(cells, weights, -1)  # type: ignore[arg-type]

    def _cells(self, p: mi.Point3f) -> tuple[list[mi.Int32], list[mi.Float]]:
        """The cell along each axis, and the place within it from 0 to 1."""
        cells, inside = [], []
        for x, n, spacing, origin in zip(p, self.shape, self.spacing, self.origin, strict=True):
            at = clamp((x - origin) / spacing, 0, n - 1)
            cell = mi.Int32(dr.fmin(dr.floor(dr.detach(at)), n - 2))
            cells.append(cell)
            inside.append(at - mi.Float(cell))
        return cells, inside

    def _sum(
        self, cells: list[mi.Int32], weights: list[tuple[mi.Float, ...]], first: int
    ) -> list[mi.Float]:
        places = [
            [_mirrored(c + first + k, n) for k in range(len(w))]
            for c, w, n in zip(cells, weights, self.shape, strict=True)
        ]
        total = [mi.Float(0)] * self.channels
        _, ny, nz = self.shape
        for i, j, k in product(*(range(len(w)) for w in weights)):
            index = mi.UInt32((places[0][i] * ny + places[1][j]) * nz + places[2][k])
            weight = weights[0][i] * weights[1][j] * weights[2][k]
            if self.channels == 1:
                found = [dr.gather(mi.Float, self.buffer, index)]
            else:
                shape = (self.channels, dr.width(index))
                found = list(dr.gather(mi.ArrayXf, self.buffer, index, shape=shape))
            total = [dr.fma(v, weight, t) for v, t in zip(found, total, strict=True)]
        return total


def _mirrored(index: mi.Int32, size: int) -> mi.Int32:
    index = dr.select(index < 0, -index, index)
    return dr.select(index >= size, 2 * (size - 1) - index, index)


def read_grid(path: Path) -> GridField:
    """A field from an .npz file (see above). Raises InputError."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    with reading(path):
        _check_size(path)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files if name in KEYS}
        except ValueError as error:
            if "pickle" not in str(error):
                raise
            raise InputError(
                f"{path}: holds pickled objects, which are never opened; save plain arrays of "
                "numbers with numpy.savez"
            ) from error
    return make_grid(arrays, str(path))


def make_grid(arrays: Mapping[str, NDArray], name: str) -> GridField:
    """A field from the arrays of such a file. Raises InputError for wrong shapes, types and
    values; ``name`` is what messages call them."""
    for needed in ("distance", "spacing"):
        if needed not in arrays:
            there = ", ".join(arrays) or "none of what a grid needs"
            raise InputError(f"{name}: has no '{needed}'; it has {there}")
    distance = _floats(arrays["distance"], "distance", name)
    if distance.ndim != 3 or min(distance.shape) < 4:
        raise InputError(
            f"{name}: 'distance' has the shape {distance.shape}: it must be (X, Y, Z), at least 4 "
            "values along each axis"
        )
    spacing = _three(arrays["spacing"], "spacing", name)
    if not (spacing > 0).all():
        raise InputError(f"{name}: 'spacing' is {spacing.tolist()}: it must be above zero")
    origin = _three(arrays.get("origin", np.zeros(3)), "origin", name)
    extent = float(np.linalg.norm(spacing * distance.shape))
    largest = float(np.abs(distance).max())
    if largest > 1e6 * extent:
        raise InputError(
            f"{name}: distances of up to {largest:.3g} in a grid {extent:.3g} long: they may have "
            "been stored in the other byte order, or 'spacing' in another unit"
        )
    interpolation = str(arrays.get("interpolation", "linear"))
    if interpolation not in INTERPOLATIONS:
        raise InputError(
            f"{name}: 'interpolation' is '{interpolation[:40]}': it must be linear or cubic"
        )
    look = _look(arrays, distance.shape, name)
    return GridField(distance, spacing, origin, look, interpolation == "cubic")


def _look(
    arrays: Mapping[str, NDArray], shape: tuple[int, ...], name: str
) -> NDArray[np.float32] | None:
    """(X, Y, Z, 5) what is given of the material, the rest as ``GREY``; None if nothing is."""
    if not any(n in arrays for n in ("color", "roughness", "metalness")):
        return None
    look = np.empty((*shape, 5), np.float32)
    look[...] = (*GREY.base_color, GREY.roughness, GREY.metalness)
    for key, at, channels in (("color", slice(0, 3), 3), ("roughness", 3, 0), ("metalness", 4, 0)):
        if key not in arrays:
            continue
        given, expected = arrays[key], (*shape, channels) if channels else shape
        if given.shape != expected:
            raise InputError(
                f"{name}: '{key}' has the shape {given.shape}: it must be {expected}, as "
                "'distance' has it"
            )
        if given.dtype == np.uint8:
            given = given / np.float32(255)
            look[..., at] = srgb_to_linear(given) if key == "color" else given
        else:
            look[..., at] = _floats(given, key, name)
    return look


def _floats(given: NDArray, key: str, name: str) -> NDArray[np.float32]:
    if given.dtype.kind != "f":
        raise InputError(f"{name}: '{key}' holds {given.dtype}: it must hold floats")
    with np.errstate(over="ignore"):
        out = given.astype(np.float32)
    if not np.isfinite(out).all():
        at = np.argwhere(~np.isfinite(out))[0].tolist()
        raise InputError(f"{name}: '{key}' is not a finite number at {at}")
    return out


def _three(given: NDArray, key: str, name: str) -> NDArray[np.float64]:
    good = given.dtype.kind in "fiu" and given.size in ((1, 3) if key == "spacing" else (3,))
    if not good or not np.isfinite(given.astype(np.float64)).all():
        raise InputError(
            f"{name}: '{key}' must be three finite numbers, not {given.tolist()!s:.60}"
        )
    return np.broadcast_to(given.astype(np.float64).ravel(), 3).copy()


def _check_size(path: Path) -> None:
    free = available_memory()
    with zipfile.ZipFile(path) as archive:
        size = sum(info.file_size for info in archive.infolist())
    if free is not None and size > SHARE * free:
        raise InputError(
            f"{path}: its arrays take {size / 2**30:.1f} GB, and {free / 2**30:.1f} GB are free"
        )
