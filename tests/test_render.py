"""The renderer against answers on paper and against Mitsuba's own."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.initial.sphere import sphere
from appearance_opt.latent.texels import TexelCodec
from appearance_opt.placement import Placement
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.render import rays, texture, texture_upload, upload
from appearance_opt.render.math import angle_of
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.texture import CLAMP, MIRROR, REPEAT
from appearance_opt.render.texture_upload import Base, build_pyramid
from appearance_opt.views import ViewSampler, look_at
from experiments import mitsuba_peer
from experiments.accuracy.images import compare_asset


def test_a_lit_plane_has_the_radiance_of_the_formula() -> None:
    p = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    # roughness 1 and Schlick at normal incidence: F = 0.04, D V = 1 / (4 pi)
    material = Material(base_color=(0.5, 0.25, 0.1), roughness=1.0, metalness=0.0)
    reference = MeshReference(Asset((Mesh(p, faces, material=material),)))
    views = look_at(np.array([[0, 0, 3.0]]), np.zeros(3), 20.0, np.array([[0, 0, 3.0]]), 9.0)
    pixel = reference.render(views, 33, 1)[0, 16, 16]
    expected = [(0.96 * c / np.pi + 0.04 / (4 * np.pi)) for c in material.base_color]
    np.testing.assert_allclose(pixel[:3], expected, rtol=1e-4)
    assert pixel[3] == 1.0


def test_texture_lookup_interpolates_and_wraps() -> None:
    texels = np.zeros((2, 4, 2), np.float32)
    texels[..., 0] = [[0, 1, 2, 3], [10, 11, 12, 13]]
    cases = {
        REPEAT: [
            (0.5 / 4, 0.25, 0.0),
            (1 / 4, 0.25, 0.5),
            (0.0, 0.25, 1.5),
            (1.125, 0.25, 0.0),
            (0.125, 0.5, 5.0),
        ],
        CLAMP: [(0.0, 0.25, 0.0), (1.5, 0.25, 3.0), (0.125, -1.0, 0.0), (0.125, 2.0, 10.0)],
        MIRROR: [(-0.125, 0.25, 0.0), (1.125, 0.25, 3.0), (1.375, 0.25, 2.0)],
    }
    for wrap, rows in cases.items():
        pyramid = build_pyramid([Base.of(texels)], [wrap])
        u, v, expected = (np.array(c, np.float32) for c in zip(*rows, strict=True))
        got = pyramid.lookup(None, mi.Point2f(u, v), mi.Float(np.zeros(len(u), np.float32)))[0]
        np.testing.assert_allclose(np.array(got), expected, atol=1e-5)


def test_mip_levels_average_and_blend() -> None:
    rng = np.random.default_rng(0)
    texels = rng.random((8, 8, 2)).astype(np.float32)
    pyramid = build_pyramid([Base.of(texels)], [REPEAT])
    assert list(pyramid.layout.sizes[0]) == [(8, 8), (4, 4), (2, 2), (1, 1)]
    whole = pyramid.lookup(None, mi.Point2f(mi.Float([0.3]), mi.Float([0.7])), mi.Float([1.0]))[0]
    # the coarsest level is approached, not reached: lod is capped a thousandth below it
    assert float(whole[0]) == pytest.approx(float(texels[..., 0].mean()), abs=2e-3)
    level1 = texels.reshape(4, 2, 4, 2, 2).mean(axis=(1, 3))
    centre = pyramid.lookup(
        None, mi.Point2f(mi.Float([0.625]), mi.Float([0.375])), mi.Float([4 / 64])
    )[0]
    assert float(centre[0]) == pytest.approx(float(level1[1, 2, 0]), abs=1e-5)


def test_textures_in_half_precision_are_off_by_its_rounding() -> None:
    rng = np.random.default_rng(3)
    texels = rng.random((32, 32, 8)).astype(np.float32)
    texels[0, 0] = 1e6
    exact, rounded = (
        build_pyramid([Base.of(texels)], [CLAMP], kind=k) for k in (np.float32, np.float16)
    )
    uv = mi.Point2f(*rng.random((2, 1000)).astype(np.float32))
    footprint = mi.Float((10 ** rng.uniform(-4, 0, 1000)).astype(np.float32))
    single, half = (np.array(mi.ArrayXf(p.lookup(None, uv, footprint))) for p in (exact, rounded))
    within = np.abs(single).max(axis=0) < 1
    assert within.sum() > 500
    np.testing.assert_allclose(half[:, within], single[:, within], rtol=2**-11)
    corner = rounded.lookup(None, mi.Point2f(mi.Float([0.0]), mi.Float([0.0])), mi.Float([0.0]))
    assert float(corner[0][0]) == 65504.0  # the largest number that there is, not infinity


def test_pyramids_are_made_in_bands_as_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    for size in ((37, 22), (1, 9), (64, 64), (1, 1), (2, 1)):
        base = rng.random((*size, 4)).astype(np.float32)
        levels, level = [base.reshape(-1, 4)], mi.Float(base.ravel())
        width, height = size[1], size[0]
        while (width, height) != (1, 1):
            level = texture.downsample(level, (width, height), 4)
            width, height = (width + 1) // 2, (height + 1) // 2
            levels.append(np.array(level).reshape(-1, 4))
        wanted = np.concatenate(levels)
        for band in (1, 1 << 26):
            monkeypatch.setattr(texture_upload, "BAND_BYTES", band)
            made = build_pyramid([Base.of(base)], [REPEAT])
            np.testing.assert_allclose(np.array(made.texels).reshape(-1, 4), wanted, rtol=1e-6)


def test_angles_are_those_of_the_arc_tangent() -> None:
    true = np.concatenate(
        [np.linspace(1e-6, np.pi, 10_001), np.pi * np.arange(1, 8) / 8, 10.0 ** np.arange(-7, 0)]
    )
    sine, cosine = (
        mi.Float(f(true).clip(1e-12 if f is np.sin else -1).astype(np.float32))
        for f in (np.sin, np.cos)
    )
    dr.enable_grad(sine, cosine)
    angle = angle_of(sine, cosine)
    exact = np.arctan2(np.array(sine).astype(np.float64), np.array(cosine).astype(np.float64))
    np.testing.assert_allclose(np.array(angle), exact, rtol=3e-7)
    dr.backward(angle)
    # the derivative of the arc tangent: (cosine, -sine) over their squared length
    np.testing.assert_allclose(np.array(dr.grad(sine)), np.array(cosine), atol=1e-5)
    np.testing.assert_allclose(np.array(dr.grad(cosine)), -np.array(sine), atol=1e-5)


def test_a_fitted_pyramid_is_that_of_the_decoded_values() -> None:
    rng = np.random.default_rng(4)
    maps = {n: rng.random((16, 16)).astype(np.float32) for n in ("red", "normal_x", "roughness")}
    codec = TexelCodec(tuple(maps), 16)
    ours = codec.layer(codec.encode(maps)).pyramid
    bounded = np.stack(
        [maps["red"], maps["normal_x"], maps["roughness"].clip(0.08), 0 * maps["red"]], axis=-1
    )
    expected = build_pyramid([Base.of(bounded)], [CLAMP])
    assert ours.layout == expected.layout
    np.testing.assert_allclose(np.array(ours.texels), np.array(expected.texels), atol=1e-6)


def test_several_materials_share_one_buffer(ball: Asset) -> None:
    red = Material("red", (1.0, 0.0, 0.0), roughness=1.0)
    other = replace(
        ball.meshes[0], positions=ball.meshes[0].positions + np.float32([3, 0, 0]), material=red
    )
    views = look_at(
        np.array([[0.0, 0, 6], [3.0, 0, 6]]),
        np.array([[0.0, 0, 0], [3.0, 0, 0]]),
        20.0,
        np.full((2, 3), 9.0),
        700.0,
    )
    both = MeshReference(Asset((ball.meshes[0], other))).render(views, 64, 1)
    alone = MeshReference(ball).render(views[:1], 64, 1)
    middle = np.s_[20:44, 20:44]
    np.testing.assert_allclose(both[0][middle], alone[0][middle], atol=1e-5)
    assert (
        both[1][32, 32, 0] > 10 * both[1][32, 32, 1] > 0
    )  # dielectric: red with a white highlight


def test_our_image_equals_mitsubas(ball: Asset) -> None:
    """A textured ball, lit from the side, against Mitsuba's ``direct`` integrator with the same
    BRDF."""
    mitsuba_peer.register()
    views = look_at(np.array([[0.0, 0, 6.0]]), np.zeros(3), 25.0, np.array([[2.0, 3.0, 5.0]]), 40.0)
    found = compare_asset(ball, views, 96)
    # measured 54.0 dB by 64 rays per pixel on either side, and means 6e-4 apart
    assert found.psnr > 49
    assert found.ours.mean() == pytest.approx(found.theirs.mean(), rel=1.5e-3)


def test_framing_fills_the_image_from_every_side() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)) * [0.2, 1.0, 0.1]
    placement = Placement.around(points)
    sampler = ViewSampler(placement.centre, placement.scale, seed=1, hull=points)
    views = sampler.draw(0, 8)
    for k in range(8):
        v = points - views.eye[k]
        depth = v @ views.forward[k]
        scale = float(views.right[k] @ views.right[k])
        x, y = (v @ a[k] / (depth * scale) for a in (views.right, views.down))
        reach = max(np.abs(x).max(), np.abs(y).max())
        assert 0.95 < reach <= 1.0


def test_views_replay(ball: Asset) -> None:
    sampler = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=3)
    a, b = sampler.draw(17, 4), sampler.draw(17, 4)
    np.testing.assert_array_equal(a.eye, b.eye)
    assert not np.allclose(a.eye, sampler.draw(18, 4).eye)
    assert not np.allclose(a.eye, sampler.held_out(1).draw(17, 4).eye)


def test_textures_of_one_material_may_differ_in_size(ball: Asset) -> None:
    m = ball.meshes[0].material
    small = replace(m, orm_texture=Texture(np.full((1, 1, 3), 128, np.uint8)))
    image = MeshReference(Asset((replace(ball.meshes[0], material=small),))).render(
        ViewSampler((0.0, 0.0, 0.0), 1.0).draw(0, 1), 32, 1
    )
    assert np.isfinite(image).all()
    assert image[..., 3].max() == 1


def test_a_pair_is_the_image_at_outlines_and_points_elsewhere(ball: Asset) -> None:
    reference = MeshReference(ball)
    views = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=2).draw(0, 2)
    average, points = reference.pair(views, 192, 16, 0.4)
    full, single = (
        reference.render(views, 192, 16),
        reference.render_device(Batch(views.records(), Grid(2, 192)), 1, 0.4),
    )
    np.testing.assert_array_equal(points, np.array(single).reshape(points.shape))
    outline = (full[..., 3] > 0) & (full[..., 3] < 1)
    assert outline.sum() > 100
    np.testing.assert_allclose(average[outline], full[outline], rtol=1e-4, atol=1e-5)
    inside = average[..., 3] == points[..., 3]
    assert inside[~outline].all()
    same, lit = (average == points).all(axis=-1), full[..., :3].min(axis=-1) > 0

    def within(reach: int) -> np.ndarray:
        return np.stack([maximum_filter(view, 2 * reach + 1) for view in outline])

    beside = within(1) & ~outline & (full[..., 3] == 1) & lit
    assert beside.sum() > 500
    assert not same[beside].any()
    # a slanted surface is no outline, although depths five pixels apart differ by more than 2 %
    # there
    assert same[~outline].mean() > 0.95 and not same[outline].any()
    assert same[~within(5)].all()
    assert within(5).mean() < 0.3


def test_a_moved_scene_shows_what_a_new_one_does() -> None:
    """The BVH of a moving mesh is another one than that of a mesh that stands still."""
    mesh, grid = sphere(400, (0.0, 0.0, 0.0), 0.9, 16), Grid(2, 64)
    moved = (mesh.positions * np.float32([0.5, 1.0, 0.8]) + np.float32([0.2, 0.0, 0.0])).astype(
        np.float32
    )
    moving = upload.MovingScene(mesh.positions, mesh.faces)
    batch = Batch(ViewSampler((0.0, 0.0, 0.0), 1.0, seed=4).draw(0, 2).records(), grid)

    def seen(scene: mi.Scene) -> tuple[np.ndarray, np.ndarray]:
        hits, depth = rays.trace_grid(scene, batch)
        return np.array(hits.triangle), np.array(depth)

    for positions in (mesh.positions, moved):
        moving.move(mi.Float(positions.ravel()))
        (triangle, depth), (expected, there) = (
            seen(moving.scene),
            seen(upload.scene_of(positions, mesh.faces)),
        )
        assert (expected != MISS).sum() > 500
        # on an edge between two triangles either may be met
        assert (triangle == expected).mean() > 0.999
        np.testing.assert_allclose(depth, there, rtol=1e-5)
