"""Parts and poses of a latent, the plan of a fit, and who watches it."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.asset.types import Asset
from appearance_opt.errors import InputError
from appearance_opt.initial.sphere import random_maps, sphere
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.parameter import Parameter
from appearance_opt.latent.parts import Part, Pose
from appearance_opt.latent.positions import POSITIONS, Positions
from appearance_opt.latent.texels import Texels
from appearance_opt.optimize.checkpoint import Checkpointer
from appearance_opt.optimize.loop import FitRun, fit
from appearance_opt.optimize.losses import LOSSES
from appearance_opt.optimize.observers import Observer, Running
from appearance_opt.optimize.plan import FitOptions, Plan
from appearance_opt.optimize.step import Gradients, StepInputs
from appearance_opt.optimize.validation import Validation
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.pool import ReferencePool, Targets
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.images import render_image
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.quality import Quality
from appearance_opt.views import ViewSampler
from tests.test_displacement import inside_view

SAMPLER = ViewSampler((0.0, 0.0, 0.0), 1.2, seed=1)


class Slide(Part):
    """A part that no other file knows: the mesh, moved by a vector times the frame."""

    places = True

    def __init__(self, fitted: bool) -> None:
        vector = mi.Float([0.05, 0.02, -0.03])
        parameter = Parameter("slide", vector, 1, mi.Float(0.01)) if fitted else None
        super().__init__("slide", parameter, None if fitted else vector)

    def track(self, decoded: mi.Float) -> mi.Float:
        out = mi.Float(decoded)
        dr.enable_grad(out)
        return out

    def pull_back(self, tracked: mi.Float, stored: mi.Float) -> mi.Float:
        return dr.grad(tracked)

    def place(self, vertices: mi.Float, decoded: mi.Float, pose: Pose) -> mi.Float:
        if pose.frame is None:
            return vertices
        axis = dr.arange(mi.UInt32, dr.width(vertices)) % 3
        return vertices + dr.gather(mi.Float, decoded, axis) * mi.Float(pose.frame)


def sliding(fitted: bool) -> Latent:
    """A plain sphere in two frames: without maps nothing in its image jumps."""
    mesh = sphere(192, (0.0, 0.0, 0.0), 1.0, 16)
    parts = (Positions(mesh, False), Slide(fitted))
    poses = tuple(Pose(0, dr.opaque(mi.UInt32, frame)) for frame in (1, 2))
    return Latent(mesh, parts, {"red": 0.8, "roughness": 0.8, "metalness": 0.0}, poses)


def test_a_part_of_its_own_is_fitted_in_every_frame() -> None:
    """The gradient of a new part by differences, through the renderer and its recorded kernels.
    Measured: within 0.04 %."""
    latent, views, grid = sliding(True), inside_view(), Grid(2, 48)
    assert set(latent.parameters) == {"slide"}
    reference = mi.Float(np.tile(np.array([0.1, 0.1, 0.1, 1], np.float32), grid.pixels))
    inputs = StepInputs(views, Targets(reference), np.zeros((2, 3), np.float32), 0.0, 0.0, 3)
    gradients = Gradients(latent, grid, Quality(4, visibility=CameraRays(())), LOSSES["l2"])
    start, step = np.array(latent.values()["slide"]), 2e-3
    for pose in latent.poses:
        latent.select(pose)
        slope = np.array(gradients(inputs)[1]["slide"]).astype(np.float64)
        numeric = np.zeros(3)
        for axis in range(3):
            for sign in (1, -1):
                moved = start + np.float32(sign * step) * np.eye(3, dtype=np.float32)[axis]
                latent.restore({"slide": mi.Float(moved)})
                numeric[axis] += sign * float(gradients(inputs)[0][0]) / (2 * step)
        latent.restore({"slide": mi.Float(start)})
        assert np.linalg.norm(slope - numeric) < 0.01 * np.linalg.norm(numeric), (slope, numeric)


def test_frames_move_a_mesh_of_which_nothing_is_fitted() -> None:
    latent = sliding(False)
    assert not latent.parameters and not latent.laplacians(True)
    batch = Batch(inside_view().records(), Grid(2, 16))
    images = []
    for pose in (*latent.poses, Pose(), latent.poses[0]):
        latent.select(pose)
        images.append(np.array(render_image(latent.drawn(), batch, 1)))
    assert np.abs(images[0] - images[1]).max() > 1e-3 < np.abs(images[1] - images[2]).max()
    np.testing.assert_array_equal(images[0], images[3])
    rest = latent.posed_mesh().positions  # written is the mesh at rest
    np.testing.assert_array_equal(rest, latent.mesh.positions)


def make_fit(ball: Asset) -> tuple[Latent, ReferencePool, Validation]:
    latent = latent_of(
        sphere(80, (0.0, 0.0, 0.0), 0.9, 16), random_maps(16, 0, True), ("shape", "material")
    )
    reference = MeshReference(ball)
    pool = ReferencePool(reference, SAMPLER, 4, 2, 24, 4)
    return latent, pool, Validation(reference, SAMPLER.held_out(1).draw(0, 2), 24)


class Watcher(Observer):
    """Notes what it is told, and ends a fit after two steps."""

    def __init__(self) -> None:
        self.told: list[tuple[str, int]] = []

    def begin(self, latent: Latent, state: object) -> None:
        self.told.append(("begin", 0))

    def ends(self, fit: Running) -> bool:
        return fit.state.iteration == 2

    def stepped(self, fit: Running) -> None:
        self.told.append(("step", fit.state.iteration))

    def looked(self, fit: Running) -> None:
        self.told.append(("look", fit.state.iteration))

    def ended(self, fit: Running) -> None:
        self.told.append(("end", fit.state.iteration))


def test_observers_are_told_and_may_end_a_fit(ball: Asset) -> None:
    watcher = Watcher()
    result = fit(*make_fit(ball), FitOptions(steps=9), [watcher])
    assert result.interrupted and result.steps == 2
    # a look in every eighth of the fit, here after the second step, and one at the end
    assert watcher.told == [
        ("begin", 0),
        ("look", 0),
        ("step", 1),
        ("look", 2),
        ("step", 2),
        ("look", 2),
        ("end", 2),
    ]


def test_a_plan_can_be_replayed_and_replaced(ball: Asset) -> None:
    options, poses = FitOptions(steps=9, seed=4), (Pose(0), Pose(1), Pose(2))
    plan = Plan.of(options, poses, 3)
    for iteration in (0, 5, 8):
        one, again = plan.at(iteration, 0.3), plan.at(iteration, 0.3)
        np.testing.assert_array_equal(one.background, again.background)
        assert one.background.shape == (3, 3) and one.pose is again.pose
        assert (one.rate, one.seed, one.want_loss) == (again.rate, again.seed, iteration % 8 == 0)
    assert {plan.at(k, 0.0).pose.level for k in range(20)} == {0, 1, 2}
    assert plan.at(0, 0.0).laplacian == 1.0 > plan.at(0, 0.5).laplacian
    latent, pool, validation = make_fit(ball)
    start = {name: np.array(value) for name, value in latent.values().items()}
    still = replace(Plan.of(options, latent.poses, pool.batch), rate=lambda progress: 0.0)
    run = FitRun(latent, pool, validation, options, plan=still)
    run.advance()
    assert run.state.iteration == 1
    for name, value in latent.values().items():
        np.testing.assert_array_equal(np.array(value), start[name])


def test_checkpoints_of_another_version_are_refused_in_a_line(ball: Asset, tmp_path: Path) -> None:
    fit(*make_fit(ball), FitOptions(steps=1), [Checkpointer(tmp_path, "x", False)])
    path = tmp_path / "fit.npz"
    with zipfile.ZipFile(path) as packed:
        parts = {name: packed.read(name) for name in packed.namelist()}
    head = json.loads(parts.pop("archive.json")) | {"format": "appearance-opt archive 2"}
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("archive.json", json.dumps(head))
        for name, data in parts.items():
            packed.writestr(name, data)
    with pytest.raises(InputError, match=r"fit\.npz: not a usable .*another version") as error:
        fit(*make_fit(ball), FitOptions(steps=1), [Checkpointer(tmp_path, "x", True)])
    assert "\n" not in str(error.value)


def test_what_is_fixed_has_no_parameter() -> None:
    mesh, maps = sphere(80, (0.0, 0.0, 0.0), 1.0, 16), random_maps(16, 0, True)
    latent = latent_of(mesh, {**maps, "displacement": np.zeros((16, 16))}, (), levels=(0, 1))
    assert latent.parameters == {} == latent.guards() == latent.laplacians(True)
    assert [p.name for p in latent.parts] == [POSITIONS, "displacement", "fixed texels"]
    fitted = latent_of(mesh, maps, ("shape", "normal"))
    assert set(fitted.parameters) == {POSITIONS, "texels"} and set(fitted.guards()) == {POSITIONS}
    texels = fitted.fitted(Texels)
    assert texels is not None and texels.channels == ("normal_x", "normal_y", "normal_z")
