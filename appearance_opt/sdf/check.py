"""Whether a field is one that can be worked with, and how: asked once before anything is drawn."""

from __future__ import annotations

import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.errors import InputError
from appearance_opt.sdf.normals import derivative, differences
from appearance_opt.sdf.sampling import Lattice, sample
from appearance_opt.sdf.trace import NEAR, STEPS, TOLERANCE, clip, sphere_trace

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from appearance_opt.sdf.shape import Placed

CELLS, RAYS = 64, 1 << 14
"""Cells along the longest side of the bounds at whose corners a field is looked at, and rays that
are traced for the check."""

STEEP, LEAST_SAFETY = 1.02, 1 / 32
"""Slope from which steps are shortened, and the least that they are shortened to."""

OVERSTEPPED = 2e-3
"""Share of rays that may overstep the surface, or run out of steps, before it is said."""

THROUGH = (0.003, 0.01, 0.03)
"""How far behind where half the steps meet the surface a ray is looked at, to see whether it is
inside there."""


@dataclass(frozen=True)
class Tracing:
    """How a field is asked. ``safety``: what its distances are multiplied with; ``by_derivative``:
    are its normals those of its derivative, or of differences?"""

    safety: float = 1.0
    by_derivative: bool = True


@dataclass(frozen=True)
class Checked:
    """``points`` (N, 3) of the surface, all around it; ``tracing``: what it takes; ``notes``: what
    the user should know."""

    points: NDArray[np.float32]
    tracing: Tracing
    notes: tuple[str, ...] = ()


def check(placed: Placed, name: str) -> Checked:
    """Look at a field in local coordinates, within the unit sphere; ``name``: what messages call it.
    Raises InputError if there is no surface to be found in its bounds, or if it leaves them, and
    for what raises or is no number."""
    world = placed.to_world
    lattice = Lattice.within(placed.bounds, CELLS)
    try:
        values = sample(placed.distance, lattice)
    except Exception as error:
        raise InputError(f"{name}: distance(p) failed: {blame(error)}") from error
    bad = ~np.isfinite(values)
    if bad.any():
        at = _show(world(lattice.points(bad)[:1])[0])
        raise InputError(f"{name}: distance(p) is not a finite number at {at}")
    _check_sign(values, lattice, placed, name)
    near = np.abs(values) < lattice.cell
    if not near.any():
        near = np.abs(values) <= np.quantile(np.abs(values), 0.01)
    points = project(placed.distance, lattice.points(near), lattice.cell)
    if not len(points):
        raise InputError(
            f"{name}: there is no surface in its bounds: the least distance there is "
            f"{values.min() * placed.scale:.4g}, and it must be negative inside"
        )
    by_derivative, notes = _choose_normals(placed, points)
    if not (values < 0).any() and _unsigned(placed, points):
        raise InputError(
            f"{name}: distance(p) is nowhere negative: it must be so inside; take sdf.onion for a "
            "shell of some thickness"
        )
    notes += _check_material(placed, points, name)
    safety, told = _choose_safety(placed, values, lattice, points)
    return Checked(points, Tracing(safety, by_derivative), tuple(notes + told))


def project(
    distance: Callable[[mi.Point3f], mi.Float], points: NDArray, reach: float, rounds: int = 6
) -> NDArray[np.float32]:
    """Those of points (N, 3) that Newton's steps along the gradient bring onto the surface, within
    about ``reach``."""
    p = mi.Point3f(np.ascontiguousarray(points.T, np.float32))
    for _ in range(rounds):
        slope = differences(distance, p)
        step = distance(p) / dr.fmax(dr.squared_norm(slope), 1e-6)
        p = p - slope * dr.fmin(dr.fmax(step, -reach), reach)
        dr.eval(p)
    arrived = np.array(abs(distance(p)) < NEAR * TOLERANCE)
    out = np.array(p).T
    return np.ascontiguousarray(out[arrived & np.isfinite(out).all(axis=1)], np.float32)


def blame(error: BaseException) -> str:
    """What went wrong in a user's function, in one line: the innermost line that is the user's own,
    and the innermost error."""
    while error.__cause__ is not None:
        error = error.__cause__
    own = Path(__file__).parents[1]
    frames = [
        f
        for f in traceback.extract_tb(error.__traceback__)
        if own not in Path(f.filename).parents and "site-packages" not in f.filename
    ]
    words = " ".join(f"{type(error).__name__}: {error}".split())
    if not frames or not frames[-1].filename.endswith(".py"):
        return words
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}: {words}"


def _check_sign(values: NDArray, lattice: Lattice, placed: Placed, name: str) -> None:
    border = np.ones(values.shape, bool)
    border[1:-1, 1:-1, 1:-1] = False
    out = border & (values < -NEAR * TOLERANCE)
    if not out.any():
        return
    if (values[border] < 0).mean() > 0.9 and (values[~border] > 0).any():
        raise InputError(
            f"{name}: distance(p) is negative outside and positive inside: return the negative of it"
        )
    at = _show(placed.to_world(lattice.points(out & (values == values[out].min()))[:1])[0])
    raise InputError(
        f"{name}: the shape leaves its bounds at {at}, where the distance is "
        f"{values[out].min() * placed.scale:.4g}: enlarge them, or intersect it with a box"
    )


def _choose_normals(placed: Placed, points: NDArray) -> tuple[bool, list[str]]:
    """(may normals be those of the derivative?, notes)"""
    p = mi.Point3f(points[:: max(1, len(points) // 4096)].T)
    expected = np.array(differences(placed.distance, p))
    try:
        found = np.array(derivative(placed.distance, p))
    except Exception:
        found = np.full_like(expected, np.nan)
    size = np.maximum(np.linalg.norm(expected, axis=0), 1e-6)
    off = np.linalg.norm(found - expected, axis=0) / size
    # edges are where differences see both sides
    if np.isfinite(found).all() and np.quantile(off, 0.8) < 0.1:
        return True, []
    return False, ["normals are those of differences, for its derivative is another or none"]


def _unsigned(placed: Placed, points: NDArray) -> bool:
    """Is the distance positive on both sides of the surface?"""
    p = mi.Point3f(points.T)
    n = differences(placed.distance, p)
    n *= dr.rsqrt(dr.fmax(dr.squared_norm(n), 1e-12))
    ways = [np.array(placed.distance(p + n * s)) for s in (-4 * TOLERANCE, 4 * TOLERANCE)]
    return bool(np.mean((ways[0] < 0) != (ways[1] < 0)) < 0.1)


def _check_material(placed: Placed, points: NDArray, name: str) -> list[str]:
    try:
        made = placed.material(mi.Point3f(points.T))
        width = len(points)
        color = np.array(made.base_color + dr.zeros(mi.Color3f, width))
        rest = [np.array(x + dr.zeros(mi.Float, width)) for x in made[1:]]
    except Exception as error:
        raise InputError(f"{name}: material(p) failed: {blame(error)}") from error
    values = np.concatenate([color, *(r[None] for r in rest)])
    bad = ~np.isfinite(values)
    if bad.any():
        at = _show(placed.to_world(points[bad.any(axis=0)][:1])[0])
        raise InputError(f"{name}: material(p) is not a finite number at {at}")
    if values.min() < -1e-3 or values.max() > 1 + 1e-3:
        return [
            f"materials were brought into [0, 1]: they go from {values.min():.3g} to "
            f"{values.max():.3g}"
        ]
    return []


def _choose_safety(
    placed: Placed, values: NDArray, lattice: Lattice, points: NDArray
) -> tuple[float, list[str]]:
    """(what distances must be multiplied with, notes): 1 where the field changes by no more than 1
    per unit of length near the surface, and rays agree with those of half the steps."""
    near = lattice.points(np.abs(values) < 6 * lattice.cell)
    p = mi.Point3f(near[:: max(1, len(near) // (1 << 16))].T.astype(np.float32))
    slopes = np.array(dr.norm(differences(placed.distance, p)))
    slope = float(np.quantile(slopes, 0.999))
    safety = 1.0 if slope <= STEEP else max(1 / slope, LEAST_SAFETY)
    origin, way = _rays(points)
    start, end = clip(placed, origin, way)

    def trace(factor: float):  # type: ignore[no-untyped-def]
        found = sphere_trace(placed.distance, origin, way, start, end, dr.opaque(mi.Float, factor))
        dr.eval(found)
        return found

    found = trace(safety)
    while True:
        finer = trace(safety / 2)
        # rays that graze the surface may go either way: those that went through it count
        missed = finer.valid & (finer.t < found.t - 2 * NEAR * TOLERANCE)
        through = mi.Bool(False)
        for depth in THROUGH:
            through |= placed.distance(dr.fma(way, finer.t + depth, origin)) < -NEAR * TOLERANCE
        over = np.array((found.valid & (found.residual < -NEAR * TOLERANCE)) | (missed & through))
        over = over.mean()
        if over <= OVERSTEPPED or safety / 2 < LEAST_SAFETY:
            break
        safety, found = safety / 2, finer
    notes = []
    if over > OVERSTEPPED:
        notes.append(
            f"{100 * over:.1f} % of rays step over the surface even with steps of {safety:.2g} of "
            "the distance: it jumps, or is far from one"
        )
    elif safety < 1:
        notes.append(
            f"distances change by up to {slope:.2f} per unit of length: rays take steps of "
            f"{safety:.2g} of them"
        )
    lost = np.array((found.steps == STEPS) & ~found.valid).mean()
    if lost > OVERSTEPPED:
        notes.append(
            f"{100 * lost:.1f} % of rays run out of their {STEPS} steps: distances are far below "
            "the true ones"
        )
    return safety, notes


def _rays(points: NDArray) -> tuple[mi.Point3f, mi.Vector3f]:
    """Rays from around the unit sphere to points of the surface, and past them."""
    rng = np.random.default_rng(0)
    origin = rng.normal(size=(RAYS, 3))
    origin *= 3 / np.linalg.norm(origin, axis=1, keepdims=True)
    target = points[rng.integers(0, len(points), RAYS)] + rng.normal(size=(RAYS, 3)) * 0.01
    way = target - origin
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    a, b = (np.ascontiguousarray(v.T, np.float32) for v in (origin, way))
    return mi.Point3f(a), mi.Vector3f(b)


def _show(point: Any) -> str:
    return f"({', '.join(f'{x:.4g}' for x in point)})"
