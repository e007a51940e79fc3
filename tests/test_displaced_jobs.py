"""Jobs with a displacement map: options, memory, files, several levels, the joint bake."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from appearance_opt import memory
from appearance_opt.asset import load, save
from appearance_opt.asset.height import heights_of
from appearance_opt.asset.types import Asset, Displacement, Texture
from appearance_opt.asset.validate import validate
from appearance_opt.baking.target_mesh import movable, prepare
from appearance_opt.config import bake_options, joint_options, simplify_options
from appearance_opt.errors import InputError
from appearance_opt.initial.sphere import sphere
from appearance_opt.jobs.compare import compare
from appearance_opt.jobs.joint import joint
from appearance_opt.jobs.result import SimplifyResult
from appearance_opt.jobs.simplify import simplify
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.displacement import DISPLACEMENT, Tessellator, footprint
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.positions import POSITIONS
from appearance_opt.latent.subdivision import tessellate
from appearance_opt.latent.texels import TEXELS, TexelCodec
from appearance_opt.optimize.loop import FitRun
from appearance_opt.optimize.plan import FitOptions, pose_of
from appearance_opt.optimize.validation import Validation
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.pool import ReferencePool
from appearance_opt.reference.survey import MeshSurvey
from appearance_opt.stages.displacement import (
    REACH,
    bake_displacement,
    map_size,
    median_edge,
    without_outliers,
)
from appearance_opt.stages.export import write_companion
from appearance_opt.views import ViewSampler
from scenes.analytic import bumps, bumpy_sphere
from tests.kernels import BLOCK, settles

QUICK = {"texture_size": 128, "resolution": 48, "pool": 8, "views": 2, "steps": 3}


def options(**values: object):
    return simplify_options(**{"triangles": 200, "displacement": True, **QUICK, **values})


@pytest.fixture(scope="module")
def bumpy() -> Asset:
    return bumpy_sphere(6_000)


@pytest.fixture(scope="module")
def relief(bumpy: Asset) -> SimplifyResult:
    """A start with a displacement map."""
    return simplify(bumpy, None, options(steps=0))


@pytest.fixture(scope="module")
def flat(bumpy: Asset) -> SimplifyResult:
    """A start of as many triangles without one."""
    return simplify(bumpy, None, simplify_options(triangles=200, **{**QUICK, "steps": 0}))


def test_levels_are_read_in_every_way_and_checked() -> None:
    assert options().levels() == (3,)
    assert options(subdivision="3,1,2,1").levels() == (1, 2, 3)
    assert options(subdivision=0).levels() == (0,)
    assert simplify_options(triangles=9).levels() == (0,)
    with pytest.raises(InputError, match="--subdivision 5: must be from 0 to 4"):
        options(subdivision="2,5")
    with pytest.raises(InputError, match="one level or several"):
        options(subdivision="fine")
    with pytest.raises(InputError, match="together with --displacement"):
        simplify_options(triangles=9, subdivision=2)
    with pytest.raises(InputError, match="an option of simplify, joint"):
        bake_options(subdivision=2)
    with pytest.raises(InputError, match="LOW keeps its shape"):
        bake_options(fit="shape")


def test_the_level_of_an_iteration_can_be_replayed() -> None:
    drawn = [pose_of((1, 2, 3), 5, k) for k in range(300)]
    assert drawn == [pose_of((1, 2, 3), 5, k) for k in range(300)]
    assert min(np.bincount(drawn)[1:]) > 70  # each in about a third of the steps
    assert {pose_of((2,), 5, k) for k in range(9)} == {2}


def test_too_much_is_refused_with_the_number(bumpy: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_memory", lambda: 1 << 30)
    message = r"5000 triangles become 1280000, which takes about \d\.\d GiB, and 1\.0 GiB are free"
    with pytest.raises(InputError, match=message) as error:
        simplify(bumpy, None, options(triangles=5000, subdivision=4))
    assert "\n" not in str(error.value)


def test_free_memory_is_known() -> None:
    free = memory.available_memory()
    assert free is not None and 2**20 < free < 2**50


def test_the_map_is_as_fine_as_the_mesh(relief: SimplifyResult) -> None:
    mesh = movable(prepare(relief.asset).mesh)
    size = map_size(mesh, options(texture_size=1024))
    texels = size * np.sqrt(np.median(footprint(tessellate(mesh, 3).mesh)))
    assert 1 <= texels < 2  # texels per half edge of the finest mesh
    assert map_size(mesh, options(texture_size=32)) == 32


def test_rays_that_meet_another_part_leave_no_spikes() -> None:
    """A ball with a hole, inside a larger one: through the hole, rays meet the outer one."""
    inner, outer = bumpy_sphere(20_000).meshes[0], bumpy_sphere(20_000).meshes[0]
    hole = inner.positions[inner.faces].mean(axis=1)[:, 1] > 0.85 * inner.positions[:, 1].max()
    holed = replace(inner, faces=inner.faces[~hole])
    shell = replace(outer, positions=outer.positions * np.float32(1.15))
    survey = MeshSurvey(MeshReference(Asset((holed, shell))))
    radius = float(np.linalg.norm(inner.positions, axis=1).mean())
    mesh, o = sphere(1200, (0.0, 0.0, 0.0), radius, 128), options(subdivision=1)
    far = bake_displacement(survey, mesh, o)[1][DISPLACEMENT]
    near = bake_displacement(survey, mesh, o, REACH * median_edge(mesh))[1][DISPLACEMENT]
    assert far.max() > 0.1 * radius  # it is there to be met
    assert np.abs(near).max() < REACH * median_edge(mesh) < 0.1 * radius


def test_lone_heights_give_way_and_walls_stay() -> None:
    heights = np.zeros((32, 32), np.float32)
    heights[:, 16:] = 1.0  # a wall
    heights[:, :16] += np.linspace(0, 0.2, 16, dtype=np.float32)  # a slope
    spiked = heights.copy()
    spiked[5, 5] = spiked[20, 25] = -3.0
    spiked[10:12, 8] = 2.0
    clean = without_outliers(spiked, 0.1)
    np.testing.assert_allclose(clean, heights, atol=0.1)
    np.testing.assert_array_equal(clean[heights == spiked], heights[heights == spiked])


def test_files_of_a_displaced_result(bumpy: Asset, tmp_path: Path) -> None:
    out = tmp_path / "low.glb"
    o = options(subdivision="1,2", write_tessellated=True)
    result = simplify(bumpy, out, o, report=tmp_path / "report")
    assert {p.name for p in tmp_path.iterdir()} == {
        "low.glb",
        "low_base.glb",
        "low_base_displacement.png",
        "low_level1.glb",
        "low_level2.glb",
        "report",
    }
    # what a viewer opens looks right as it is
    assert load(out).triangle_count == load(tmp_path / "low_level2.glb").triangle_count
    assert any("low_base.glb is its base mesh" in note for note in result.notes)
    base = load(tmp_path / "low_base.glb")
    psnr = [
        compare(bumpy, asset, views=2, resolution=64, samples=4).metrics.psnr_covered
        for asset in (load(out), result.shown, base)
    ]
    assert abs(psnr[0] - psnr[1]) < 0.2 and psnr[0] > psnr[2] + 1
    levels = {k: load(tmp_path / f"low_level{k}.glb") for k in (1, 2)}
    assert base.triangle_count == result.triangles <= 200
    for level, asset in levels.items():
        assert asset.triangle_count == base.triangle_count * 4**level
        assert validate(asset).boundary_edges == 0  # closed although its charts are split
    metrics = json.loads((tmp_path / "report" / "report.json").read_text())["metrics"]
    assert set(metrics) == {"start", "level 1", "level 2"}

    # who has the base mesh and the 16-bit map alone gets the same mesh
    given = result.asset.meshes[0].material.displacement
    assert given is not None
    pixels = _png(tmp_path / "low_base_displacement.png")
    heights = heights_of(Displacement(Texture(pixels, "linear"), given.scale, given.mid))
    mesh = movable(prepare(base).mesh)
    codec = TexelCodec((DISPLACEMENT,), len(heights))
    layer = codec.layer(codec.encode({DISPLACEMENT: heights}))
    again = np.array(Tessellator(mesh, 2)(mi.Float(mesh.positions.ravel()), layer)).reshape(-1, 3)
    theirs = levels[2].meshes[0].positions
    distance = np.array([np.linalg.norm(theirs - p, axis=1).min() for p in again])
    # rounding of 16 bits: half of scale / 65535; measured 0.6 of it in the mean of a lookup
    assert distance.max() < given.scale / 65535 + 1e-6
    assert np.abs(heights).max() > 100 * given.scale / 65535


def _png(path: Path) -> np.ndarray:
    from appearance_opt.asset.images import read

    pixels = read(path)
    assert pixels.dtype == np.uint16
    return pixels


def test_displacement_in_usd_and_obj(relief: SimplifyResult, tmp_path: Path) -> None:
    from pxr import Usd, UsdShade

    save(relief.asset, tmp_path / "low.usda")
    stage = Usd.Stage.Open(str(tmp_path / "low.usda"))
    materials = [UsdShade.Material(p) for p in stage.Traverse() if p.IsA(UsdShade.Material)]
    assert materials[0].GetDisplacementOutput().HasConnectedSource()
    write_companion(relief.asset, tmp_path / "low.obj")
    assert _png(tmp_path / "low_displacement.png").shape[2] == 1


def test_what_is_not_there_has_no_parameter(bumpy: Asset, flat: SimplifyResult) -> None:
    result = simplify(bumpy, None, options(steps=0, normal_map=False))
    assert result.asset.meshes[0].material.normal_texture is None
    assert result.asset.meshes[0].material.displacement is not None
    assert flat.asset.meshes[0].material.displacement is None and not flat.tessellated
    mesh = movable(prepare(result.asset).mesh)
    level = np.zeros((16, 16), np.float32)
    maps = {"red": level, "displacement": level}
    assert set(latent_of(mesh, maps, frozenset({"displacement"}), Rates(), (1,)).parameters) == {
        DISPLACEMENT
    }
    assert set(
        latent_of(mesh, maps, frozenset({"shape", "material"}), Rates(), (1,)).parameters
    ) == {
        POSITIONS,
        TEXELS,
    }


def test_the_closed_form_start_wins_back_the_bumps(
    flat: SimplifyResult, relief: SimplifyResult
) -> None:
    """Bumps that 200 triangles cannot have: distance of the drawn faces from the true surface,
    along the radius."""
    error = [_radial_error(flat.asset), _radial_error(relief.shown)]
    assert error[1] < error[0] / 4, error


def _radial_error(asset: Asset) -> float:
    mesh = asset.meshes[0]
    centre = mesh.positions[mesh.faces].mean(axis=1)
    radius = np.linalg.norm(centre, axis=1)
    return float(np.mean(np.abs(radius - bumps(centre / radius[:, None]))))


def test_a_file_to_start_from_brings_its_triangles(
    bumpy: Asset, flat: SimplifyResult, tmp_path: Path
) -> None:
    save(flat.asset, tmp_path / "bad.glb")
    o = simplify_options(init=str(tmp_path / "bad.glb"), displacement=True, subdivision=1, **QUICK)
    result = simplify(bumpy, tmp_path / "x.glb", o)
    assert result.triangles == load(tmp_path / "bad.glb").triangle_count
    assert result.shown.triangle_count == 4 * result.triangles


def test_changing_levels_compiles_nothing_after_the_first_steps(bumpy: Asset) -> None:
    reference = MeshReference(bumpy)
    sampler = ViewSampler((0.0, 0.0, 0.0), 1.4, seed=1)
    level = np.zeros((32, 32), np.float32)
    maps = {"red": level + 0.5, "green": level + 0.5, "blue": level + 0.5, DISPLACEMENT: level}
    mesh = sphere(150, (0.0, 0.0, 0.0), 1.0, 32)
    model = latent_of(mesh, maps, frozenset({"shape", "material", DISPLACEMENT}), Rates(), (1, 2))
    validation = Validation(reference, sampler.held_out(1).draw(0, 2), 32)
    fit_options = FitOptions(steps=1000)
    run = FitRun(model, ReferencePool(reference, sampler, 8, 2, 32, 4), validation, fit_options)
    assert settles(run)
    levels = {
        pose_of(model.poses, fit_options.seed, run.state.iteration - k).level
        for k in range(1, BLOCK + 1)
    }
    assert levels == {1, 2}  # the clean steps changed levels


def test_joint_bake_keeps_topology_and_texture_coordinates(
    bumpy: Asset, flat: SimplifyResult, tmp_path: Path
) -> None:
    save(flat.asset, tmp_path / "low.glb")
    o = joint_options(subdivision="2", samples=1, **QUICK)
    result = joint(bumpy, tmp_path / "low.glb", tmp_path / "out.usda", o)
    before, after = load(tmp_path / "low.glb").meshes[0], result.asset.meshes[0]
    assert len(after.faces) == len(before.faces) == flat.triangles
    np.testing.assert_array_equal(after.uvs[after.faces], before.uvs[before.faces])
    moved = np.linalg.norm(after.positions[after.faces] - before.positions[before.faces], axis=-1)
    assert 0 < moved.max() < 0.05  # a few steps
    assert result.shown.triangle_count == 16 * flat.triangles
    assert (tmp_path / "out.usda").is_file() and after.material.displacement is not None
