"""Opacity as a fitted map, and how it is written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from appearance_opt.asset import load, save
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.export import coverage_cutoff, to_asset
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.texels import OPACITY
from appearance_opt.optimize import adam
from appearance_opt.optimize.losses import LOSSES
from appearance_opt.optimize.step import Gradients, StepInputs, first_non_finite, step
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.pool import Targets
from appearance_opt.render.pixels import Grid
from appearance_opt.render.quality import Quality
from tests.test_gradients import SAMPLER, flat_maps
from tests.test_peeled import crossing

SIZE = 32


def wave() -> NDArray[np.float32]:
    """Opacity from 0 to 1, smooth."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    return np.float32(np.clip(0.5 + 0.7 * np.sin(4 * np.pi * x + 2 * y), 0, 1))


def test_a_fit_finds_the_opacity_of_what_it_sees() -> None:
    mesh = crossing(3)
    maps = {**flat_maps(SIZE), OPACITY: wave()}
    reference = MeshReference(to_asset(mesh, mesh.positions, maps, "cards"))
    start = {**maps, OPACITY: np.full((SIZE, SIZE), 0.5, np.float32)}
    model = latent_of(mesh, start, frozenset((OPACITY,)), Rates(opacity=0.1))
    grid = Grid(4, 32)
    gradients = Gradients(model, grid, Quality(), LOSSES["l2"])
    moments = {n: adam.moments_of(p) for n, p in model.parameters.items()}
    for k in range(40):
        views = SAMPLER.draw(k % 8, grid.views)
        seen = Targets(mi.Float(reference.render(views, 32, 8).ravel()))
        background = np.full((grid.views, 3), 0.1 * (k % 5), np.float32)
        inputs = StepInputs(views, seen, background, 0.0, 1.0, k, want_loss=False)
        done = step(gradients, moments, inputs, first_non_finite)
        assert done.bad is None
        model.assign(done.values)
        moments = done.moments
    # texels that views show
    used = np.zeros((SIZE, SIZE), bool)
    used[2:14, 2:14] = used[2:14, 18:30] = used[18:30, 2:14] = used[18:30, 18:30] = True
    found = model.host_maps()[OPACITY]
    assert found.min() >= 0
    assert found.max() <= 1
    before, after = (np.abs(m - maps[OPACITY])[used].mean() for m in (start[OPACITY], found))
    assert after < 0.25 * before  # measured 0.37 before


@pytest.mark.parametrize("alpha", ["mask", "blend"])
@pytest.mark.parametrize("suffix", [".glb", ".usdz"])
def test_opacity_is_written_with_colours_under_what_is_not_there(
    alpha: str, suffix: str, tmp_path: Path
) -> None:
    mesh, opacity = crossing(3), wave()
    maps: dict = {**flat_maps(SIZE), OPACITY: opacity}
    maps["red"] = np.where(opacity > 0, maps["red"], np.float32(1))  # a colour that nobody sees
    out = tmp_path / f"cards{suffix}"
    save(to_asset(mesh, mesh.positions, maps, "cards", alpha=alpha), out)  # type: ignore[arg-type]
    (written,) = load(out).meshes
    material = written.material
    assert material.alpha_mode == alpha
    assert material.double_sided
    texture = material.base_color_texture
    assert texture is not None
    np.testing.assert_array_equal(texture.pixels[..., 3], np.uint8(opacity * 255 + 0.5))
    assert len(np.unique(texture.pixels[..., :3].reshape(-1, 3), axis=0)) == 1
    if alpha == "mask":
        covered = (opacity >= material.alpha_cutoff).mean()
        assert covered == pytest.approx(opacity.mean(), abs=1.5 / SIZE)


def test_a_constant_colour_may_have_an_opacity() -> None:
    mesh = crossing(3)
    maps = {"red": 0.2, "green": 0.4, "blue": 0.6, OPACITY: wave()}
    material = to_asset(mesh, mesh.positions, maps, "cards").meshes[0].material
    assert material.base_color == (0.2, 0.4, 0.6)
    texture = material.base_color_texture
    assert texture is not None
    assert (texture.pixels[..., :3] == 255).all()
    opaque = to_asset(mesh, mesh.positions, {**maps, OPACITY: 1.0}, "cards").meshes[0].material
    assert opaque == replace(opaque, alpha_mode="opaque", base_color_texture=None)


@pytest.mark.parametrize(("value", "share"), [(0.0, 0.0), (1.0, 1.0)])
def test_nothing_and_everything_stay_what_they_are(value: float, share: float) -> None:
    opacity = np.full((4, 4), value, np.float32)
    assert (opacity >= coverage_cutoff(opacity)).mean() == share
