"""Pair antialiasing: its gradient against its own image, its bias against finite differences, its
price when unused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.initial.sphere import sphere
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.positions import POSITIONS
from appearance_opt.optimize.losses import LOSSES
from appearance_opt.optimize.step import Gradients
from appearance_opt.render import gradient
from appearance_opt.render.boundary import silhouette_walk
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.boundary.edges import EdgePoints, Edges
from appearance_opt.render.boundary.intersections import Crossings, Intersections
from appearance_opt.render.boundary.pairs import Pairs
from appearance_opt.render.drawn import Drawn
from appearance_opt.render.edge_list import edge_list, walkable
from appearance_opt.render.gradient import RenderedBatch
from appearance_opt.render.images import render_image
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.quality import Quality
from appearance_opt.views import Views, ViewSampler
from experiments.gradient_error.area import ball
from experiments.gradient_error.estimators import Ours
from experiments.gradient_error.metrics import error_of
from experiments.gradient_error.problems import make_problem
from tests.differences import differences_along
from tests.drawing import drawn_of
from tests.test_gradients import flat_maps, make_inputs, make_model

SAMPLER = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=5)
PAIRS = Quality(visibility=Pairs())


def white(mesh: LatentMesh) -> Latent:
    return latent_of(mesh, flat_maps(16), frozenset(("shape",)), Rates())


def two_balls() -> LatentMesh:
    """Two spheres that run into each other."""
    one, other = (sphere(80, (x, 0.05, 0.0), 0.45, 16) for x in (-0.2, 0.25))
    p = np.concatenate([one.positions, other.positions])
    f = np.concatenate([one.faces, other.faces + len(one.positions)])
    return LatentMesh(p, f, np.arange(len(p), dtype=np.int32), f, np.zeros((len(p), 2), np.float32))


def render(
    model: Latent, views: Views, grid: Grid, quality: Quality
) -> tuple[RenderedBatch, Drawn, mi.Float]:
    """(rendered batch, what is drawn, positions that track gradients)."""
    positions = mi.Float(np.array(model.vertices()))
    dr.enable_grad(positions)
    drawn = drawn_of(model, positions, walkable=True)
    return gradient.render(drawn, Batch(views.records(), grid), quality, 0), drawn, positions


def pulled(
    rendered: RenderedBatch, drawn: Drawn, positions: mi.Float, by_image: np.ndarray
) -> np.ndarray:
    """dLoss/dPositions, for dLoss/dImage (pixels, 4)."""
    flat = mi.Float(by_image.astype(np.float32).ravel())
    gradient.backward(gradient.surrogate(rendered, drawn.shown, flat))
    return np.array(dr.grad(positions)).reshape(-1, 3).astype(np.float64)


def differences(
    model: Latent,
    start: np.ndarray,
    fields: np.ndarray,
    step: float,
    image: Callable[[], np.ndarray],
    by: np.ndarray,
) -> np.ndarray:
    """Central differences of <by, image> along displacement fields (N, V, 3)."""
    out = []
    for field in fields:
        values = []
        for sign in (1, -1):
            moved = (start + sign * step * field).astype(np.float32)
            model.parameters[POSITIONS].value = mi.Float(moved.ravel())
            model.update_scene()
            values.append(float(np.sum(image().astype(np.float64) * by)))
        out.append((values[0] - values[1]) / (2 * step))
    return np.array(out)


@pytest.mark.parametrize(("samples", "balls"), [(1, 1), (4, 1), (1, 2), (4, 2)])
def test_the_gradient_is_that_of_the_blended_image(
    samples: int, balls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "appearance_opt.render.surface.EDGE_ON_COSINE", 1e-6
    )  # nothing is held back
    quality = replace(PAIRS, samples=samples)
    mesh = sphere(80, (0.1, 0.05, 0.0), 0.6, 16) if balls == 1 else two_balls()
    model, grid, views = white(mesh), Grid(2, 48), SAMPLER.draw(1, 2)
    start = mesh.positions.astype(np.float64)
    rng = np.random.default_rng(0)
    by = rng.normal(size=(grid.pixels, 4))  # every pixel has its own weight: none hides the others
    analytic = pulled(*render(model, views, grid, quality), by)
    fields = rng.normal(size=(16, 1, 3)) + 0.3 * rng.normal(size=(16, len(start), 3))
    met: list[list[bytes]] = []

    def image() -> np.ndarray:
        batch, _, _ = render(model, views, grid, quality)
        edges, *curves = batch.seen.boundaries
        assert isinstance(edges, EdgePoints) and batch.seen.averaged is not None
        assert [type(c) for c in curves] == [Crossings] * (balls - 1)
        crossing = [a for c in curves for a in (c.pixel, c.inside.triangle)]
        seen = (edges.edge, edges.pixel, batch.seen.averaged.pixel, *crossing)
        met.append([np.array(a).tobytes() for a in seen])
        return np.array(batch.image).reshape(-1, 4)

    # where an outline passes the middle of a pixel, the image jumps by the difference between
    # neighbours: such differences are left out
    numeric = differences(model, start, fields, 2e-5, image, by)
    smooth = np.array([a == b for a, b in zip(met[::2], met[1::2], strict=True)])
    assert smooth.sum() >= 4
    predicted = np.einsum("vc,nvc->n", analytic, fields)
    # measured 0.003 to 0.008: rounding of differences over a two-thousandth of a pixel
    assert np.linalg.norm((predicted - numeric)[smooth]) < 0.03 * np.linalg.norm(numeric[smooth])


@pytest.mark.parametrize(("splits", "samples", "bias"), [(0, 1, 0.015), (2, 1, 0.03), (2, 4, 0.01)])
def test_pairs_carry_the_derivative_of_the_covered_area(
    splits: int, samples: int, bias: float
) -> None:
    mesh = ball(splits)
    model, grid, views = white(mesh), Grid(4, 64), SAMPLER.draw(1, 4)
    by = np.zeros((grid.pixels, 4))
    by[:, 3] = 1
    rendered = render(model, views, grid, replace(PAIRS, samples=samples))
    start = mesh.positions.astype(np.float64)
    found = np.sum(pulled(*rendered, by) * start)
    batch = Batch(views.records(), grid)

    def image() -> np.ndarray:
        return np.array(render_image(drawn_of(model), batch, 64)).reshape(-1, 4)

    numeric = differences(model, start, start[None], 0.02, image, by)[0]
    # measured +0.3 %; -1.6 % with triangles as small as pixels; +0.04 % with 2 x 2 samples in a
    # pixel
    assert found == pytest.approx(numeric, rel=bias)


def test_a_walk_finds_silhouettes_beyond_the_triangle_that_is_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Why we walk: without, fine meshes lose most of their outline."""
    model, grid, views = white(ball(0)), Grid(2, 64), SAMPLER.draw(1, 2)
    every, _, _ = render(model, views, grid, PAIRS)
    monkeypatch.setattr(silhouette_walk, "LONGEST", 1)
    near, _, _ = render(model, views, grid, PAIRS)
    found = [dr.width(batch.seen.boundaries[0].pixel) for batch in (every, near)]
    assert found[1] < 0.5 * found[0]


def test_faces_around_faces() -> None:
    """A strip of three triangles, and two more on the edge (2, 3), which then has no single
    neighbour."""
    faces = np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4], [3, 2, 5]])
    edges = walkable(edge_list(faces), faces)
    packets = np.array(edges.packets).reshape(-1, 4)
    around = np.array(edges.around).reshape(-1, 3, 4)
    np.testing.assert_array_equal(around[:, 0, :3], faces)
    for face in range(len(faces)):
        for k in range(3):
            ends = {int(faces[face, k]), int(faces[face, (k + 1) % 3])}
            assert set(packets[around[face, 1, k], :2].tolist()) == ends
            sharing = [f for f in range(len(faces)) if f != face and ends <= set(faces[f].tolist())]
            assert around[face, 2, k] == (sharing[0] if len(sharing) == 1 else face)


def test_a_step_with_pairs_agrees_with_one_with_edges() -> None:
    model, grid = make_model(fit=("shape",)), Grid(2, 64)
    inputs = make_inputs(model, grid, 1)
    found = {}
    for name, quality in (
        ("pairs", replace(PAIRS, samples=16)),
        ("edges", Quality(16, visibility=CameraRays((Edges(16.0),), 64))),
        ("none", Quality(16, visibility=CameraRays(()))),
    ):
        _, grads = Gradients(model, grid, quality, LOSSES["l2"], freeze=False)(inputs)
        # along three translations and a scaling
        g = np.array(grads[POSITIONS]).reshape(-1, 3).astype(np.float64)
        found[name] = np.append(g.sum(0), np.sum(g * model.host_positions()))
    reference = np.linalg.norm(found["edges"])
    # measured 0.010 and 1.1
    assert np.linalg.norm(found["pairs"] - found["edges"]) < 0.05 * reference
    assert np.linalg.norm(found["none"] - found["edges"]) > 0.3 * reference


def test_surfaces_that_run_into_each_other_move_their_meeting_curve() -> None:
    """One of two intersecting balls moves: against differences of the box-filtered image."""
    problem = make_problem("intersecting", 64)
    second = np.arange(len(problem.positions)) >= len(problem.positions) // 2
    fields = np.eye(3)[:, None] * second[None, :, None]
    target, truth = differences_along(problem, fields, 64)
    ours = Ours(problem, target, "log-srgb-l1")
    error = {}
    edges, both = (Edges(8.0),), (Edges(8.0), Intersections())
    qualities = {
        "pairs": replace(PAIRS, samples=4),
        "edges": Quality(4, visibility=CameraRays(edges, 16)),
        "both": Quality(4, visibility=CameraRays(both, 16)),
    }
    for name, quality in qualities.items():
        g = ours(quality, 0)
        error[name] = error_of(np.einsum("vc,nvc->n", g, fields)[None], truth).relative
    # measured 0.083, 0.066 and 0.25: edges alone do not know that the curve moves
    assert max(error["pairs"], error["both"]) < 0.6 * error["edges"]
    assert max(error["pairs"], error["both"]) < 0.15


def test_pairs_that_see_nothing_are_no_pairs() -> None:
    mesh = sphere(100, (0.0, 0.0, 0.0), 0.5, 16)
    away = LatentMesh(
        mesh.positions + np.float32(100), mesh.faces, mesh.frame_vertex, mesh.frame_faces, mesh.uvs
    )
    model, grid = white(away), Grid(2, 32)
    batch, _, _ = render(model, SAMPLER.draw(0, 2), grid, PAIRS)
    assert not batch.seen.boundaries and batch.seen.averaged is None
    assert not np.array(batch.image).any()


def test_only_what_is_chosen_is_prepared() -> None:
    model, grid = make_model(fit=("shape",)), Grid(1, 32)
    inputs = make_inputs(model, grid)
    Gradients(model, grid, Quality(), LOSSES["l2"], freeze=False)(inputs)
    assert "walkable" not in vars(model.topology)
    Gradients(model, grid, PAIRS, LOSSES["l2"], freeze=False)(inputs)
    assert "walkable" in vars(model.topology)


def test_bad_qualities_are_refused() -> None:
    with pytest.raises(ValueError, match="square number of samples per pixel, not 3"):
        Quality(3, visibility=Pairs())
