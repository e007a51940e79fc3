"""Derivatives against finite differences and answers on paper."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.asset.normals import vertex_normals
from appearance_opt.asset.tangents import split_and_tangents
from appearance_opt.backend import to_device
from appearance_opt.initial.sphere import sphere
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.laplacian import Laplacian
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.mesh import LatentMesh, LatentTopology, local_edge_length
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.positions import POSITIONS
from appearance_opt.latent.texels import TEXELS, TexelCodec, Texels
from appearance_opt.optimize import adam
from appearance_opt.optimize.losses import LOSSES, Target, compared_pixels, image_loss
from appearance_opt.optimize.step import Gradients, StepInputs, first_non_finite, step
from appearance_opt.reference.pool import Targets
from appearance_opt.render import gradient
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.boundary.edges import Edges
from appearance_opt.render.boundary.estimator import Estimator
from appearance_opt.render.boundary.pairs import Pairs
from appearance_opt.render.images import render_image
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.quality import Quality
from appearance_opt.views import ViewSampler
from tests.drawing import drawn_of

SAMPLER = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=5)


def flat_maps(size: int, **values: float) -> dict[str, np.ndarray]:
    base = {"red": 0.6, "green": 0.3, "blue": 0.2, "roughness": 0.5, "metalness": 0.2}
    base.update(normal_x=0.0, normal_y=0.0, normal_z=1.0)
    return {k: np.full((size, size), v, np.float32) for k, v in {**base, **values}.items()}


def wavy_maps(size: int) -> dict[str, np.ndarray]:
    """Smooth maps: finite differences of bilinear lookups are only smooth if the texels are."""
    y, x = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    wave = (np.sin(2 * np.pi * x / size) * np.cos(2 * np.pi * y / size)).astype(np.float32)
    maps = flat_maps(size)
    for k, amount in (
        ("red", 0.2),
        ("blue", 0.1),
        ("roughness", 0.2),
        ("metalness", 0.15),
        ("normal_x", 0.2),
    ):
        maps[k] = maps[k] + amount * wave
    return maps


def make_model(
    triangles: int = 300, size: int = 32, fit: tuple[str, ...] = ("shape", "normal", "material")
) -> Latent:
    mesh = sphere(triangles, (0.0, 0.0, 0.0), 0.7, size)
    return latent_of(mesh, wavy_maps(size), frozenset(fit), Rates())


def make_inputs(model: Latent, grid: Grid, seed: int = 0) -> StepInputs:
    views = SAMPLER.draw(seed, grid.views)
    reference = to_device(np.random.default_rng(seed).random(grid.pixels * 4) * 0.5)
    return StepInputs(
        views, Targets(reference), np.full((grid.views, 3), 0.4, np.float32), 0.0, 0.0, 3
    )


def test_texel_gradients_agree_with_finite_differences() -> None:
    model, grid, quality = make_model(), Grid(2, 48), Quality(visibility=CameraRays(()))
    inputs = make_inputs(model, grid)
    loss = LOSSES["l2"]
    _, grads = Gradients(model, grid, quality, loss, freeze=False)(inputs)
    analytic = np.array(grads[TEXELS]).astype(np.float64)
    parameter = model.parameters[TEXELS]
    start = np.array(parameter.value)
    rng = np.random.default_rng(1)
    for _ in range(4):
        # random directions over all texels and channels: the sum over millions of texels is well
        # conditioned
        direction = rng.normal(size=start.shape).astype(np.float32)
        step = 1e-3
        values = []
        for sign in (1, -1):
            parameter.value = mi.Float(start + sign * step * direction)
            values.append(float(Gradients(model, grid, quality, loss, freeze=False)(inputs)[0][0]))
        numeric = (values[0] - values[1]) / (2 * step)
        predicted = float(analytic @ direction)
        # measured 0.3 to 0.9 % of a typical direction's derivative. The loss is L2: under the
        # log-sRGB loss pixels on the terminator, where n.l passes through zero, make differences
        # jump by 5 %
        assert abs(predicted - numeric) < 0.02 * np.linalg.norm(analytic)


@pytest.mark.parametrize("channel", ["red", "roughness", "metalness", "normal_x", "normal_y"])
def test_each_channel_has_its_own_correct_gradient(channel: str) -> None:
    model, grid, quality = make_model(), Grid(2, 48), Quality(visibility=CameraRays(()))
    loss = LOSSES["log-srgb-l2"]
    texels, parameter = model.fitted(Texels), model.parameters[TEXELS]
    assert texels is not None
    codec = texels.codec
    assert codec is not None
    index = codec.channels.index(channel)
    start = np.array(parameter.value).reshape(-1, codec.packed)
    predicted, numeric = [], []
    for seed in range(7):
        inputs = make_inputs(model, grid, seed)
        parameter.value = mi.Float(start.ravel())
        _, grads = Gradients(model, grid, quality, loss, freeze=False)(inputs)
        predicted.append(
            float(
                np.array(grads[TEXELS]).reshape(-1, codec.packed)[:, index].astype(np.float64).sum()
            )
        )
        values = []
        for sign in (1, -1):
            moved = start.copy()
            moved[:, index] += sign * 1e-3
            parameter.value = mi.Float(moved.ravel())
            values.append(float(Gradients(model, grid, quality, loss, freeze=False)(inputs)[0][0]))
        numeric.append((values[0] - values[1]) / 2e-3)
    error = np.abs(np.subtract(predicted, numeric)) / np.sqrt(np.mean(np.square(predicted)))
    # in some views a pixel crosses the terminator, where the loss has a kink, between the two
    # differences; most agree to 0.03 % of a typical derivative, and a gradient that is off by 0.3 %
    # is off in all views
    assert np.median(error) < 0.003


def coverage_derivative(density: float, samples: int) -> tuple[float, float]:
    """(by the edge term, by finite differences) of the covered area under a scaling of a sphere."""
    mesh = sphere(1200, (0.0, 0.0, 0.0), 0.7, 16)
    model = latent_of(mesh, flat_maps(16), frozenset(("shape",)), Rates())
    grid = Grid(4, 64)
    records = SAMPLER.draw(1, 4).records()
    start = np.array(model.vertices())
    positions = mi.Float(start)
    dr.enable_grad(positions)
    drawn, batch = drawn_of(model, positions), Batch(records, grid)
    rendered = gradient.render(
        drawn, batch, Quality(visibility=CameraRays((Edges(density),), samples)), 0
    )
    by_image = np.zeros((grid.pixels, 4), np.float32)
    by_image[:, 3] = 1
    gradient.backward(gradient.surrogate(rendered, drawn.shown, mi.Float(by_image.ravel())))
    edge = float(np.array(dr.grad(positions)).astype(np.float64) @ start)
    areas = []
    for scale in (1.02, 0.98):
        model.parameters[POSITIONS].value = mi.Float(start * scale)
        model.update_scene()
        image = render_image(drawn_of(model), batch, 64)
        areas.append(float(np.array(image).reshape(-1, 4)[:, 3].sum()))
    return edge, (areas[0] - areas[1]) / 0.04


def test_silhouettes_carry_the_derivative_of_the_covered_area() -> None:
    edge, numeric = coverage_derivative(4.0, 8)
    # measured 0.4 %: 4 points per pixel of outline, 64 samples per pixel for the differences
    assert edge == pytest.approx(numeric, rel=0.02)


def test_sparse_silhouette_points_are_unbiased() -> None:
    edge, numeric = coverage_derivative(0.5, 4)
    # measured 1.5 %: noise of one point per two pixels
    assert edge == pytest.approx(numeric, rel=0.06)


def test_normals_and_tangents_equal_the_exporters() -> None:
    mesh = sphere(500, (0.1, 0.2, 0.0), 0.5, 64)
    rng = np.random.default_rng(0)
    moved = (mesh.positions + rng.normal(scale=0.01, size=mesh.positions.shape)).astype(np.float32)
    topology = LatentTopology(mesh, tangents=True)
    surface = topology.surface(mi.Float(moved.ravel()))
    vertices = np.array(surface.vertices).reshape(-1, 8)
    expected = vertex_normals(moved, mesh.faces, welded=True)
    np.testing.assert_allclose(vertices[:, 4:7], expected, atol=2e-5)  # measured 3e-6
    _, faces, tangents = split_and_tangents(
        moved[mesh.frame_vertex], expected[mesh.frame_vertex], mesh.uvs, mesh.frame_faces
    )
    frames = np.array(surface.frames).reshape(-1, 8)
    np.testing.assert_allclose(
        frames[mesh.frame_faces][..., 4:7], tangents[faces][..., :3], atol=2e-4
    )
    np.testing.assert_array_equal(frames[mesh.frame_faces][..., 2], tangents[faces][..., 3])


def test_mesh_operations_have_correct_derivatives() -> None:
    mesh = sphere(200, (0.0, 0.0, 0.0), 0.6, 64)
    topology = LatentTopology(mesh, tangents=True)
    rng = np.random.default_rng(3)
    start = mesh.positions.ravel() + rng.normal(scale=0.02, size=mesh.positions.size).astype(
        np.float32
    )
    weights = [
        rng.normal(size=8 * n).astype(np.float32) for n in (len(mesh.positions), len(mesh.uvs))
    ]

    def value(p: mi.Float) -> mi.Float:
        s = topology.surface(p)
        return dr.sum(s.vertices * mi.Float(weights[0])) + dr.sum(s.frames * mi.Float(weights[1]))

    p = mi.Float(start)
    dr.enable_grad(p)
    dr.backward(value(p))
    analytic = np.array(dr.grad(p)).astype(np.float64)
    for _ in range(3):
        direction = rng.normal(size=start.shape).astype(np.float32)
        step = 2e-4
        numeric = float(
            (value(mi.Float(start + step * direction)) - value(mi.Float(start - step * direction)))[
                0
            ]
        ) / (2 * step)
        # measured 0.1 to 0.5 % in float32
        assert abs(float(analytic @ direction) - numeric) < 0.02 * np.linalg.norm(analytic)


@pytest.mark.parametrize("name", sorted(LOSSES))
def test_losses_are_zero_at_equality_and_have_correct_gradients(name: str) -> None:
    rng = np.random.default_rng(0)
    image, reference = (rng.uniform(0.1, 2, 64).astype(np.float32) for _ in range(2))
    image[3::4] = reference[3::4] = 1.0
    loss, all_pixels = LOSSES[name], dr.arange(mi.UInt32, 16)
    background = np.array([[0.2, 0.3, 0.4]])
    target = Target.of(mi.Float(reference), background)
    same, _ = image_loss(
        loss, Target.of(mi.Float(image), background), mi.Float(image), all_pixels, 16
    )
    assert (np.array(same) == 0).all()
    _, by_image = image_loss(loss, target, mi.Float(image), all_pixels, 16)
    direction = rng.normal(size=64).astype(np.float32)
    direction[3::4] = 0
    values = [
        np.array(
            image_loss(loss, target, mi.Float(image + s * 1e-3 * direction), all_pixels, 16)[0]
        ).sum()
        for s in (1, -1)
    ]
    # measured below 0.2 %
    assert float(np.array(by_image) @ direction) == pytest.approx(
        (values[0] - values[1]) / 2e-3, rel=0.01, abs=1e-5
    )


def test_log_srgb_l1_by_hand() -> None:
    # ln(1 + 1) = 0.693147 -> sRGB 1.055 * 0.693147^(1/2.4) - 0.055 = 0.850586
    target = Target.of(mi.Float([0, 0, 0, 1]), np.zeros((1, 3)))
    value, _ = image_loss(LOSSES["log-srgb-l1"], target, mi.Float([1, 1, 1, 1]), mi.UInt32([0]), 1)
    assert float(value[0]) == pytest.approx(0.850586, abs=2e-6)


def test_pyramid_hands_gradients_down_to_all_texels() -> None:
    codec = TexelCodec(("roughness", "metalness"), 8)
    stored = codec.encode({k: np.full((8, 8), 0.5, np.float32) for k in codec.channels})
    total = codec.layout.texel_count * codec.packed
    gradient_of_all = np.zeros(total, np.float32)
    gradient_of_all[codec.layout.offsets[0][-1] * codec.packed] = (
        1.0  # the single texel of the last level
    )
    down = np.array(codec.pull_back(mi.Float(gradient_of_all), stored)).reshape(8, 8, codec.packed)
    np.testing.assert_allclose(down[..., 0], 1 / 64, rtol=1e-6)
    np.testing.assert_array_equal(down[..., 1], 0)


def test_laplacian_is_scale_free_and_zero_at_the_start() -> None:
    mesh = sphere(300, (0.0, 0.0, 0.0), 1.0, 16)
    rng = np.random.default_rng(0)
    noise = rng.normal(scale=0.01, size=mesh.positions.shape).astype(np.float32)
    values = []
    for scale in (1.0, 1000.0):
        p = mesh.positions * np.float32(scale)
        laplacian = Laplacian(p, mesh.faces, local_edge_length(p, mesh.faces), relative=True)
        assert float(laplacian(mi.Float(p.ravel()))[0]) == 0
        values.append(float(laplacian(mi.Float((p + noise * scale).ravel()))[0]))
    assert values[0] > 1e-4
    assert values[0] == pytest.approx(values[1], rel=1e-3)


def test_the_laplacian_leaves_alone_what_stands_still() -> None:
    """Rounding in place of a zero gradient would become whole steps of Adam, which differ from run
    to run."""
    mesh = sphere(300, (0.0, 0.0, 0.0), 1.0, 16)
    laplacian = Laplacian(
        mesh.positions, mesh.faces, local_edge_length(mesh.positions, mesh.faces), relative=True
    )
    moved = mesh.positions.copy()
    moved[0] += 0.1
    positions = mi.Float(moved.ravel())
    dr.enable_grad(positions)
    dr.backward(laplacian(positions))
    gradient = np.array(dr.grad(positions)).reshape(-1, 3)
    near = np.zeros(len(moved), bool)
    near[0] = True
    for _ in range(2):  # its one-ring's differential coordinates change, and the one-rings of those
        near[mesh.faces[near[mesh.faces].any(axis=1)].ravel()] = True
    assert 4 < near.sum() < 40
    assert np.abs(gradient[near]).min(axis=0).max() > 0
    assert (gradient[~near] == 0).all()


def test_a_mesh_out_of_sight_has_no_gradient_and_breaks_nothing() -> None:
    mesh = sphere(100, (0.0, 0.0, 0.0), 0.5, 16)
    away = LatentMesh(
        mesh.positions + np.float32(100), mesh.faces, mesh.frame_vertex, mesh.frame_faces, mesh.uvs
    )
    model = latent_of(away, flat_maps(16), frozenset(("shape", "normal", "material")), Rates())
    grid = Grid(2, 32)
    value, grads = Gradients(model, grid, Quality(), LOSSES["log-srgb-l1"], freeze=False)(
        make_inputs(model, grid)
    )
    assert np.isfinite(float(value[0]))
    assert all((np.array(g) == 0).all() for g in grads.values())


@pytest.mark.parametrize("want_loss", [True, False])
@pytest.mark.parametrize(
    ("samples", "finders"), [(1, (Edges(),)), (2, (Edges(),)), (2, ()), (4, ())]
)
def test_pixels_shaded_with_their_loss_have_the_gradient_of_the_whole_image(
    samples: int, finders: tuple[Edges, ...], want_loss: bool
) -> None:
    """The shortcut for pixels of few samples against the path through the image. Without
    silhouettes some pixels are covered in part. The gradient is the same whether the value of the
    loss is wanted or not."""
    model, grid = make_model(), Grid(2, 48)
    quality = Quality(samples, 0.4, visibility=CameraRays(finders, 4))
    inputs = replace(make_inputs(model, grid, 1), want_loss=want_loss)
    loss = LOSSES["log-srgb-l1"]
    value, quick = Gradients(model, grid, quality, loss, freeze=False)(inputs)
    tracked = model.track(model.decode(model.values()))
    drawn = model.drawn(tracked)
    rendered = gradient.render(drawn, Batch(inputs.views.records(), grid), quality, inputs.seed)
    assert rendered.seen.whole is None
    target = Target.of(inputs.reference.average, inputs.background)
    pixels = compared_pixels(rendered.image, target)
    whole, by_image = image_loss(loss, target, rendered.image, pixels, grid.pixels)
    gradient.backward(gradient.surrogate(rendered, drawn.shown, by_image))
    slow = model.gradients(tracked, model.values())
    assert (value is not None) == want_loss
    if value is not None:
        assert float(value[0]) == pytest.approx(np.array(whole).sum(), rel=1e-5)
    for name in (POSITIONS, TEXELS):
        a, b = np.array(quick[name]), np.array(slow[name])
        # the same sums in another order (measured 4e-8)
        assert np.linalg.norm(a - b) < 1e-6 * np.linalg.norm(b)


@pytest.mark.parametrize(
    ("levels", "visibility"), [((0,), CameraRays()), ((1, 2), CameraRays()), ((0,), Pairs())]
)
def test_frozen_steps_equal_traced_ones(levels: tuple[int, ...], visibility: Estimator) -> None:
    """Recorded kernels see what moves: vertices, texels, views, images, how many pixels are
    covered."""
    maps: dict = wavy_maps(32)
    parts = ["shape", "normal", "material"]
    if levels != (0,):
        maps["displacement"] = np.full((16, 16), 0.02, np.float32)
        parts.append("displacement")
    model = latent_of(
        sphere(300, (0.0, 0.0, 0.0), 0.7, 32), maps, frozenset(parts), Rates(), levels
    )
    grid, loss = Grid(2, 48), LOSSES["log-srgb-l1"]
    regularizers = model.laplacians(relative=False)
    quality = Quality(visibility=visibility)
    frozen, plain = (
        Gradients(model, grid, quality, loss, regularizers, freeze=f) for f in (True, False)
    )
    moments = {n: adam.moments_of(p) for n, p in model.parameters.items()}
    for k in range(8):
        model.select(model.poses[k % len(levels)])
        inputs = replace(
            make_inputs(model, grid, k), laplacian_weight=0.1 * k, rate=1.0, want_loss=k % 3 == 0
        )
        value, grads = frozen(inputs)
        expected, wanted = plain(inputs)
        assert (value is None) == (expected is None) == (k % 3 != 0)
        if value is not None and expected is not None:
            assert float(value[0]) == pytest.approx(float(expected[0]), rel=1e-5)
        assert set(grads) == set(wanted) == set(model.parameters)
        for name in grads:
            a, b = np.array(grads[name]), np.array(wanted[name])
            # the same sums in another order (measured up to 3e-7)
            assert np.linalg.norm(a - b) < 1e-5 * np.linalg.norm(b)
        done = step(frozen, moments, inputs, first_non_finite)
        assert done.bad is None
        model.restore(done.values)
        moments.update(done.moments)


def test_recordings_are_reused() -> None:
    model, grid = make_model(), Grid(2, 48)
    gradients = Gradients(model, grid, Quality(), LOSSES["log-srgb-l1"])
    for k in range(24):
        gradients(make_inputs(model, grid, k))
    recorded = gradients.recordings()
    for k in range(24, 36):
        gradients(make_inputs(model, grid, k))
    # eight functions in twelve steps: 96 more if nothing were reused. Now and then two lists are
    # equally long by chance, which is recorded anew: up to 10 times between the first dozen of
    # steps and the second, 0 to 4 times from there to the third (measured)
    assert recorded >= 8
    assert gradients.recordings() <= recorded + 16


@pytest.mark.parametrize("seed", range(3))
def test_texels_to_pyramid_and_back(seed: int) -> None:
    """The pyramid's gradient pulled back to the stored texels, against central differences in
    random directions; colours are stored as roots, normals of any length mean unit ones. Measured
    3e-4 of the derivative's scale."""
    random = np.random.default_rng(seed)
    channels = (
        "red",
        "green",
        "blue",
        "roughness",
        "metalness",
        "normal_x",
        "normal_y",
        "normal_z",
    )
    codec = TexelCodec(channels, 16)
    stored = random.uniform(0.2, 0.9, 16 * 16 * 8)
    weight = random.normal(size=codec.layout.texel_count * 8)

    def total(at: np.ndarray) -> float:
        return float(np.dot(np.array(codec.layer(mi.Float(at)).pyramid.texels, np.float64), weight))

    gradient = np.array(codec.pull_back(mi.Float(weight), mi.Float(stored)), np.float64)
    for _ in range(4):
        direction = random.normal(size=len(stored))
        step = 1e-3
        difference = (total(stored + step * direction) - total(stored - step * direction)) / (
            2 * step
        )
        assert difference == pytest.approx(
            gradient @ direction, abs=2e-3 * np.linalg.norm(gradient)
        )
    normals = gradient.reshape(-1, 8)[:, 5:] * stored.reshape(-1, 8)[:, 5:]
    assert np.abs(normals.sum(axis=1)).max() < 1e-5 * np.abs(gradient).max()


def test_flat_normals_have_no_gradient_along_themselves() -> None:
    """Not even by rounding: an optimiser that divides by the gradient's size would walk them at
    random."""
    codec = TexelCodec(("normal_x", "normal_y", "normal_z"), 4)
    stored = np.zeros((16, codec.packed), np.float32)
    stored[:, 2] = 1
    weight = np.random.default_rng(0).normal(size=codec.layout.texel_count * codec.packed)
    gradient = np.array(codec.pull_back(mi.Float(weight), mi.Float(stored.ravel()))).reshape(16, -1)
    assert (gradient[:, 2] == 0).all()
    assert (gradient[:, 0] != 0).all()
