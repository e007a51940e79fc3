"""Hard cases of fits and jobs: a finite result, or a clear refusal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import load
from appearance_opt.asset.types import Asset, Mesh
from appearance_opt.config import SimplifyOptions, simplify_options
from appearance_opt.errors import InputError, ReferenceRenderError
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.initial.sphere import sphere
from appearance_opt.jobs.simplify import simplify
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.latent.parameter import Rates
from appearance_opt.optimize.checkpoint import Checkpointer
from appearance_opt.optimize.loop import FitResult, FitRun, fit
from appearance_opt.optimize.observers import Reporter
from appearance_opt.optimize.plan import FitOptions
from appearance_opt.optimize.validation import Validation
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.pool import ReferencePool
from appearance_opt.views import Views
from tests.test_hard_cases import SAMPLER, TRIANGLE, model_of


def options(**values: object) -> SimplifyOptions:
    base = {
        "triangles": 150,
        "texture_size": 32,
        "resolution": 32,
        "pool": 8,
        "views": 2,
        "steps": 4,
        "budget": None,
    }
    return simplify_options(**{**base, **values})


def moved(asset: Asset, scale: float = 1.0, offset: float = 0.0) -> Asset:
    change = lambda p: (p.astype(np.float64) * scale + offset).astype(np.float32)  # noqa: E731
    return replace(
        asset, meshes=tuple(replace(m, positions=change(m.positions)) for m in asset.meshes)
    )


def soup(positions: object, faces: object) -> Asset:
    return Asset(
        (Mesh(np.asarray(positions, np.float32), np.asarray(faces, np.int32).reshape(-1, 3)),)
    )


@pytest.fixture(scope="module")
def exact(ball: Asset) -> Asset:
    """Coordinates that single precision still holds exactly 1e5 away from the origin."""
    mesh = ball.meshes[0]
    return replace(
        ball, meshes=(replace(mesh, positions=np.round(mesh.positions * 128) / np.float32(128)),)
    )


def test_no_threshold_depends_on_the_scale(exact: Asset, one_thread: float) -> None:
    """A power of two changes no digit of any coordinate, and none of the result."""
    (mesh,) = simplify(exact, None, options()).asset.meshes
    for scale in (2.0**-20, 2.0**20):
        (scaled,) = simplify(moved(exact, scale), None, options()).asset.meshes
        np.testing.assert_array_equal(scaled.faces, mesh.faces)
        np.testing.assert_array_equal(scaled.uvs, mesh.uvs)
        np.testing.assert_allclose(
            scaled.positions / np.float32(scale), mesh.positions, rtol=0, atol=one_thread
        )


def test_results_are_as_good_at_any_scale_and_place(exact: Asset) -> None:
    """Rounding may turn single decisions, but no more."""
    views = SAMPLER.held_out(3).draw(0, 2)
    truth = MeshReference(exact).render(views, 64, 9)

    def quality(scale: float, offset: float) -> float:
        found = simplify(moved(exact, scale, offset), None, options()).asset
        back = moved(moved(found, 1.0, -offset), 1 / scale)
        return compare_images(truth, MeshReference(back).render(views, 64, 9)).psnr_covered

    plain = quality(1.0, 0.0)
    assert plain > 20
    assert min(quality(1e-6, 0.0), quality(1.0, 1e5)) > plain - 3


@pytest.mark.parametrize(
    ("asset", "ask"),
    [
        pytest.param(soup(TRIANGLE, [0, 1, 2]), 1, id="one triangle"),
        pytest.param(soup([*TRIANGLE, [0, 0, 1]], [[0, 1, 2], [1, 0, 3]]), 2, id="two"),
        pytest.param(
            soup([*TRIANGLE, [0, 0, 1]], [[0, 1, 2], [1, 0, 3], [2, 1, 3], [0, 2, 3]]),
            4,
            id="tetrahedron",
        ),
        pytest.param(soup([*TRIANGLE, *TRIANGLE], [[0, 1, 2], [5, 4, 3]]), 2, id="double sheet"),
        pytest.param(soup([[-1, 0, 0], [1, 0, 0], [0, 2e-6, 0]], [0, 1, 2]), 1, id="sliver"),
    ],
)
def test_inputs_of_a_few_triangles(asset: Asset, ask: int, tmp_path: Path) -> None:
    result = simplify(asset, tmp_path / "x.glb", options(triangles=ask))
    assert 0 < load(tmp_path / "x.glb").triangle_count == result.triangles <= ask


def test_budgets_that_cannot_be_reached_are_refused(ball: Asset) -> None:
    with pytest.raises(InputError, match="nothing is left of this mesh"):
        simplify(ball, None, options(triangles=1))  # a closed surface needs four
    with pytest.raises(InputError, match="at least 1"):
        options(triangles=0)
    with pytest.raises(InputError, match="at least 12 triangles"):
        simplify(ball, None, options(triangles=11, init="sphere", fit=("material",)))
    # a sphere that may move is grown with more triangles than it ends with
    assert simplify(ball, None, options(triangles=11, init="sphere")).triangles <= 11


def test_a_start_from_a_file_needs_no_count(ball: Asset, tmp_path: Path) -> None:
    start = simplify(ball, tmp_path / "start.glb", options(triangles=100))
    chosen = options(triangles=None, init=str(tmp_path / "start.glb"))
    assert simplify(ball, None, chosen).triangles == start.triangles
    with pytest.raises(InputError, match="more than the 50 asked for"):
        simplify(ball, None, options(triangles=50, init=str(tmp_path / "start.glb")))
    with pytest.raises(InputError, match="--triangles N or --ratio R"):
        options(triangles=None)


class Images:
    """A reference that answers with fixed pixels."""

    def __init__(self, pixel: tuple[float, float, float, float]) -> None:
        self.pixel = pixel

    def render(self, views: Views, resolution: int, samples: int = 1) -> np.ndarray:
        return np.tile(np.float32(self.pixel), (len(views), resolution, resolution, 1))


def fit_of(
    reference: object, mesh: LatentMesh, steps: int, **choices: object
) -> tuple[Latent, FitResult]:
    model = model_of(mesh)
    pool = ReferencePool(reference, SAMPLER, 8, 2, 32, 4)
    validation = Validation(reference, SAMPLER.held_out(1).draw(0, 2), 32)
    return model, fit(model, pool, validation, FitOptions(steps=steps, **choices))


@pytest.mark.parametrize(
    "pixel", [(0, 0, 0, 0), (0, 0, 0, 1), (6e4, 6e4, 6e4, 1)], ids=["empty", "black", "blinding"]
)
@pytest.mark.parametrize("loss", ["log-srgb-l1", "l2"])
def test_references_without_anything_to_see(pixel: tuple, loss: str) -> None:
    model, result = fit_of(Images(pixel), sphere(100, (0.0, 0.0, 0.0), 0.7, 16), 4, loss=loss)
    assert result.skipped == 0 and result.steps == 4
    assert np.isfinite(model.host_positions()).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1e-3])
def test_unusable_pixels_of_the_reference_are_refused(value: float) -> None:
    with pytest.raises(ReferenceRenderError, match=r"NaN, infinite or negative pixels in view 0"):
        fit_of(Images((0.1, value, 0.1, 1.0)), sphere(100, (0.0, 0.0, 0.0), 0.7, 16), 1)


def test_a_start_far_away_from_the_reference(ball: Asset) -> None:
    far = sphere(100, (40.0, 0.0, 0.0), 0.3, 16)
    model, result = fit_of(MeshReference(ball), far, 3)
    assert result.skipped == 0 and np.isfinite(model.host_positions()).all()


def test_the_same_seed_twice(ball: Asset, one_thread: float) -> None:
    """What docs/conventions.md promises."""
    runs = [simplify(ball, None, options(steps=12)) for _ in range(2)]
    for a, b, farthest in ((*(r.start for r in runs), 0.0), (*(r.asset for r in runs), one_thread)):
        (a,), (b,) = a.meshes, b.meshes
        np.testing.assert_array_equal(a.faces, b.faces)
        np.testing.assert_array_equal(a.uvs, b.uvs)
        np.testing.assert_allclose(a.positions, b.positions, rtol=0, atol=farthest)
        for name in ("base_color_texture", "orm_texture", "normal_texture"):
            pixels, again = (getattr(m.material, name).pixels.astype(int) for m in (a, b))
            assert np.abs(pixels - again).max() <= 255 * farthest


@pytest.mark.parametrize("stop", [1, 4, 7, 11])
def test_a_fit_resumed_anywhere_ends_where_the_whole_one_does(
    ball: Asset, tmp_path: Path, stop: int, one_thread: float
) -> None:
    def parts():
        reference = MeshReference(ball)
        model = model_of(sphere(300, (0.0, 0.0, 0.0), 0.9, 16))
        pool = ReferencePool(reference, SAMPLER, 8, 2, 32, 4)
        return model, pool, Validation(reference, SAMPLER.held_out(1).draw(0, 2), 32)

    chosen = FitOptions(steps=12)
    whole = parts()
    expected = fit(*whole, chosen)
    first = FitRun(*parts(), chosen, [Checkpointer(tmp_path, "x", False, 0.0)])
    first.look()
    for _ in range(stop):
        first.advance()
    second = parts()
    result = fit(*second, chosen, [Checkpointer(tmp_path, "x", True, 1e9)])
    assert [p.step for p in result.curve] == [p.step for p in expected.curve]
    assert result.best_step == expected.best_step
    np.testing.assert_allclose(
        second[0].host_positions(), whole[0].host_positions(), rtol=0, atol=one_thread
    )


def test_a_truncated_checkpoint_is_refused(ball: Asset, tmp_path: Path) -> None:
    simplify(ball, None, options(), checkpoint=tmp_path / "state")
    file = tmp_path / "state" / "fit.npz"
    data = file.read_bytes()
    for size in (len(data) // 2, len(data) - 1, 30, 0):
        file.write_bytes(data[:size])
        with pytest.raises(InputError, match=r"fit\.npz: not a usable checkpoint"):
            simplify(ball, None, options(), checkpoint=tmp_path / "state", resume=True)


def test_a_checkpoint_of_other_textures_is_refused(ball: Asset, tmp_path: Path) -> None:
    simplify(ball, None, options(), checkpoint=tmp_path)
    m = ball.meshes[0]
    other = replace(
        m.material.base_color_texture, pixels=255 - m.material.base_color_texture.pixels
    )
    painted = Asset(
        (replace(m, material=replace(m.material, base_color_texture=other)),), ball.name
    )
    with pytest.raises(InputError, match="another input"):
        simplify(painted, None, options(), checkpoint=tmp_path, resume=True)


def test_an_interrupted_fit_hands_out_what_it_reached(ball: Asset) -> None:
    """Not the last state that was looked at: the one at the interrupt, if it is better."""

    class Stop:
        def stage(self, text: str) -> None:
            pass

        def update(self, step: int, *_: object) -> None:
            if step == 20:
                raise KeyboardInterrupt

    model = model_of(sphere(300, (0.0, 0.0, 0.0), 0.9, 16))
    reference = MeshReference(ball)
    pool = ReferencePool(reference, SAMPLER, 8, 2, 32, 4)
    model.set_rates(Rates(0.02, 0.01, 0.03, 0.02))
    result = fit(
        model,
        pool,
        Validation(reference, SAMPLER.held_out(1).draw(0, 2), 32),
        FitOptions(steps=900),
        [Reporter(Stop())],
    )
    assert result.interrupted and result.best_step == 20
