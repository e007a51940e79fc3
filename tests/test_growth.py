"""Starts from a sphere: preconditioned steps, the grown start, and going on from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import appearance_opt
from appearance_opt.asset import save
from appearance_opt.asset.types import Asset, Mesh
from appearance_opt.config import SimplifyOptions, simplify_options
from appearance_opt.errors import InputError
from appearance_opt.initial.sphere import sphere
from appearance_opt.jobs.simplify import simplify
from appearance_opt.latent.parameter import Parameter
from appearance_opt.latent.smoothing import Smoother
from appearance_opt.optimize import adam
from appearance_opt.optimize.checkpoint import Checkpointer
from appearance_opt.stages.growth import stretch
from appearance_opt.stages.start import Start
from appearance_opt.views import ViewSampler


def options(**values: object) -> SimplifyOptions:
    base = {
        "triangles": 200,
        "init": "sphere",
        "texture_size": 64,
        "resolution": 48,
        "pool": 16,
        "views": 2,
    }
    return simplify_options(**{**base, "budget": None, **values})


@pytest.fixture
def smoother() -> Smoother:
    mesh = sphere(300, (0.0, 0.0, 0.0), 1.0, 16)
    return Smoother(len(mesh.positions), mesh.faces, 3.0)


def test_smoothing_inverts_the_laplacian_system(smoother: Smoother) -> None:
    mesh = sphere(300, (0.0, 0.0, 0.0), 1.0, 16)
    smooth = np.array(smoother(mi.Float(mesh.positions.ravel()))).reshape(-1, 3).astype(np.float64)
    # (I + 3 L) applied by hand, edge by edge
    corners = mesh.faces.astype(np.int64)
    pairs = np.unique(
        np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), 1),
        axis=0,
    )
    back = smooth.copy()
    for a, b in pairs:
        back[a] += 3 * (smooth[a] - smooth[b])
        back[b] += 3 * (smooth[b] - smooth[a])
    np.testing.assert_allclose(
        back, mesh.positions, atol=2e-6
    )  # measured 4.5e-7: stored in single precision


def test_smoothing_keeps_translations_and_is_its_own_adjoint(smoother: Smoother) -> None:
    n = len(sphere(300, (0.0, 0.0, 0.0), 1.0, 16).positions)
    constant = np.tile(np.array([1.0, -2.0, 3.0], np.float32), n)
    np.testing.assert_allclose(np.array(smoother(mi.Float(constant))), constant, rtol=1e-5)
    rng = np.random.default_rng(0)
    a, b = (rng.normal(size=3 * n).astype(np.float32) for _ in range(2))
    left, right = np.array(smoother(mi.Float(a))) @ b, a @ np.array(smoother(mi.Float(b)))
    assert left == pytest.approx(right, rel=1e-4)


def test_preconditioned_steps_move_neighbours_together(smoother: Smoother) -> None:
    n = len(sphere(300, (0.0, 0.0, 0.0), 1.0, 16).positions)
    gradient = np.zeros((n, 3), np.float32)
    gradient[7] = (0, 0, -1)  # one vertex alone wants to move
    parameter = Parameter(
        "positions", mi.Float(np.zeros(3 * n, np.float32)), 1, mi.Float(0.1), smooth=smoother
    )
    value, _ = adam.update(parameter, mi.Float(gradient.ravel()), adam.moments_of(parameter), 1.0)
    moved = np.array(value).reshape(-1, 3)
    assert (moved[:, 2] > 0).all() and np.argmax(moved[:, 2]) == 7
    assert moved[7, 2] < 0.1 and np.abs(moved[:, :2]).max() < 1e-6


def test_a_grown_sphere_becomes_the_object(ball: Asset) -> None:
    # a long pear, thin above: neither a sphere nor an ellipsoid
    mesh = ball.meshes[0]
    x, y, z = mesh.positions.T
    waist = np.where(y > 0, 0.45, 0.8)
    pear = replace(mesh, positions=np.stack([x * waist, 2 * y, z * waist], axis=1), normals=None)
    target = replace(ball, meshes=(pear,))
    result = simplify(target, None, options(steps=120))
    assert result.triangles <= 200
    # measured 24.4 dB, 42 + 78 steps, and 0.05 of the extent
    assert (
        appearance_opt.compare(target, result.asset, views=3, resolution=64).metrics.psnr_covered
        > 20
    )
    extent = np.ptp(result.asset.meshes[0].positions, axis=0)
    np.testing.assert_allclose(extent, np.ptp(pear.positions, axis=0), atol=0.1)


def test_spheres_start_in_the_box_of_the_object() -> None:
    corners = np.array([[-1.0, 0.0, 2.0], [3.0, 8.0, 2.0]])  # flat in z
    ball = sphere(300, (0.0, 0.0, 0.0), 1.0, 16)
    p = stretch(ball, ViewSampler((0.0, 0.0, 0.0), 10.0, 0, hull=corners)).positions
    np.testing.assert_allclose((p.min(0) + p.max(0)) / 2, (1.0, 4.0, 2.0), atol=1e-5)
    # 95 % of the box, and a tenth of the radius where it is flat; 300 triangles reach the axes to 2
    # %
    np.testing.assert_allclose(np.ptp(p, axis=0), np.array([4.0, 8.0, 2.0]) * 0.95, rtol=0.03)
    p = stretch(ball, ViewSampler((1.0, 0.0, 0.0), 10.0, 0)).positions
    np.testing.assert_allclose(np.linalg.norm(p - (1.0, 0.0, 0.0), axis=1), 6.0, rtol=1e-5)


def test_a_spoilt_mesh_is_mended(ball: Asset, tmp_path: Path) -> None:
    # 300 triangles; a quarter of the volume is lost, and the cap is torn off and lies aside
    mesh = sphere(300, (0.0, 0.0, 0.0), 0.9, 64)
    p = mesh.positions[mesh.faces].reshape(-1, 3)
    cap = np.repeat(p.reshape(-1, 3, 3)[..., 1].mean(axis=1) > 0.6, 3)
    p[cap] += np.array([0.15, 0.1, 0.0], np.float32)
    bad = tmp_path / "bad.obj"
    save(Asset((Mesh(p, np.arange(len(p), dtype=np.int32).reshape(-1, 3)),), "bad"), bad)
    kept_shape = simplify(ball, None, options(triangles=None, init=str(bad), steps=0))
    result = simplify(ball, None, options(triangles=None, init=str(bad), steps=100, relative=False))
    assert result.triangles == len(mesh.faces)
    before, after = (
        appearance_opt.compare(ball, x, views=3, resolution=64).metrics
        for x in (kept_shape.asset, result.asset)
    )
    assert after.silhouette_shift < 0.4 * before.silhouette_shift
    assert after.psnr_covered > before.psnr_covered + 5


def test_a_resumed_growth_goes_on_from_the_same_start(ball: Asset, tmp_path: Path) -> None:
    first = simplify(ball, None, options(steps=6), checkpoint=tmp_path)
    again = simplify(ball, None, options(steps=6), checkpoint=tmp_path, resume=True)
    for name in ("positions", "faces", "uvs"):
        np.testing.assert_array_equal(
            getattr(first.start.meshes[0], name), getattr(again.start.meshes[0], name)
        )
    assert again.fit.steps == first.fit.steps


def never() -> tuple[Start, bool]:
    raise AssertionError("a start that is there is not made again")


def test_a_broken_start_is_refused(ball: Asset, tmp_path: Path) -> None:
    path = tmp_path / "start.npz"
    path.write_bytes(b"not a start")
    with pytest.raises(InputError, match="not a usable start"):
        Checkpointer(tmp_path, "job", resume=True).start(never)
    path.unlink()
    simplify(ball, None, options(steps=2), checkpoint=tmp_path)
    path.write_bytes(path.read_bytes()[:-100])  # a whole archive, cut short
    with pytest.raises(InputError, match="not a usable start"):
        Checkpointer(tmp_path, "job", resume=True).start(never)


def test_the_start_of_another_job_is_refused(ball: Asset, tmp_path: Path) -> None:
    simplify(ball, None, options(steps=2), checkpoint=tmp_path)
    (tmp_path / "fit.npz").unlink()  # killed between growing and the first checkpoint
    with pytest.raises(InputError, match="another input or other options"):
        simplify(ball, None, options(steps=2, seed=5), checkpoint=tmp_path, resume=True)


def test_growing_counts_among_the_steps(ball: Asset) -> None:
    seen: list[int] = []

    class Steps:
        def stage(self, text: str) -> None:
            pass

        def update(self, step: int, *rest: object) -> None:
            seen.append(step)

    simplify(ball, None, options(steps=20), progress=Steps())
    assert len(seen) == 20 and max(seen) == 13  # 7 steps of growing, then 13 of the fit
