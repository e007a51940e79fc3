"""What baking and starts ask of a surface can be answered by what is no mesh: a ball by formula."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.asset.packing import EMISSION
from appearance_opt.asset.types import Asset, Material, Mesh
from appearance_opt.baking.closed_form import Settings, bake
from appearance_opt.errors import InputError
from appearance_opt.initial.sphere import sphere
from appearance_opt.initial.transfer import transfer_emission
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.subject import Subject
from appearance_opt.reference.survey import (
    Appearance,
    Found,
    Geometry,
    MeshSurvey,
    Pick,
    Survey,
    Triangles,
)
from appearance_opt.stages.start import require_survey
from appearance_opt.views import ViewSampler
from tests.conftest import grid_sphere

RADIUS, LIGHT = 0.9, (0.1, 0.2, 0.3)
SIZE = 64


class BallSurvey:
    """A ball around the origin, red by height. ``Found.place`` is the point itself."""

    bounds = np.array([[-RADIUS] * 3, [RADIUS] * 3])
    unlit, emits = False, True

    @property
    def uniform_emission(self) -> dict[str, float]:
        return dict(zip(EMISSION, LIGHT, strict=True))

    @property
    def triangles(self) -> Triangles:
        raise AssertionError("a bake asks for no triangles")

    def spread(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        normals = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return np.float32(RADIUS) * normals, normals

    def find(
        self, origin: mi.Point3f, direction: mi.Vector3f, reach: mi.Float, pick: Pick = "nearest"
    ) -> Found:
        along = dr.dot(origin, direction)
        under = along * along - dr.squared_norm(origin) + RADIUS**2
        t = dr.sqrt(dr.fmax(under, 0)) - along  # where the surface faces the way of the ray
        place = mi.Point3f(origin + direction * t)
        return Found(t, (under > 0) & (dr.abs(t) < reach), place)

    def geometry(self, found: Found) -> Geometry:
        normal = dr.normalize(mi.Vector3f(found.place))
        return Geometry(found.place, normal, mi.Vector3f(normal))

    def appearance(self, found: Found, area: mi.Float) -> Appearance:
        red = found.place.y * 0.25 + 0.5
        color = mi.Color3f(red, 0.2, 0.1)
        normal = dr.normalize(mi.Vector3f(found.place))
        return Appearance(color, mi.Float(0.7), mi.Float(0.0), normal)

    def emission(self, found: Found, area: mi.Float) -> list[mi.Float]:
        return [mi.Float(x) for x in LIGHT]

    def curvature(self, found: Found) -> mi.Float:
        return dr.full(mi.Float, 1 / RADIUS, dr.width(found.distance))

    def front_only(self, found: Found) -> mi.Bool | None:
        return None

    def blocked(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        along = dr.dot(ray.o, ray.d)
        under = along * along - dr.squared_norm(ray.o) + (RADIUS * (1 - 1e-4)) ** 2
        return active & (under > 0) & (along < 0)


FIELDS = ("material", "normal", "displacement", "ao", "curvature", "emission")


def test_a_ball_by_formula_is_baked_without_a_mesh() -> None:
    mesh = sphere(600, (0.0, 0.0, 0.0), 0.85, SIZE)
    survey: Survey = BallSurvey()
    baked = bake(survey, mesh, Settings(SIZE, FIELDS, ao_rays=8, fill_hidden=True))
    inside = baked.covered & ~baked.missed & ~baked.hidden
    assert inside.sum() == baked.covered.sum() > 0
    maps = {name: values[inside] for name, values in baked.maps.items()}
    # the base mesh lies below its own radius between its vertices, by less than 2 %
    assert maps["displacement"].min() > RADIUS - 0.85 - 1e-3
    assert maps["displacement"].max() < RADIUS - 0.85 * 0.97
    np.testing.assert_allclose(maps["curvature"], 1 / RADIUS, rtol=1e-5)
    np.testing.assert_allclose(maps["occlusion"], 1.0, atol=1e-5)  # a ball hides nothing of itself
    np.testing.assert_allclose(maps["roughness"], 0.7, atol=1e-5)
    assert maps["red"].min() < 0.35 and maps["red"].max() > 0.65
    for name, value in zip(EMISSION, LIGHT, strict=True):
        np.testing.assert_allclose(maps[name], value, atol=1e-6)
    assert transfer_emission(survey, mesh, SIZE) == survey.uniform_emission


def test_a_fine_mesh_answers_as_the_formula_does() -> None:
    p, f, _ = grid_sphere(96, 192, RADIUS)
    survey = MeshSurvey(
        MeshReference(Asset((Mesh(p, f, p / np.float32(RADIUS), material=Material("m")),)))
    )
    np.testing.assert_allclose(survey.bounds, BallSurvey.bounds, atol=1e-3)
    assert (survey.unlit, survey.emits, survey.uniform_emission) == (False, False, None)
    rng = np.random.default_rng(1)
    way = rng.normal(size=(500, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    origin = mi.Point3f((way * rng.uniform(0.8, 1.0, (500, 1))).T)
    for pick in ("nearest", "outermost"):
        found, expected = (
            s.find(origin, mi.Vector3f(way.T), mi.Float(0.2), pick)  # type: ignore[arg-type]
            for s in (survey, BallSurvey())
        )
        assert dr.all(found.valid)
        np.testing.assert_allclose(found.distance, expected.distance, atol=1e-3)
        here, there = survey.geometry(found), BallSurvey().geometry(expected)
        np.testing.assert_allclose(here.position, there.position, atol=1e-3)
        np.testing.assert_allclose(here.smooth, there.smooth, atol=5e-3)
        # but for the poles, where 192 thin triangles meet
        assert np.median(np.array(survey.curvature(found))) == pytest.approx(1 / RADIUS, rel=0.01)
    nothing = survey.find(origin, mi.Vector3f(way.T), mi.Float(1e-4))
    assert np.array(nothing.valid).mean() < 0.05
    points, normals = survey.spread(100)
    assert 100 <= len(points) < 220 and points.shape == normals.shape


def test_what_only_images_are_known_of_has_no_surface() -> None:
    subject = Subject(
        MeshReference(Asset((Mesh(*grid_sphere(4, 8)[:2]),))), ViewSampler((0, 0, 0), 1)
    )
    assert not subject.unlit
    with pytest.raises(InputError, match="images are all that is known"):
        require_survey(subject)
