"""What is seen through what: cut-outs, blended layers, transmission, and what has none of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from appearance_opt import compare
from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.errors import InputError
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.render import images, layers
from appearance_opt.views import Views, look_at
from tests.conftest import grid_sphere

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
COLORS = ((0.8, 0.1, 0.1), (0.1, 0.7, 0.2), (0.2, 0.2, 0.9))
MIDDLE = slice(12, 20)
"""Of 32 pixels: where all cards are seen."""


def card(z: float, material: Material, colors: NDArray | None = None, size: float = 1.0) -> Mesh:
    normals = np.tile(np.float32([0, 0, 1]), (4, 1))
    return Mesh(
        SQUARE * np.float32(size) + np.float32([0, 0, z]),
        FACES,
        normals,
        UVS,
        None,
        colors,
        material,
    )


def front(side: float = 1.0) -> Views:
    """From +z (or -z), with the light beside the camera."""
    return look_at([[0, 0, 8 * side]], np.zeros(3), 20.0, np.array([[2.0, 3.0, 7.0 * side]]), 300.0)


def image(*meshes: Mesh, views: Views | None = None, samples: int = 4) -> NDArray[np.float32]:
    return MeshReference(Asset(meshes)).render(front() if views is None else views, 32, samples)[0]


def stack(alphas: tuple[float, ...]) -> list[Mesh]:
    """Cards one behind the other, the first nearest to +z."""
    chosen = zip(alphas, COLORS, (0.5, 0.0, -0.5), strict=True)
    return [card(z, Material("m", c, 0.5, opacity=a, alpha_mode="blend")) for a, c, z in chosen]


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("alphas", [(0.25, 0.5, 0.75), (0.5, 1.0, 0.5), (0.0, 0.3, 1.0)])
def test_layers_are_blended_in_order(alphas: tuple[float, ...], side: float) -> None:
    """Porter and Duff's "over", from the eye on, whatever the order of the meshes."""
    cards = stack(alphas)
    got = image(cards[1], cards[2], cards[0], views=front(side))
    expected, light = np.zeros((32, 32, 4)), 1.0
    for mesh, alpha in list(zip(cards, alphas, strict=True))[:: int(side)]:
        solid = image(
            replace(mesh, material=replace(mesh.material, alpha_mode="opaque")), views=front(side)
        )
        expected += light * alpha * solid
        light *= 1 - alpha
    # colours of several materials are kept in half precision
    np.testing.assert_allclose(got[MIDDLE, MIDDLE], expected[MIDDLE, MIDDLE], rtol=2e-3)
    np.testing.assert_allclose(got[16, 16, 3], 1 - light, atol=1e-6)


def half(alpha: int = 255) -> Texture:
    """Nothing on the left, alpha on the right; texels are as sharp as the border between them."""
    pixels = np.full((64, 64, 4), (200, 120, 60, 0), np.uint8)
    pixels[:, 32:, 3] = alpha
    return Texture(pixels, "srgb", ("clamp", "clamp"))


@pytest.mark.parametrize(
    ("alpha", "cutoff", "seen"),
    [
        (255, 0.5, True),
        (51, 0.2, True),
        (50, 0.2, False),
        (255, 1.0, True),
        (254, 1.0, False),
        (0, 0.0, True),
    ],
)
def test_cut_outs_are_there_or_not(alpha: int, cutoff: float, seen: bool) -> None:
    """Where alpha is at least the cutoff; the comparison is exact."""
    leaf = Material("leaf", base_color_texture=half(alpha), alpha_mode="mask", alpha_cutoff=cutoff)
    got, solid = image(card(0, leaf)), image(card(0, replace(leaf, alpha_mode="opaque")))
    np.testing.assert_allclose(got[8:24, 19:24], solid[8:24, 19:24] * seen, atol=1e-6)
    assert got[8:24, 8:13, 3].max() == (1 if cutoff == 0 else 0)


def test_what_a_hole_shows_is_behind_it() -> None:
    leaf = Material("leaf", base_color_texture=half(), alpha_mode="mask")
    wall = card(-0.5, Material("wall", (0.1, 0.2, 0.7)))
    got, bare = image(card(0, leaf), wall), image(wall)
    np.testing.assert_allclose(got[8:24, 8:13], bare[8:24, 8:13], rtol=2e-3)  # half precision


def test_alpha_of_vertices_and_textures_and_factors_multiply() -> None:
    colors = np.full((4, 4), 0.5, np.float32)
    smoke = Material("smoke", base_color_texture=half(204), opacity=0.5, alpha_mode="blend")
    got = image(card(0, smoke, colors))
    np.testing.assert_allclose(
        got[8:24, 19:24, 3], 0.5 * 0.8 * 0.5, atol=1e-4
    )  # kept in half precision
    assert image(card(0, replace(smoke, alpha_mode="opaque"), colors))[8:24, 8:24, 3].min() == 1


def test_transmission_is_coverage() -> None:
    """1 - t (1 - F), F = 4 % at an index of 1.5."""
    share = Texture(np.full((4, 4, 3), (128, 0, 0), np.uint8))
    glass = Material("glass", transmission=0.5)
    for material, t in (
        (glass, 0.5),
        (replace(glass, transmission_texture=share), 0.5 * 128 / 255),
    ):
        np.testing.assert_allclose(image(card(0, material))[16, 16, 3], 1 - 0.96 * t, atol=5e-4)


def ball(material: Material) -> Mesh:
    positions, faces, uvs = grid_sphere(16, 32)
    return Mesh(positions, faces, positions, uvs, material=material)


@pytest.mark.parametrize("double_sided", [True, False])
def test_backs_are_seen_through_fronts(double_sided: bool) -> None:
    """A ball of one single-sided sheet keeps light back once, one that is double-sided twice."""
    sheet = Material("glass", opacity=0.5, alpha_mode="blend", double_sided=double_sided)
    got = image(ball(sheet))[16, 16, 3]
    np.testing.assert_allclose(got, 0.75 if double_sided else 0.5, atol=1e-5)


def test_backs_of_opaque_faces_are_not_seen_through_a_window() -> None:
    """The front half of a closed ball is glass; the other half, single-sided, turns its back to the
    eye."""
    whole = ball(Material("wall", double_sided=False))
    near = whole.positions[whole.faces].mean(axis=1)[:, 2] > 0
    glass = Material("glass", opacity=0.25, alpha_mode="blend", double_sided=False)
    window = replace(whole, faces=whole.faces[near], material=glass)
    got = image(replace(whole, faces=whole.faces[~near]), window)
    np.testing.assert_allclose(got[16, 16, 3], 0.25, atol=1e-5)


@pytest.mark.parametrize("empty", [4, 5])
def test_layers_end(monkeypatch: pytest.MonkeyPatch, empty: int) -> None:
    """What lies behind the last layer is not drawn."""
    monkeypatch.setattr(layers, "MOST", 5)
    veil = Material("veil", opacity=0.0, alpha_mode="blend")
    got = image(*(card(0.1 * k, veil) for k in range(1, empty + 1)), card(0, Material("wall")))
    assert got[16, 16, 3] == (1 if empty < 5 else 0)


def test_opaque_assets_pay_nothing() -> None:
    reference = MeshReference(Asset((card(0, Material("wall", opacity=0.5)),)))
    assert reference.coverage is None and reference._renderer is images
    assert reference.render(front(), 32, 4)[0, 16, 16, 3] == 1


def test_points_are_drawn_as_averages_are() -> None:
    reference = MeshReference(Asset(tuple(stack((0.25, 0.5, 0.75)))))
    average, points = reference.pair(front(), 32, 4, 0.4)
    np.testing.assert_allclose(average, reference.render(front(), 32, 4), atol=1e-6)
    np.testing.assert_allclose(
        points[0, MIDDLE, MIDDLE, 3], average[0, MIDDLE, MIDDLE, 3], atol=1e-5
    )


def test_nothing_is_not_like_nothing() -> None:
    """Two empty pictures are no proof of anything."""
    seen = Asset((card(0, Material("wall")),), "wall")
    gone = Asset((card(0, Material("veil", opacity=0.0, alpha_mode="blend")),), "veil")
    for pair in ((gone, gone), (gone, seen), (seen, gone)):
        with pytest.raises(InputError, match="veil: nothing of it is seen in any of the 2 views"):
            compare(*pair, views=2, resolution=32)
    empty = np.zeros((2, 16, 16, 4), np.float32)
    with pytest.raises(InputError, match="nothing is seen in any of 2 views"):
        compare_images(empty, empty)


def test_what_pictures_do_not_show_is_noted() -> None:
    glass, pane = (
        Asset((card(0, Material("m", **how)),)) for how in ({"transmission": 0.5}, {"opacity": 0.5})
    )
    told = compare(glass, pane, views=1, resolution=32).notes
    assert [n for n in told if n.startswith("transmission is drawn like blended alpha")]
    assert compare(pane, pane, views=1, resolution=32).notes == ()


def test_views_that_show_nothing_do_not_count() -> None:
    reference, candidate = np.zeros((2, 2, 16, 16, 4), np.float32)
    reference[0, 4:12, 4:12] = 1
    candidate[0, 4:12, 4:12] = (0.5, 0.5, 0.5, 1)
    got = compare_images(reference, candidate)
    assert (got.psnr, got.flip) == (got.views[0].psnr, got.views[0].flip)
    assert got.psnr_covered < 30
