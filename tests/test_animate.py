"""Fits over an animation: gradients of a posed latent, frames, and the job ``animate``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.asset import Asset, load, save
from appearance_opt.asset.posing import pose, pose_positions
from appearance_opt.asset.rig import Skin
from appearance_opt.errors import InputError
from appearance_opt.initial.sphere import sphere
from appearance_opt.jobs.animate import AnimateResult, animate
from appearance_opt.jobs.compare import compare
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.positions import POSITIONS
from appearance_opt.latent.skinning import WEIGHTS, BoneFrames
from appearance_opt.optimize.losses import LOSSES
from appearance_opt.optimize.step import Gradients, StepInputs
from appearance_opt.options.animation import AnimationOptions
from appearance_opt.options.views import ViewOptions
from appearance_opt.reference.pool import Targets
from appearance_opt.render.pixels import Grid
from appearance_opt.render.quality import Quality
from appearance_opt.stages.animation import Animation, choose_frames
from appearance_opt.views import ViewSampler
from scenes.analytic import bumpy_sphere
from scenes.creature import creature

QUICK = {
    "triangles": 300, "steps": 6, "resolution": 48, "pool": 4, "views": 2, "texture_size": 64,
    "reallocate": 0,
}  # fmt: skip


@pytest.fixture(scope="module")
def small() -> Asset:
    return creature(2400, 64)


@pytest.fixture(scope="module")
def result(small: Asset, tmp_path_factory: pytest.TempPathFactory) -> tuple[AnimateResult, Path]:
    folder = tmp_path_factory.mktemp("animate")
    save(small, folder / "creature.glb")
    made = animate(
        folder / "creature.glb",
        folder / "light.glb",
        report=folder / "report",
        influences=2,
        clip="walk",
        frames="0:24:8",
        **QUICK,
    )
    return made, folder


BONES = 3


def posed_problem(matrices: np.ndarray) -> tuple[Latent, Latent, Grid, StepInputs]:
    """(a latent at the second frame of ``matrices``, a still one at the same vertices, ...)."""
    rng = np.random.default_rng(0)
    mesh = sphere(200, (0.0, 0.0, 0.0), 0.6, 16)
    count = len(mesh.positions)
    weights = rng.random((count, BONES)).astype(np.float32)
    skin = Skin(
        np.tile(np.arange(BONES, dtype=np.int32), (count, 1)),
        weights / weights.sum(axis=1, keepdims=True),
    )
    maps = {"red": 0.6, "green": 0.3, "blue": 0.2, "roughness": 0.5, "metalness": 0.0}
    moving = latent_of(mesh, maps, ("shape",), skinned=(skin, BoneFrames.of(matrices)))
    moving.select(moving.poses[1])
    posed = moving.posed_mesh(moving.poses[1])
    still = latent_of(replace(mesh, positions=posed.positions), maps, ("shape",))
    grid = Grid(2, 40)
    views = ViewSampler((0.0, 0.0, 0.0), 1.0, 4).draw(0, 2)
    target = mi.Float(rng.random(4 * grid.pixels).astype(np.float32) * 0.5)
    background = np.full((2, 3), 0.4, np.float32)
    return moving, still, grid, StepInputs(views, Targets(target), background, 0.0, 0.0, 3)


def gradients(latent: Latent, grid: Grid, inputs: StepInputs) -> dict[str, np.ndarray]:
    found = Gradients(latent, grid, Quality(), LOSSES["l2"], freeze=False)(inputs)[1]
    return {name: np.array(g, np.float64) for name, g in found.items()}


def test_gradients_are_those_of_the_posed_mesh_through_the_bones() -> None:
    """A posed latent against a still one at the same vertices, whose gradients, silhouettes
    included, others compare with differences: by the chain rule, to rounding."""
    matrices = np.tile(np.eye(4), (2, BONES, 1, 1))
    matrices[:, :, :3] += np.random.default_rng(1).normal(0, 0.15, (2, BONES, 3, 4))
    moving, still, grid, inputs = posed_problem(matrices)
    found, truth = gradients(moving, grid, inputs), gradients(still, grid, inputs)
    mesh, m = moving.mesh, matrices[1]
    by_vertex = truth[POSITIONS].reshape(-1, 3)
    assert np.abs(by_vertex).max() > 0
    w = np.exp(np.array(moving.parameters[WEIGHTS].value, np.float64).reshape(-1, BONES))
    w /= w.sum(axis=1, keepdims=True)
    expected = np.einsum("vb,bij,vi->vj", w, m[:, :3, :3], by_vertex)
    error = np.abs(found[POSITIONS].reshape(-1, 3) - expected).max()
    assert error < 2e-4 * np.abs(expected).max()
    homogeneous = np.concatenate([mesh.positions, np.ones((len(w), 1))], axis=1)
    by_weight = np.einsum("bij,vj,vi->vb", m[:, :3], homogeneous, by_vertex)
    expected = w * (by_weight - (w * by_weight).sum(axis=1, keepdims=True))
    error = np.abs(found[WEIGHTS].reshape(-1, BONES) - expected).max()
    assert error < 2e-4 * np.abs(expected).max()


HARD = {
    "a bone that is a point": (np.diag([0.0, 0, 0, 1]), 1),
    "all bones are points": (np.diag([0.0, 0, 0, 1]), BONES),
    "a reflection": (np.diag([-1.0, 1, 1, 1]), BONES),
    "half a turn": (np.diag([-1.0, -1, 1, 1]), 2),
    "flat": (np.diag([1.0, 0, 1, 1]), BONES),
}


@pytest.mark.parametrize("name", HARD)
def test_hard_poses_leave_finite_gradients(name: str) -> None:
    matrix, bones = HARD[name]
    matrices = np.tile(np.eye(4), (2, BONES, 1, 1))
    matrices[1, :bones] = matrix
    moving, _, grid, inputs = posed_problem(matrices)
    assert all(np.isfinite(g).all() for g in gradients(moving, grid, inputs).values())


def test_a_frame_in_its_own_coordinates_is_the_posed_asset(small: Asset) -> None:
    animation = Animation.of(
        small, AnimationOptions(clips=("walk",), frames="0:24:12"), ViewOptions()
    )
    assert [str(f) for f in animation.frames] == ["walk 0", "walk 12"]
    for k, frame in enumerate(animation.frames):
        drawn = animation.reference.at(k)
        there = animation.placements[k].to_world(drawn.merged.positions)
        matrices = pose(small, frame.clip, frame.time)
        expected = np.concatenate([pose_positions(m, matrices) for m in small.meshes])
        np.testing.assert_allclose(there, expected, atol=2e-6)
        assert np.linalg.norm(drawn.merged.positions, axis=1).max() < 1.05
    assert {p.scale for p in animation.placements} == {animation.placements[0].scale}


def test_pools_show_each_frame_as_often_as_the_others(small: Asset) -> None:
    animation = Animation.of(
        small, AnimationOptions(clips=("look",), frames="0:24:8"), ViewOptions()
    )
    pool = animation.pool(ViewOptions(resolution=16, per_step=2, pool=12, reuse=0), 1, 0.4)
    frames = [pool.draw(k)[1].frame for k in range(6)]
    assert sorted(frames[:3]) == [0, 1, 2] == sorted(frames[3:])
    assert pool.draw(40)[1].frame in (0, 1, 2)


def test_frames_that_options_ask_for(small: Asset) -> None:
    def chosen(**values: object) -> list[str]:
        return [str(f) for f in choose_frames(small.rig, AnimationOptions(**values))]

    assert chosen(clips=("look",), frames="3:9:3") == ["look 3", "look 6"]
    assert chosen(clips=("walk",), frames="20:") == [f"walk {k}" for k in range(20, 25)]
    assert len(chosen()) == 48
    with pytest.raises(InputError, match=r"--frames 90:99: none of them is in clip 'walk'"):
        chosen(frames="90:99")
    with pytest.raises(InputError, match="did you mean 'walk'"):
        chosen(clips=("wakl",))
    for wrong in ("a:b", "0:9:0", "1:2:3:4"):
        with pytest.raises(InputError, match="START:STOP:STEP"):
            AnimationOptions(frames=wrong)


def test_the_result_has_the_joints_and_clips_of_the_source(
    small: Asset, result: tuple[AnimateResult, Path]
) -> None:
    _, folder = result
    light = load(folder / "light.glb", keep_rig=True)
    assert 0 < light.triangle_count <= QUICK["triangles"]
    assert {n.name for n in light.rig.nodes} == {n.name for n in small.rig.nodes}
    assert [c.name for c in light.rig.clips] == ["walk", "look"]
    assert light.meshes[0].skin.bones.shape[1] <= 2
    height = np.ptp(small.points(), axis=0).max()
    for clip, time in (("walk", 0.3), ("look", 0.25)):
        p, q = (
            np.concatenate([pose_positions(m, pose(a, clip, time)) for m in a.meshes])
            for a in (small, light)
        )
        distance = np.linalg.norm(q[:, None] - p[None], axis=2).min(axis=1)
        assert distance.max() < 0.08 * height


def test_the_report_tells_the_error_by_frame(result: tuple[AnimateResult, Path]) -> None:
    made, folder = result
    assert made.errors.frames == ("walk 0", "walk 8", "walk 16")
    assert all(len(e) == 3 for e in (made.errors.start, made.errors.wide, made.errors.pruned))
    assert "worst frame" in (folder / "report" / "report.html").read_text(encoding="utf-8")


def test_what_cannot_be_animated_is_refused(small: Asset, tmp_path: Path) -> None:
    still = bumpy_sphere(1000, 16)
    with pytest.raises(InputError, match="no animation in it; `appearance-opt simplify`"):
        animate(still, tmp_path / "x.glb", **QUICK)
    with pytest.raises(InputError, match="OBJ files hold no skeleton"):
        animate(small, tmp_path / "x.obj", **QUICK)
    assert not list(tmp_path.iterdir())


def test_comparisons_pose_both(small: Asset, result: tuple[AnimateResult, Path]) -> None:
    _, folder = result
    light = load(folder / "light.glb", keep_rig=True)
    quick = {"views": 3, "resolution": 48, "samples": 1}
    found = compare(small, light, clip="look", **quick)
    assert [f for f, _ in found.frames] == [0, 12, 24]
    assert found.reference.shape == (3, 48, 48, 4)
    assert "PSNR at frame 12" in "\n".join(found.lines())
    one = compare(small, small, clip="walk", frame=5, **quick)
    assert {f for f, _ in one.frames} == {5} and one.metrics.psnr_covered > 60
    with pytest.raises(InputError, match="there is no clip 'hop'"):
        compare(small, light, clip="hop", **quick)
    with pytest.raises(InputError, match="no animation in it; leave --clip out"):
        compare(bumpy_sphere(1000, 16), light, clip="look", **quick)
    with pytest.raises(InputError, match="--frame needs --clip"):
        compare(small, light, frame=3, **quick)
