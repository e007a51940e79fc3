"""A fit hands out no triangle that has turned over."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.asset.types import Asset
from appearance_opt.initial.sphere import random_maps, sphere
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.folds import Folds
from appearance_opt.latent.parameter import Rates
from appearance_opt.optimize.loop import FitResult, fit
from appearance_opt.optimize.plan import FitOptions
from appearance_opt.optimize.validation import Validation
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.pool import ReferencePool
from appearance_opt.views import ViewSampler


def plate(n: int) -> tuple[np.ndarray, np.ndarray]:
    """n x n squares of side 1 at z = 0, facing up."""
    x, y = np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0))
    p = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    f = np.concatenate([np.stack([i, i + 1, i + n + 2], 1), np.stack([i, i + n + 2, i + n + 1], 1)])
    return p, f


def flat(p: np.ndarray) -> mi.Float:
    return mi.Float(p.astype(np.float32).ravel())


def test_a_vertex_that_folds_its_triangles_goes_back_as_far_as_it_must() -> None:
    p, f = plate(4)
    moved = p.copy()
    moved[12] += (1.5, 0, 0)  # the middle, past its neighbour on the right
    folds = Folds(p, f)
    assert folds.folded(p).sum() == 0
    assert folds.folded(moved).sum() == 2
    out, count = folds.undo(flat(moved), flat(p))
    q = np.array(out).reshape(-1, 3)
    assert count == 2
    assert folds.folded(q).sum() == 0
    # halved once: the others stay where they are
    np.testing.assert_allclose(q[12], p[12] + (0.75, 0, 0))
    np.testing.assert_allclose(np.delete(q, 12, 0), np.delete(moved, 12, 0))


def test_what_is_not_folded_stays_as_it_is() -> None:
    p, f = plate(3)
    rng = np.random.default_rng(0)
    moved = flat(p + rng.uniform(-0.2, 0.2, p.shape))
    out, count = Folds(p, f).undo(moved, flat(p))
    assert count == 0
    assert out is moved
    # a triangle that turns about an axis is folded from a right angle on
    turned = [Folds(p, f).folded(p @ _turn(t)).all() for t in (1.5, 1.6)]
    assert turned == [False, True]


def _turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([(1, 0, 0), (0, c, s), (0, -s, c)])


@pytest.mark.parametrize("seed", range(3))
def test_crumpled_meshes_are_unfolded(seed: int) -> None:
    mesh = sphere(500, (0.0, 0.0, 0.0), 1.0, 16)
    p = mesh.positions.astype(float)
    rng = np.random.default_rng(seed)
    moved = p + rng.normal(0, 0.15, p.shape) * (p[:, :1] > 0)
    folds = Folds(mesh.positions, mesh.faces)
    out, count = folds.undo(flat(moved), flat(p))
    q = np.array(out).reshape(-1, 3)
    assert count == folds.folded(moved).sum() > 10
    assert folds.folded(q).sum() == 0
    # most of what was moved keeps most of its way
    way = (
        np.linalg.norm(q - p, axis=1)[p[:, 0] > 0] / np.linalg.norm(moved - p, axis=1)[p[:, 0] > 0]
    )
    assert np.median(way) >= 0.25
    assert way.max() < 1 + 1e-5


def test_triangles_without_area_are_never_folded() -> None:
    p = np.array([(0, 0, 0), (1, 0, 0), (2, 0, 0)], float)
    folds = Folds(p, np.array([(0, 1, 2)]))
    assert not folds.folded(p + [(0, 0, 0), (0, 1, 0), (0, 0, 0)]).any()


def fitted(ball: Asset, relative: bool) -> tuple[FitResult, int]:
    """(result, folded triangles) of a fit whose vertices take far too large steps while its colours
    get better."""
    sampler = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=1)
    reference = MeshReference(ball)
    mesh = sphere(1200, (0.0, 0.0, 0.0), 0.95, 64)
    model = latent_of(
        mesh,
        random_maps(64, 0, True),
        frozenset(("shape", "normal", "material")),
        Rates(0.2, 0.01, 0.1, 0.1),
    )
    pool = ReferencePool(reference, sampler, 16, 2, 48, 4)
    validation = Validation(reference, sampler.held_out(1).draw(0, 2), 48)
    result = fit(model, pool, validation, FitOptions(steps=24, laplacian=0.0, relative=relative))
    return result, int(Folds(mesh.positions, mesh.faces).folded(model.host_positions()).sum())


def test_a_fit_hands_out_no_folds_and_says_how_many_there_were(ball: Asset) -> None:
    free, folded = fitted(ball, False)
    assert folded > 20  # measured 104
    assert free.unfolded == 0
    kept, folded = fitted(ball, True)
    assert kept.best_step > 0
    assert folded == 0
    assert kept.unfolded > 0
    assert (
        f"{kept.unfolded} triangles that the fit had turned over were turned back" in kept.notes()
    )
