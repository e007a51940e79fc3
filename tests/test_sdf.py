"""Distance functions, what they are put together with, and rays that meet them."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance_opt import sdf
from appearance_opt.sdf.normals import derivative, differences
from appearance_opt.sdf.shape import Placed, Shape
from appearance_opt.sdf.trace import TOLERANCE, clip, sphere_trace

Distance = Callable

SHAPES: dict[str, Distance] = {
    "sphere": lambda p: sdf.sphere(p, 0.6),
    "ellipsoid": lambda p: sdf.ellipsoid(p, (0.7, 0.5, 0.4)),
    "box": lambda p: sdf.box(p, (0.5, 0.3, 0.4)),
    "torus": lambda p: sdf.torus(p, 0.5, 0.2),
    "capsule": lambda p: sdf.capsule(p, (-0.4, 0, 0), (0.3, 0.2, 0.1), 0.2),
    "tapered": lambda p: sdf.capsule(p, (-0.4, 0, 0), (0.3, 0.2, 0.1), 0.3, 0.1),
    "cylinder": lambda p: sdf.cylinder(p, 0.4, 0.5),
    "cone": lambda p: sdf.cone(p, 0.5, 0.2, 0.4),
    "plane": lambda p: sdf.plane(p, (0.6, 0.8, 0.0), 0.1),
    "gyroid": lambda p: sdf.gyroid(p, 0.9, 0.1),
    "smooth": lambda p: sdf.smooth_union(sdf.sphere(p, 0.4), sdf.box(p, (0.6, 0.1, 0.2)), 0.2),
    "carved": lambda p: sdf.smooth_difference(sdf.sphere(p, 0.6), sdf.torus(p, 0.5, 0.2), 0.1),
    "both": lambda p: sdf.smooth_intersection(sdf.sphere(p, 0.6), sdf.box(p, (0.5, 0.3, 0.4)), 0.1),
    "twisted": lambda p: sdf.box(sdf.twist(p, 1.5), (0.4, 0.5, 0.2)),
    "repeated": lambda p: sdf.sphere(sdf.repeat(p, (0.5, 0, 0.5), (1, 0, 1)), 0.15),
    "elongated": lambda p: sdf.sphere(sdf.elongate(p, (0.3, 0.1, 0.0)), 0.2),
    "turned": lambda p: sdf.box(sdf.rotate(p, (1, 2, 3), 40.0), (0.5, 0.3, 0.2)),
    "scaled": lambda p: sdf.scale(lambda q: sdf.torus(q, 1.0, 0.4), p, 0.5),
    "rough": lambda p: sdf.sphere(p, 0.5) + 0.05 * sdf.fractal_noise(p * 4, 3),
}


def points(count: int, reach: float = 1.0, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-reach, reach, (count, 3))


def at(distance: Distance, p: np.ndarray) -> np.ndarray:
    return np.array(distance(mi.Point3f(p.T.astype(np.float32))))


@pytest.mark.parametrize("name", SHAPES)
def test_derivatives_are_those_of_differences(name: str) -> None:
    p = mi.Point3f(points(2000).T.astype(np.float32))
    exact, near = (np.array(f(SHAPES[name], p)) for f in (derivative, differences))
    assert np.isfinite(exact).all()
    off = np.abs(exact - near).max(axis=0)
    # but for points whose differences reach over a ridge or a border of copies
    assert np.quantile(off, 0.97) < 5e-3
    if name not in ("twisted", "rough", "ellipsoid"):
        assert np.linalg.norm(exact, axis=0).max() < 1.001


@pytest.mark.parametrize("name", SHAPES)
def test_derivatives_are_finite_at_the_origin_and_on_axes(name: str) -> None:
    p = np.concatenate([np.zeros((1, 3)), np.eye(3) * 0.3, np.eye(3) * -0.3])
    assert np.isfinite(np.array(derivative(SHAPES[name], mi.Point3f(p.T)))).all()


def exact_box(p: np.ndarray) -> np.ndarray:
    q = np.abs(p) - (0.5, 0.3, 0.4)
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


def exact_cone(p: np.ndarray) -> np.ndarray:
    """By the distance to a polygon, (radius, height), sampled finely."""
    corners = np.array([(0, -0.4), (0.5, -0.4), (0.2, 0.4), (0, 0.4)])
    t = np.linspace(0, 1, 4001)[:, None]
    line = np.concatenate([a + (b - a) * t for a, b in zip(corners, corners[1:], strict=False)])
    q = np.stack([np.hypot(p[:, 0], p[:, 2]), p[:, 1]], 1)
    away = np.sqrt(((q[:, None] - line[None]) ** 2).sum(-1).min(1))
    inside = (np.abs(q[:, 1]) < 0.4) & (q[:, 0] < 0.35 - 0.375 * q[:, 1])
    return np.where(inside, -away, away)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("sphere", lambda p: np.linalg.norm(p, axis=1) - 0.6),
        ("box", exact_box),
        ("cone", exact_cone),
        ("torus", lambda p: np.hypot(np.hypot(p[:, 0], p[:, 2]) - 0.5, p[:, 1]) - 0.2),
        ("plane", lambda p: p @ (0.6, 0.8, 0) - 0.1),
        ("scaled", lambda p: np.hypot(np.hypot(p[:, 0], p[:, 2]) - 0.5, p[:, 1]) - 0.2),
    ],
)
def test_distances_are_right(name: str, expected: Callable) -> None:
    p = points(300)
    np.testing.assert_allclose(at(SHAPES[name], p), expected(p), atol=5e-4)


def test_a_turned_shape_turns_counterclockwise() -> None:
    arm = lambda p: sdf.capsule(p, (0, 0, 0), (0.5, 0, 0), 0.1)  # noqa: E731
    turned = lambda p: arm(sdf.rotate(p, (0, 0, 1), 90.0))  # noqa: E731
    assert at(turned, np.array([[0.0, 0.5, 0.0]]))[0] == pytest.approx(-0.1, abs=1e-5)
    moved = lambda p: arm(sdf.translate(p, (0, 1, 0)))  # noqa: E731
    assert at(moved, np.array([[0.5, 1.0, 0.0]]))[0] == pytest.approx(-0.1, abs=1e-5)


def test_operations_put_together_what_they_say() -> None:
    p = points(500)
    a, b = SHAPES["sphere"], SHAPES["box"]
    x, y = at(a, p), at(b, p)
    combined = {
        "union": (sdf.union, np.minimum(x, y)),
        "intersection": (sdf.intersection, np.maximum(x, y)),
        "difference": (sdf.difference, np.maximum(x, -y)),
    }
    for name, (operation, expected) in combined.items():
        found = at(lambda q, o=operation: o(a(q), b(q)), p)
        np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=name)
    shell = at(lambda q: sdf.onion(a(q), 0.1), p)
    np.testing.assert_allclose(shell, np.abs(x) - 0.05, atol=1e-6)
    np.testing.assert_allclose(at(lambda q: sdf.round_off(b(q), 0.1), p), y - 0.1, atol=1e-6)
    smooth = at(lambda q: sdf.smooth_union(a(q), b(q), 0.2), p)
    assert (smooth <= np.minimum(x, y) + 1e-6).all()
    far = np.abs(x - y) > 0.2
    np.testing.assert_allclose(smooth[far], np.minimum(x, y)[far], atol=1e-6)
    mirrored = at(lambda q: sdf.sphere(sdf.translate(sdf.mirror(q), (0.5, 0, 0)), 0.1), p)
    np.testing.assert_allclose(
        mirrored, np.linalg.norm(np.abs(p) * (1, 0, 0) + p * (0, 1, 1) - (0.5, 0, 0), axis=1) - 0.1,
        atol=1e-5,
    )  # fmt: skip


def test_noise_is_smooth_and_depends_on_its_seed() -> None:
    line = np.stack([np.linspace(-3, 3, 6001), np.full(6001, 0.3), np.full(6001, 0.7)], 1)
    values = at(sdf.noise, line)
    assert np.abs(np.diff(values)).max() < 0.01 and values.std() > 0.1
    assert np.abs(values).max() < 1.5
    assert np.abs(at(lambda p: sdf.noise(p, 1), line) - values).max() > 0.1


def rays(count: int, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """From a sphere around the origin to points within it."""
    rng = np.random.default_rng(seed)
    origin = rng.normal(size=(count, 3))
    origin *= 3 / np.linalg.norm(origin, axis=1, keepdims=True)
    way = rng.uniform(-0.8, 0.8, (count, 3)) - origin
    return origin, way / np.linalg.norm(way, axis=1, keepdims=True)


def trace(distance: Distance, reach: float, safety: float = 1.0):  # type: ignore[no-untyped-def]
    shape = Shape(distance, ((-reach,) * 3, (reach,) * 3))
    origin, way = (mi.Point3f(a.T.astype(np.float32)) for a in rays(4000))
    way = mi.Vector3f(way)
    start, end = clip(shape, origin, way)
    return sphere_trace(distance, origin, way, start, end, safety)


def sphere_hits(origin: np.ndarray, way: np.ndarray) -> np.ndarray:
    along = np.sum(origin * way, 1)
    under = along**2 - np.sum(origin**2, 1) + 0.6**2
    return np.where(under > 0, -along - np.sqrt(np.maximum(under, 0)), np.inf)


def box_hits(origin: np.ndarray, way: np.ndarray) -> np.ndarray:
    half = np.array((0.5, 0.3, 0.4))
    one, two = (-half - origin) / way, (half - origin) / way
    near, far = np.minimum(one, two).max(1), np.maximum(one, two).min(1)
    return np.where(near < far, near, np.inf)


@pytest.mark.parametrize(("name", "hits"), [("sphere", sphere_hits), ("box", box_hits)])
@pytest.mark.parametrize("safety", [1.0, 0.6])
def test_rays_meet_what_formulas_say(name: str, hits: Callable, safety: float) -> None:
    found = trace(SHAPES[name], 0.65, safety)
    t, valid = np.array(found.t), np.array(found.valid)
    expected = hits(*rays(4000))
    # grazing rays within the tolerance of the outline may go either way
    assert np.mean(valid != np.isfinite(expected)) < 2e-3
    both = valid & np.isfinite(expected)
    assert both.sum() > 1000
    off = np.abs(t[both] - expected[both])
    assert np.quantile(off, 0.98) < 15 * TOLERANCE and np.median(off) < 2 * TOLERANCE
    assert np.array(found.residual)[both].max() < 10 * TOLERANCE
    assert np.array(found.steps).mean() < 30


def test_rays_that_pass_by_take_no_step() -> None:
    shape = Shape(SHAPES["sphere"], ((-0.6,) * 3, (0.6,) * 3))
    origin, way = mi.Point3f([2, 0], [2, 0], [2, 3]), mi.Vector3f([0, 0], [0, 0], [1, -1])
    start, end = clip(shape, origin, way)
    found = sphere_trace(shape.distance, origin, way, start, end)
    assert np.array(found.steps)[0] == 0 and np.array(found.valid).tolist() == [False, True]


def test_a_placed_field_is_the_same_elsewhere() -> None:
    world = Shape(
        lambda p: sdf.sphere(sdf.translate(p, (5, 6, 7)), 2.0),
        ((3, 4, 5), (7, 8, 9)),
        lambda p: sdf.Material((0.1, 0.2, p.x / 10)),
    )
    local = Placed(world, (5.0, 6.0, 7.0), 4.0)
    np.testing.assert_allclose(local.bounds, [[-0.5] * 3, [0.5] * 3])
    p = points(50)
    np.testing.assert_allclose(at(local.distance, p), np.linalg.norm(p, axis=1) - 0.5, atol=1e-5)
    made = local.material(mi.Point3f(p.T))
    np.testing.assert_allclose(np.array(made.base_color)[2], (5 + 4 * p[:, 0]) / 10, atol=1e-5)
    assert dr.allclose(made.roughness, 0.5) and dr.allclose(made.metalness, 0)
