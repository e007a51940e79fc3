"""A distance field as a reference and as a surface that is asked: against formulas and a mesh."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance_opt import sdf
from appearance_opt.asset.types import Asset, Material, Mesh
from appearance_opt.baking.closed_form import Settings, bake
from appearance_opt.errors import InputError
from appearance_opt.initial.sphere import sphere
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.sdf import SdfReference
from appearance_opt.reference.sdf_survey import SdfSurvey
from appearance_opt.reference.survey import MeshSurvey, Survey
from appearance_opt.sdf.check import check
from appearance_opt.sdf.sampling import isosurface
from appearance_opt.sdf.shape import Field, Placed, Shape
from appearance_opt.views import ViewSampler
from tests.conftest import grid_sphere
from tests.test_survey import RADIUS, BallSurvey

SIZE = 64
AROUND = ((-1.0,) * 3, (1.0,) * 3)
BALL = Shape(
    lambda p: sdf.sphere(p, RADIUS),
    AROUND,
    lambda p: sdf.Material(mi.Color3f(p.y * 0.25 + 0.5, 0.2, 0.1), 0.7),
)


def placed(field: Field) -> Placed:
    return Placed(field, (0.0, 0.0, 0.0), 1.0)


def survey(field: Field, triangles: int = 5000) -> SdfSurvey:
    return SdfSurvey(SdfReference(placed(field)), triangles)


def test_images_are_those_of_the_same_ball_as_a_mesh() -> None:
    p, f, _ = grid_sphere(192, 384, RADIUS)
    look = Material("m", base_color=(0.5, 0.2, 0.1), roughness=0.7, metalness=0.0)
    mesh = MeshReference(Asset((Mesh(p, f, p / np.float32(RADIUS), material=look),)))
    plain = Shape(BALL.distance, AROUND, lambda _: sdf.Material((0.5, 0.2, 0.1), 0.7))
    ball = SdfReference(placed(plain))
    views = ViewSampler((0.0, 0.0, 0.0), RADIUS).draw(0, 3)
    np.testing.assert_allclose(ball.bounds, AROUND)
    one, two = (r.render(views, 48, 16) for r in (mesh, ball))
    assert one.shape == two.shape and two.dtype == np.float32
    assert np.abs(one - two).mean() < 2e-3 and np.abs(one - two).max() < 0.1
    for a, b in zip(mesh.pair(views, 48, 8, 0.5), ball.pair(views, 48, 8, 0.5), strict=True):
        assert np.abs(a - b).mean() < 2e-3
    average, points = ball.pair(views, 48, 16, 0.5)
    np.testing.assert_allclose(average[..., 3], two[..., 3], atol=1e-6)  # exact at outlines
    assert set(np.unique(points[..., 3])) == {0.0, 1.0}


def test_a_ball_answers_as_its_formula_does() -> None:
    asked, formula = survey(BALL), BallSurvey()
    rng = np.random.default_rng(1)
    way = rng.normal(size=(500, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    origin = mi.Point3f((way * rng.uniform(0.8, 1.0, (500, 1))).T)
    direction = mi.Vector3f(way.T)
    for pick in ("nearest", "outermost"):
        found, expected = (
            s.find(origin, direction, mi.Float(0.2), pick)  # type: ignore[arg-type]
            for s in (asked, formula)
        )
        assert dr.all(found.valid)
        np.testing.assert_allclose(found.distance, expected.distance, atol=1e-4)
        here, there = asked.geometry(found), formula.geometry(expected)
        np.testing.assert_allclose(here.position, there.position, atol=1e-4)
        np.testing.assert_allclose(here.smooth, there.smooth, atol=1e-3)
        np.testing.assert_allclose(asked.curvature(found), 1 / RADIUS, rtol=0.02)
        look = asked.appearance(found, mi.Float(1e-6))
        np.testing.assert_allclose(look.base_color.x, 0.5 + 0.25 * here.position.y, atol=1e-5)
        np.testing.assert_allclose(look.roughness, 0.7, atol=1e-6)
    nothing = asked.find(origin, direction, mi.Float(1e-4))
    assert np.array(nothing.valid).mean() < 0.05
    outward = mi.Ray3f(origin * (1.01 * RADIUS) * dr.rsqrt(dr.squared_norm(origin)), direction)
    assert not dr.any(asked.blocked(outward, mi.Bool(True)))
    assert dr.all(asked.blocked(mi.Ray3f(outward.o, -direction), mi.Bool(True)))
    points, normals = asked.spread(100)
    assert 100 <= len(points) < 220
    np.testing.assert_allclose(points, normals * RADIUS, atol=1e-3)


def test_rays_take_the_side_that_faces_their_way_of_a_thin_wall() -> None:
    wall = Shape(lambda p: sdf.box(p, (0.5, 0.5, 0.02)), AROUND)
    origin = mi.Point3f([0.1, 0.1], [0.2, 0.2], [0.05, -0.05])
    way = mi.Vector3f([0, 0], [0, 0], [1, 1])
    found = survey(wall).find(origin, way, mi.Float(0.2))
    np.testing.assert_allclose(found.distance, [-0.03, 0.07], atol=2e-4)
    assert dr.all(found.valid)


def test_a_ball_is_baked_without_a_mesh() -> None:
    fields = ("material", "normal", "displacement", "ao", "curvature")
    mesh, asked = sphere(600, (0.0, 0.0, 0.0), 0.85, SIZE), survey(BALL)
    baked = bake(asked, mesh, Settings(SIZE, fields, ao_rays=8, fill_hidden=True))
    inside = baked.covered & ~baked.missed & ~baked.hidden
    assert inside.sum() == baked.covered.sum() > 0
    maps = {name: values[inside] for name, values in baked.maps.items()}
    assert maps["displacement"].min() > RADIUS - 0.85 - 1e-3
    np.testing.assert_allclose(maps["curvature"], 1 / RADIUS, rtol=0.02)
    np.testing.assert_allclose(maps["occlusion"], 1.0, atol=1e-5)
    assert maps["red"].min() < 0.35 and maps["red"].max() > 0.65


@pytest.mark.parametrize(
    ("distance", "volume"),
    [
        (lambda p: sdf.sphere(p, 0.7), 4 / 3 * np.pi * 0.7**3),
        (lambda p: sdf.torus(p, 0.6, 0.2), 2 * np.pi**2 * 0.6 * 0.04),
        (lambda p: sdf.box(p, (0.5, 0.4, 0.3)), 0.48),
    ],
)
def test_isosurfaces_lie_on_the_surface_and_wind_outward(distance: Callable, volume: float) -> None:
    p, f = isosurface(distance, np.array(AROUND), 20_000)
    assert 15_000 < len(f) < 27_000
    assert np.abs(np.array(distance(mi.Point3f(p.T)))).max() < 1e-4
    q = p[f].astype(np.float64)
    signed = np.einsum("ij,ij->i", q[:, 0], np.cross(q[:, 1], q[:, 2])).sum() / 6
    assert signed == pytest.approx(volume, rel=0.01)
    assert not np.bincount(np.unique(np.sort(f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0,
                                     return_counts=True)[1])[[1]].any()  # fmt: skip


def test_edges_and_corners_are_not_cut_off() -> None:
    distance = lambda p: sdf.box(sdf.rotate(p, (1, 2, 3), 30.0), (0.5, 0.4, 0.3))  # noqa: E731
    p, f = isosurface(distance, np.array(AROUND), 6000)
    q = p[f].astype(np.float64)
    cross = np.cross(q[:, 1] - q[:, 0], q[:, 2] - q[:, 0])
    # the whole of its faces, which cut edges would lack
    assert np.linalg.norm(cross, axis=1).sum() / 2 == pytest.approx(8 * 0.47, rel=2e-3)
    assert np.einsum("ij,ij->i", q[:, 0], np.cross(q[:, 1], q[:, 2])).sum() / 6 == pytest.approx(
        0.48, rel=1e-3
    )
    corners = np.abs(at_rest(p)) - (0.5, 0.4, 0.3)
    assert np.linalg.norm(corners, axis=1).min() < 2e-3


def at_rest(p: np.ndarray) -> np.ndarray:
    """Points of that box, turned back."""
    turned = sdf.rotate(mi.Point3f(np.ascontiguousarray(p.T)), (1, 2, 3), 30.0)
    return np.array(turned).T


def test_good_fields_are_taken_as_they_are() -> None:
    for distance in (BALL.distance, lambda p: sdf.torus(p, 0.6, 0.01)):
        found = check(placed(Shape(distance, AROUND)), "it")
        assert found.notes == () and found.tracing.safety == 1.0 and found.tracing.by_derivative
        assert np.abs(np.array(distance(mi.Point3f(found.points.T)))).max() < 1e-3


def test_steps_are_shortened_where_a_field_is_too_steep() -> None:
    steep = Shape(lambda p: 3 * sdf.sphere(p, 0.6), AROUND)
    found = check(placed(steep), "it")
    assert found.tracing.safety == pytest.approx(1 / 3, rel=0.02)
    assert "change by up to 3.0" in found.notes[0]
    jumps = Shape(lambda p: sdf.sphere(p, 0.6) * dr.select(p.x > 0, mi.Float(1), 6), AROUND)
    assert check(placed(jumps), "it").tracing.safety < 0.3
    views = ViewSampler((0.0, 0.0, 0.0), 0.6).draw(0, 1)
    shown = SdfReference(placed(steep), found.tracing).render(views, 32, 4)
    plain = SdfReference(placed(Shape(lambda p: sdf.sphere(p, 0.6), AROUND))).render(views, 32, 4)
    assert np.abs(shown - plain).max() < 0.05


def test_normals_are_those_of_differences_where_there_is_no_derivative() -> None:
    stuck = Shape(lambda p: dr.detach(sdf.sphere(p, 0.6)), AROUND)
    found = check(placed(stuck), "it")
    assert not found.tracing.by_derivative and "differences" in found.notes[0]
    reference = SdfReference(placed(stuck), found.tracing)
    normal = np.array(reference.normal(mi.Point3f(0.6, 0, 0)))
    np.testing.assert_allclose(normal[:, 0], (1, 0, 0), atol=2e-3)


def raising(p: mi.Point3f) -> mi.Float:
    raise ValueError("no such thing")


@pytest.mark.parametrize(
    ("distance", "words"),
    [
        (raising, r"distance\(p\) failed: test_sdf_reference.py:\d+: ValueError: no such thing"),
        (lambda p: "far", r"distance\(p\) failed"),
        (lambda p: sdf.sphere(p, 0.5) + dr.log(p.x + 0.5), "is not a finite number at"),
        (lambda p: -sdf.sphere(p, 0.5), "negative outside and positive inside"),
        (lambda p: sdf.sphere(p, 3.0), "leaves its bounds at"),
        (lambda p: sdf.sphere(sdf.translate(p, (0.8, 0, 0)), 0.5), "leaves its bounds at"),
        (lambda p: sdf.sphere(p, 0.5) + 1.0, "no surface in its bounds: the least distance"),
        (lambda p: abs(sdf.sphere(p, 0.5)), "nowhere negative"),
    ],
)
def test_fields_that_are_none_are_refused(distance: Callable, words: str) -> None:
    with pytest.raises(InputError, match=words) as refused:
        check(placed(Shape(distance, AROUND)), "it")
    assert str(refused.value).startswith("it: ") and "\n" not in str(refused.value)


def test_materials_are_looked_at_too() -> None:
    bright = Shape(BALL.distance, AROUND, lambda _: sdf.Material((2.0, 0, 0)))
    assert "from 0 to 2" in check(placed(bright), "it").notes[0]
    for material, words in (
        (lambda p: sdf.Material(mi.Color3f(dr.log(p.x)), 0.5), "not a finite number at"),
        (lambda p: 5, r"material\(p\) failed"),
    ):
        with pytest.raises(InputError, match=words):
            check(placed(Shape(BALL.distance, AROUND, material)), "it")


def test_a_survey_is_one() -> None:
    asked: Survey = survey(BALL)
    assert (asked.unlit, asked.emits, asked.uniform_emission) == (False, False, None)
    assert asked.triangles.single.all() and isinstance(survey(BALL), SdfSurvey)
    assert not isinstance(asked, MeshSurvey)
