"""Hard cases of the renderer: each has a finite image and finite gradients."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.initial.sphere import sphere
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.export import to_asset
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.positions import POSITIONS
from appearance_opt.latent.texels import TEXELS
from appearance_opt.optimize.losses import LOSSES
from appearance_opt.optimize.step import Gradients, StepInputs
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.pool import Targets
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.boundary.edges import Edges
from appearance_opt.render.boundary.pairs import Pairs
from appearance_opt.render.images import render_image
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.quality import Quality
from appearance_opt.views import Views, ViewSampler, look_at
from tests.conftest import grid_sphere, make_asset
from tests.drawing import drawn_of

SAMPLER = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=5)
CHANNELS = {
    "red": 0.6, "green": 0.3, "blue": 0.2, "roughness": 0.4, "metalness": 0.3,
    "normal_x": 0.1, "normal_y": 0.0, "normal_z": 1.0,
}  # fmt: skip


def latent(positions: object, faces: object, uvs: object = None) -> LatentMesh:
    """A latent with one render vertex per corner; by default every triangle has the same UV
    triangle."""
    f = np.asarray(faces, np.int32).reshape(-1, 3)
    corners = np.tile([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]], (len(f), 1)) if uvs is None else uvs
    frames = np.arange(3 * len(f), dtype=np.int32).reshape(-1, 3)
    p = np.asarray(positions, np.float32).reshape(-1, 3)
    return LatentMesh(p, f, f.ravel(), frames, np.asarray(corners, np.float32).reshape(-1, 2))


def model_of(mesh: LatentMesh, size: int = 16, **values: float) -> Latent:
    maps = {k: np.full((size, size), v, np.float32) for k, v in {**CHANNELS, **values}.items()}
    return latent_of(mesh, maps, frozenset(["shape", "normal", "material"]), Rates())


def front(
    distance: float = 3.0, fov: float = 40.0, light: tuple = (1.0, 1.0, 3.0), power: float = 20.0
) -> Views:
    """One camera on the z axis that looks at the origin."""
    return look_at(np.array([[0, 0, distance]]), np.zeros(3), fov, np.array([light]), power)


EDGES = Quality(visibility=CameraRays((Edges(2.0),), 4))
PAIRS = Quality(visibility=Pairs())


def check(
    mesh: LatentMesh | Latent,
    views: Views,
    resolution: int = 24,
    loss: str = "log-srgb-l1",
    quality: Quality = EDGES,
    **values: float,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Image (H, W, 4) of the first view and gradients by name, all finite; ``values``: of the
    maps."""
    model = mesh if isinstance(mesh, Latent) else model_of(mesh, **values)
    grid = Grid(len(views), resolution)
    target = np.zeros((grid.pixels, 4), np.float32)
    target[: grid.pixels // 2] = (0.2, 0.3, 0.4, 1.0)
    background = np.full((len(views), 3), 0.4, np.float32)
    inputs = StepInputs(views, Targets(mi.Float(target.ravel())), background, 0.0, 1.0, 3)
    value, grads = Gradients(model, grid, quality, LOSSES[loss], freeze=False)(inputs)
    image = np.array(render_image(drawn_of(model), Batch(views.records(), grid), 4))
    assert np.isfinite(image).all() and (image >= 0).all()
    assert np.isfinite(float(value[0]))
    host = {n: np.array(g) for n, g in grads.items()}
    for name, g in host.items():
        assert np.isfinite(g).all(), (
            f"{name}: {np.count_nonzero(~np.isfinite(g))} of {g.size} are not finite"
        )
        assert g.size == dr.width(model.parameters[name].value)
    return image.reshape(len(views), resolution, resolution, 4)[0], host


TRIANGLE = [[-1, -1, 0], [1, -1, 0], [0, 1, 0]]


def test_one_triangle() -> None:
    image, grads = check(latent(TRIANGLE, [[0, 1, 2]]), front())
    # corners project to +-11 of 12 pixels: area 2 of the (2 * 3 tan 20)^2 = 4.77 that the image
    # shows
    assert image[..., 3].mean() == pytest.approx(
        2 / 4.77, abs=0.01
    )  # measured 0.4197 against 0.4193
    assert np.abs(grads[POSITIONS]).max() > 0 and np.abs(grads[TEXELS]).max() > 0


@pytest.mark.parametrize(
    ("positions", "faces"),
    [
        pytest.param(
            [*TRIANGLE, [0, 0, 0.5]], [[0, 1, 2], [0, 0, 3], [1, 1, 1]], id="degenerate corners"
        ),
        pytest.param([*TRIANGLE, [2, -1, 0]], [[0, 1, 2], [0, 1, 3]], id="collinear"),
        pytest.param([*TRIANGLE, [0, -1 - 2e-6, 0]], [[0, 1, 2], [1, 0, 3]], id="sliver"),
        pytest.param([[-1, 0, 0], [1, 0, 0], [0, 2e-6, 0]], [[0, 1, 2]], id="nothing but a sliver"),
        pytest.param(TRIANGLE, [[0, 1, 2], [0, 1, 2], [2, 1, 0]], id="duplicates of both windings"),
        pytest.param(
            [*TRIANGLE, [0, 0, 1], [0, 0, -1]],
            [[0, 1, 2], [1, 0, 3], [0, 1, 4]],
            id="non-manifold edge",
        ),
        pytest.param([*TRIANGLE, [9, 9, 9]], [[0, 1, 2]], id="isolated vertex"),
        pytest.param([[0, 0, 0]] * 3, [[0, 1, 2]], id="a point"),
        pytest.param([*TRIANGLE, *TRIANGLE], [[0, 1, 2], [5, 4, 3]], id="double sheet"),
    ],
)
def test_bad_triangles(positions: list, faces: list) -> None:
    for quality in (EDGES, PAIRS):
        check(latent(positions, faces), front(), quality=quality)


def test_normals_that_cancel() -> None:
    # two windings share their vertices: the sum of the normals is zero at each, so that faces have
    # their own. Whichever of the two a ray hits, it is lit like the one that faces it, from both
    # sides.
    faces = [[0, 1, 2], [2, 1, 0]]
    behind = look_at(
        np.array([[0, 0, -3.0]]), np.zeros(3), 40.0, np.array([[1.0, 1.0, -3.0]]), 20.0
    )
    plain = {"normal_x": 0.0}  # coincident triangles disagree about the direction of their tangents
    for views, face in ((front(), faces[0]), (behind, faces[1])):
        image, _ = check(latent(TRIANGLE, faces), views, **plain)
        expected, _ = check(latent(TRIANGLE, [face]), views, **plain)
        np.testing.assert_allclose(image[12, 12], expected[12, 12], rtol=1e-4)
        sheet = Asset((Mesh(np.array(TRIANGLE, np.float32), np.array(faces, np.int32)),))
        alone = Asset((Mesh(np.array(TRIANGLE, np.float32), np.array([face], np.int32)),))
        drawn, wanted = (MeshReference(a).render(views, 25, 1)[0, 12, 12] for a in (sheet, alone))
        np.testing.assert_allclose(drawn, wanted, rtol=1e-4)
    written = to_asset(
        latent(TRIANGLE, faces), np.array(TRIANGLE, np.float32), CHANNELS, "sheet"
    ).meshes[0]
    assert written.normals is not None
    np.testing.assert_array_equal(written.normals[written.faces].mean(1), [[0, 0, 1], [0, 0, -1]])
    # vertex normals of a folded strip point apart: they cancel between the vertices
    p = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, -1], [1, 0, 1]], np.float32)
    n = np.array([[0, 0, 1], [0, 0, 1], [0, 0, -1], [0, 0, -1]], np.float32)
    mesh = Mesh(p[:, [0, 2, 1]], np.array([[0, 2, 1], [1, 2, 3]], np.int32), n)
    image = MeshReference(Asset((mesh,))).render(front(), 25, 1)
    assert np.isfinite(image).all() and (image >= 0).all()


@pytest.mark.parametrize(
    "uvs",
    [
        pytest.param([[0.3, 0.3]] * 3, id="zero area"),
        pytest.param([[0.1, 0.1], [0.1, 0.9], [0.9, 0.1]], id="mirrored"),
        pytest.param([[0.1, 0.5], [0.5, 0.5], [0.9, 0.5]], id="a line"),
        pytest.param([[-3e4, 0], [5e4, 1e4], [0, 6e4]], id="far away"),
    ],
)
def test_bad_texture_coordinates(uvs: list) -> None:
    image, _ = check(latent(TRIANGLE, [[0, 1, 2]], uvs), front())
    assert image[12, 12, 0] > 0
    for wrap in ("repeat", "mirror", "clamp"):
        pixels = np.random.default_rng(0).integers(0, 255, (7, 5, 3)).astype(np.uint8)
        texture = Texture(pixels, "srgb", (wrap, wrap))
        material = Material(
            base_color_texture=texture, normal_texture=replace(texture, color_space="linear")
        )
        mesh = Mesh(
            np.float32(TRIANGLE), np.int32([[0, 1, 2]]), uvs=np.float32(uvs), material=material
        )
        image = MeshReference(Asset((mesh,))).render(front(), 24, 4)
        assert np.isfinite(image).all() and (image >= 0).all()


def test_mirrored_coordinates_shade_as_plain_ones() -> None:
    """Half of the UVs mirrored: with a normal map that points along u, both halves are lit the same
    when u means the same direction of space."""
    p = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    plain = [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]]
    mirrored = [[u, 1 - v] for u, v in plain]
    images = [
        check(latent(p, [[0, 1, 2], [0, 2, 3]], uv), front(), normal_x=0.4)[0]
        for uv in (plain, mirrored)
    ]
    np.testing.assert_allclose(images[0], images[1], atol=1e-6)


def test_a_seam_across_the_silhouette(ball: Asset) -> None:
    """The same sphere with its seam in front and on the outline: the image must not show where it
    is."""
    images = []
    for turn in (0.0, np.pi / 2):
        p, f, uv = grid_sphere(24, 48)
        c, s = np.cos(turn), np.sin(turn)
        p = p @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32).T
        mesh = replace(
            ball.meshes[0],
            positions=p,
            faces=f,
            uvs=uv,
            normals=p,
            material=Material("grey", (0.5,) * 3),
        )
        images.append(MeshReference(Asset((mesh,))).render(front(light=(0, 0, 3)), 48, 4)[0])
    # the facets lie the same way after a quarter turn: measured 3e-7
    np.testing.assert_allclose(images[0], images[1], atol=1e-5)
    seam = sphere(200, (0.0, 0.0, 0.0), 1.0, 64)
    check(seam, SAMPLER.draw(0, 2))


@pytest.mark.parametrize("loss", sorted(LOSSES))
def test_a_highlight_of_the_smoothest_metal(loss: str) -> None:
    views = front(light=(0, 0, 3), power=2e4)
    image, _ = check(
        latent(TRIANGLE, [[0, 1, 2]]), views, 25, loss, roughness=0.0, metalness=1.0, normal_x=0.0
    )
    assert image[12, 12, 0] > 1e5  # measured 2.4e5, the mean of four samples around the highlight
    model = model_of(latent(TRIANGLE, [[0, 1, 2]]), roughness=0.0, metalness=1.0, normal_x=0.0)
    image = render_image(drawn_of(model), Batch(views.records(), Grid(1, 25)), 1)
    middle = np.array(image).reshape(25, 25, 4)
    # F D V E with alpha = 0.08^2
    assert middle[12, 12, 0] == pytest.approx(0.6 / (np.pi * 0.08**4) / 4 * 2e4 / 9, rel=1e-4)


@pytest.mark.parametrize(
    "light",
    [
        (0, 0, 0),
        (0, 0, 1e-7),
        (0.3, -0.2, 0),
        (0, 0, -2),
        (0, 0, 3),
        (5, 0, 0),
        (0, 0, -3),
        (0, 0, 1e6),
    ],
    ids=[
        "on a pixel's point",
        "just above",
        "in the plane",
        "behind",
        "camera",
        "grazing",
        "opposite",
        "far away",
    ],
)
def test_lights_in_odd_places(light: tuple) -> None:
    for roughness in (0.0, 1.0):
        check(
            latent(TRIANGLE, [[0, 1, 2]]), front(light=light), 25, roughness=roughness, normal_x=0.0
        )


@pytest.mark.parametrize(
    "eye",
    [
        (0, 0, 0),
        (0, 0, 1.0),
        (0, 0, 1e-6),
        (0, 0, 0.999),
        (1.0, 0, 0),
        (0, 0, -1.0),
        (0.2, 0.1, 0.3),
    ],
    ids=[
        "inside",
        "on it",
        "at the centre",
        "just inside",
        "on its side",
        "on its back",
        "off centre",
    ],
)
def test_cameras_in_odd_places(eye: tuple) -> None:
    mesh = sphere(300, (0.0, 0.0, 0.0), 1.0, 32)
    target = np.array(eye) + [0.1, 0.2, -1.0]
    for light in (eye, (0.0, 0.0, 0.0), (3.0, 1.0, 2.0)):
        for quality in (EDGES, PAIRS):
            check(
                mesh,
                look_at(np.array([eye]), target[None], 70.0, np.array([light]), 5.0),
                quality=quality,
            )


def test_triangles_that_cross_the_plane_of_the_camera() -> None:
    p = [[-1, -0.5, -4], [1, -0.5, -4], [0, -0.5, 6], [0.5, 2, 3.0], [-0.5, 2, 3.0], [0, 0.3, 3.5]]
    check(latent(p, [[0, 1, 2], [3, 4, 5]]), front(3.0, 60.0), quality=PAIRS)
    image, grads = check(latent(p, [[0, 1, 2], [3, 4, 5]]), front(3.0, 60.0))
    assert image[..., 3].max() == 1
    assert np.abs(grads[POSITIONS]).max() > 0


def test_edges_whose_third_corner_lies_behind_the_camera_push_outwards() -> None:
    """A wall whose far edge is the silhouette and whose near corner is behind the camera: moving
    the edge up covers more of the image, whatever side the projection of the near corner falls
    on."""
    p = np.array([[-2, 0, 0], [2, 0, 0], [0, -4, 8]], np.float32)
    views = look_at(np.array([[0, 0, 3.0]]), np.zeros(3), 60.0, np.array([[0, 4.0, 4.0]]), 30.0)
    model = model_of(latent(p, [[0, 1, 2]]))
    grid = Grid(1, 32)
    # reference covered everywhere and as dark as the background: covering less is better or worse
    # as a whole
    inputs = StepInputs(
        views,
        Targets(mi.Float(np.tile(np.float32([0, 0, 0, 1]), grid.pixels))),
        np.ones((1, 3), np.float32),
        0.0,
        1.0,
        1,
    )
    _, grads = Gradients(
        model, grid, Quality(visibility=CameraRays((Edges(8.0),), 4)), LOSSES["l1"], freeze=False
    )(inputs)
    g = np.array(grads[POSITIONS]).reshape(-1, 3)
    # the background is white and wrong: raising either end of the far edge (y up) must lower the
    # loss
    assert g[0, 1] < 0 and g[1, 1] < 0


def test_grazing_views() -> None:
    for height in (1e-2, 1e-4, 1e-6, 0.0):
        views = look_at(
            np.array([[3.0, 0, height]]), np.zeros(3), 40.0, np.array([[1.0, 0, 2.0]]), 20.0
        )
        for quality in (EDGES, PAIRS):
            check(latent(TRIANGLE, [[0, 1, 2]]), views, 32, quality=quality)


def test_pixel_centres_on_edges_and_vertices_are_covered_once() -> None:
    """A grid of triangles whose vertices project onto pixel centres: no pixel is missed or
    doubled."""
    n = 9
    t = np.linspace(-1, 1, n)
    x, y = (a.ravel() for a in np.meshgrid(t, t))
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    mesh = latent(np.stack([x, y, 0 * x], 1), faces)
    # an odd number of pixels: centres at multiples of 2 / 9 of the half width, as the vertices
    fov = np.degrees(2 * np.arctan(9 / 8 / 3))
    views = look_at(np.array([[0, 0, 3.0]]), np.zeros(3), fov, np.array([[0, 0, 3.0]]), 20.0)
    for quality in (EDGES, PAIRS):
        check(mesh, views, n, quality=quality)
    model = model_of(mesh)
    drawn = render_image(drawn_of(model), Batch(views.records(), Grid(1, n)), 1)
    image = np.array(drawn).reshape(n, n, 4)
    assert (image[1:-1, 1:-1, 3] == 1).all()  # those on the border may fall to either side
    assert set(np.unique(image[..., 3])) <= {0.0, 1.0}


def test_views_that_see_nothing() -> None:
    mesh = latent(TRIANGLE, [[0, 1, 2]])
    away = look_at(
        np.array([[0, 0, 3.0]]), np.array([[0, 0, 9.0]]), 30.0, np.array([[0, 0, 3.0]]), 20.0
    )
    image, grads = check(mesh, away)
    assert image.max() == 0
    assert all((g == 0).all() for g in grads.values())
    # one view of a batch that sees nothing beside one that does
    image, grads = check(mesh, Views.concatenate([away, front()]))
    assert image.max() == 0 and np.abs(grads[TEXELS]).max() > 0


def test_views_that_see_nothing_but_the_object() -> None:
    wall = latent([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], [[0, 1, 2], [0, 2, 3]])
    image, grads = check(wall, front())
    assert (image[..., 3] == 1).all()
    assert np.abs(grads[POSITIONS]).max() > 0


@pytest.mark.parametrize("resolution", [1, 2, 3])
def test_images_of_a_few_pixels(resolution: int, ball: Asset) -> None:
    for quality in (EDGES, PAIRS):
        check(
            sphere(100, (0.0, 0.0, 0.0), 1.0, 16), SAMPLER.draw(0, 3), resolution, quality=quality
        )
    assert MeshReference(ball).render(SAMPLER.draw(0, 2), resolution, 4).shape == (
        2,
        resolution,
        resolution,
        4,
    )


@pytest.mark.parametrize("shape", [(1, 1), (1, 4096), (4096, 1), (3, 16384)])
def test_textures_of_extreme_shapes(ball: Asset, shape: tuple[int, int]) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (*shape, 3)).astype(np.uint8)
    m = replace(
        ball.meshes[0].material, base_color_texture=Texture(pixels, "srgb"), orm_texture=None
    )
    image = MeshReference(Asset((replace(ball.meshes[0], material=m),))).render(
        SAMPLER.draw(0, 1), 32, 4
    )
    assert np.isfinite(image).all() and image[..., :3].max() > 0


@pytest.mark.parametrize("end", [0, 1])
def test_texels_at_their_bounds(end: int) -> None:
    from appearance_opt.latent.texels import BOUNDS

    bounds = {name: BOUNDS[name][end] for name in CHANNELS}
    model = model_of(sphere(100, (0.0, 0.0, 0.0), 1.0, 16), **bounds)
    check(model, SAMPLER.draw(0, 2))
    # a step beyond the bounds ends on them
    from appearance_opt.optimize import adam

    parameter = model.parameters[TEXELS]
    push = mi.Float(np.full(dr.width(parameter.value), 1.0 if end == 0 else -1.0, np.float32))
    model.set_rates(Rates(0.1, 0.1, 0.1, 0.1))
    value, _ = adam.update(parameter, push, adam.moments_of(parameter), 1.0)
    np.testing.assert_array_equal(np.array(value), np.array(parameter.value))


def test_a_million_triangles() -> None:
    """Reference and latent of a million triangles each: one image and all gradients."""
    p, f, uv = grid_sphere(500, 1000)
    mesh = Mesh(p, f, p, uv, material=make_asset(4, 6).meshes[0].material)
    image = MeshReference(Asset((mesh,))).render(SAMPLER.draw(0, 2), 64, 1)
    assert len(f) == 998_000 and np.isfinite(image).all()
    welded = LatentMesh(p, f, np.arange(len(p), dtype=np.int32), f, uv)
    _, grads = check(welded, SAMPLER.draw(0, 1), 64)
    assert len(grads[POSITIONS]) == 3 * len(p)
