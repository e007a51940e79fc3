"""Mitsuba scenes as references: coverage, light, what hides what, and what is refused."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance_opt import backend
from appearance_opt.errors import InputError
from appearance_opt.reference.base import PointReference
from appearance_opt.reference.plugins import MINIMUM_LLVM
from appearance_opt.reference.scene import BRIGHTEST, SceneReference
from appearance_opt.views import look_at

if TYPE_CHECKING:
    from pathlib import Path

    from appearance_opt.views import Views

RADIANCE, ALBEDO = 0.5, (0.7, 0.2, 0.1)

BALL = """<shape type="sphere" id="ball"><bsdf type="diffuse">
<rgb name="reflectance" value="0.7,0.2,0.1"/></bsdf></shape>"""
WALL = """<shape type="cube" id="wall"><transform name="to_world">
<scale value="0.3"/><translate z="2"/></transform></shape>"""
SKY = '<emitter type="constant"><rgb name="radiance" value="0.5"/></emitter>'
PATH = '<integrator type="path"><integer name="max_depth" value="2"/></integrator>'


@pytest.fixture(autouse=True)
def compiler(variant: str) -> None:
    if variant == backend.CPU and dr.detail.llvm_version()[0] < MINIMUM_LLVM:
        pytest.skip("Mitsuba's plugins need a newer LLVM")


def write(folder: Path, *parts: str) -> Path:
    path = folder / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{"".join(parts)}</scene>')
    return path


def front(light: float = 4.0) -> Views:
    return look_at([[0, 0, 8.0]], np.zeros(3), 20.0, np.array([[0, 0, light]]), 9 * np.pi)


def test_a_ball_under_an_even_sky_shows_its_albedo(tmp_path: Path) -> None:
    """Half of the sky lights every point of a convex body: radiance = albedo * that of the sky."""
    reference = SceneReference(write(tmp_path, PATH, BALL, SKY), samples=64)
    assert reference.static_light and not isinstance(reference, PointReference)
    np.testing.assert_allclose(reference.bounds, [[-1] * 3, [1] * 3])
    image = reference.render(front(), 24, 4)
    assert image.shape == (1, 24, 24, 4) and image.dtype == np.float32
    inside = image[0, 9:15, 9:15]
    np.testing.assert_allclose(inside[..., 3], 1)
    np.testing.assert_allclose(
        inside[..., :3].mean(axis=(0, 1)), RADIANCE * np.array(ALBEDO), rtol=0.02
    )
    assert (image[0, 0, 0] == 0).all()  # the sky itself is no part of the picture
    # the silhouette of a unit ball from a distance of 8: a disc of the radius tan(asin(1 / 8))
    radius = np.tan(np.arcsin(1 / 8)) / np.tan(np.radians(10))
    assert image[..., 3].mean() == pytest.approx(np.pi * radius**2 / 4, rel=0.01)
    np.testing.assert_array_equal(reference.render(front(), 24, 4), image)


def test_the_light_of_a_view_is_a_point(tmp_path: Path) -> None:
    """The middle of the ball faces a lamp at a distance of 3: radiance = albedo / pi * I / 9."""
    reference = SceneReference(write(tmp_path, PATH, BALL, SKY), light="point", samples=16)
    image = reference.render(front(), 65, 4)
    np.testing.assert_allclose(image[0, 32, 32, :3], ALBEDO, rtol=0.01)
    assert not reference.static_light
    dark = reference.render(front(-4.0), 65, 4)
    assert dark[0, 32, 32, :3].max() == 0 and dark[0, 32, 32, 3] == 1


def test_one_shape_is_shown_and_the_others_still_shade_it(tmp_path: Path) -> None:
    path = write(tmp_path, PATH, BALL, WALL, SKY)
    ball, both = SceneReference(path, "ball"), SceneReference(path)
    alone = SceneReference(write(tmp_path, PATH, BALL, SKY), "ball")
    image, whole, free = (r.render(front(), 24, 64) for r in (ball, both, alone))
    np.testing.assert_allclose(ball.bounds, alone.bounds)
    np.testing.assert_allclose(image[..., 3], free[..., 3], atol=0.05)  # nothing hides it
    middle = np.s_[0, 10:14, 10:14, 0]
    assert image[middle].mean() < 0.95 * free[middle].mean()  # less sky is left
    wall = 0.5 * RADIANCE  # Mitsuba's default reflectance; it stands before the ball
    assert whole[middle].mean() == pytest.approx(wall, rel=0.05)


def test_holes_of_masks_are_holes(tmp_path: Path) -> None:
    veil = BALL.replace('<bsdf type="diffuse">', '<bsdf type="mask"><bsdf type="diffuse">')
    veil = veil.replace("</bsdf>", '</bsdf><float name="opacity" value="{}"/></bsdf>')
    for opacity, covered in ((0.0, 0.0), (1.0, 1.0), (0.5, 0.75)):  # front and back of the ball
        reference = SceneReference(write(tmp_path, PATH, veil.format(opacity), SKY), samples=64)
        coverage = reference.render(front(), 16, 4)[0, 6:10, 6:10, 3].mean()
        assert coverage == pytest.approx(covered, abs=0.05)


def test_fireflies_are_bounded(tmp_path: Path) -> None:
    sun = SKY.replace("0.5", "4000")
    image = SceneReference(write(tmp_path, PATH, BALL, sun), samples=4).render(front(), 16, 4)
    assert image[..., :3].max() == pytest.approx(BRIGHTEST, rel=1e-5)


@pytest.mark.parametrize(
    ("parts", "arguments", "message"),
    [
        ((PATH, BALL, SKY), {"shape": "bull"}, "has no shape 'bull'; it has ball"),
        ((PATH, BALL.replace('"sphere"', '"spheroid"'), SKY), {}, "spheroid.*not found"),
        ((PATH, BALL), {}, "has no light"),
        ((PATH, SKY), {}, "no shapes to show"),
        ((PATH.replace("path", "ptracer"), BALL, SKY), {}, "traces no paths from the camera"),
        ((PATH, BALL, SKY, "<"), {}, "cannot load it"),
        (
            (PATH, '<shape type="ply"><string name="filename" value="gone.ply"/></shape>', SKY),
            {},
            "gone.ply.*file not found",
        ),
    ],
)
def test_what_cannot_be_shown_is_refused_in_one_line(
    tmp_path: Path, parts: tuple[str, ...], arguments: dict, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        SceneReference(write(tmp_path, *parts), **arguments)
    with pytest.raises(InputError, match="no such file"):
        SceneReference(tmp_path / "none.xml")


def test_a_loaded_scene_is_taken_too() -> None:
    scene = mi.load_dict(
        {
            "type": "scene",
            "i": {"type": "direct"},
            "s": {"type": "sphere"},
            "e": {"type": "constant"},
        }
    )
    assert SceneReference(scene, samples=4).render(front(), 8, 4)[0, 4, 4, 3] == 1
