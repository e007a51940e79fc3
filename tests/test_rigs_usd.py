"""Rigs of USD stages: read and posed as UsdSkel poses them, and written for it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from appearance_opt.asset import Material, load, save
from appearance_opt.asset.posing import pose, pose_positions
from appearance_opt.errors import InputError
from tests.rigs import character, unit_quaternion

Usd = pytest.importorskip("pxr.Usd")
from pxr import Gf, Sdf, UsdGeom, UsdSkel, Vt  # noqa: E402

RATE = 30.0
TIMES = (0.0, 2.5, 5.0, 7.3, 15.0)
ORDER = ["hip", "hip/spine", "hip/spine/head", "hip/leg"]
MOVED = ["hip/leg", "hip", "hip/spine"]  # in an order of its own, and without the head


def matrix(rng: np.random.Generator, size: float = 30.0) -> Any:
    x, y, z, w = unit_quaternion(rng, 0.7)
    turn = Gf.Rotation(Gf.Quatd(w, x, y, z))
    return Gf.Matrix4d(turn, Gf.Vec3d(*(rng.normal(size=3) * size)))


def triangles(stage: Any, path: str, rng: np.random.Generator, count: int = 12) -> Any:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr("none")
    points = (rng.normal(size=(3 * count, 3)) * 40).astype(np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr([3] * count)
    mesh.CreateFaceVertexIndicesAttr(list(range(3 * count)))
    return mesh


def skin(
    mesh: Any, skeleton: Any, indices: Any, weights: Any, width: int, rigid: bool = False
) -> Any:
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    for primvar, values in (
        (binding.CreateJointIndicesPrimvar(rigid, width), np.ravel(indices).tolist()),
        (binding.CreateJointWeightsPrimvar(rigid, width), np.ravel(weights).tolist()),
    ):
        primvar.Set(values)
    return binding


def stage_of(path: Path, seed: int = 0) -> Any:
    """A figure in centimetres, Z up, below a SkelRoot that moves."""
    rng = np.random.default_rng(seed)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetTimeCodesPerSecond(RATE)
    root = UsdSkel.Root.Define(stage, "/figure")
    stage.SetDefaultPrim(root.GetPrim())
    move = root.AddTranslateOp()
    for time in (0.0, 10.0, 15.0):
        move.Set(Gf.Vec3d(*(rng.normal(size=3) * 20)), time)
    skeleton = UsdSkel.Skeleton.Define(stage, "/figure/rig")
    UsdGeom.Xformable(skeleton).AddTransformOp().Set(matrix(rng))
    skeleton.CreateJointsAttr(ORDER)
    skeleton.CreateBindTransformsAttr([matrix(rng) for _ in ORDER])
    skeleton.CreateRestTransformsAttr([matrix(rng) for _ in ORDER])
    for name in ("walk", "wave"):
        animation = UsdSkel.Animation.Define(stage, f"/figure/{name}")
        animation.CreateJointsAttr(MOVED)
        for attribute, make, times in (
            (
                animation.CreateTranslationsAttr(),
                lambda: Gf.Vec3f(*(rng.normal(size=3) * 30).tolist()),
                (0.0, 7.0, 15.0),
            ),
            (animation.CreateRotationsAttr(), lambda: turn(rng), (0.0, 5.0, 10.0, 15.0)),
            (
                animation.CreateScalesAttr(),
                lambda: Gf.Vec3h(*(1 + 0.3 * rng.random(3)).tolist()),
                TIMES,  # USD interpolates them in half precision
            ),
        ):
            for time in times:
                attribute.Set([make() for _ in MOVED], time)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets(
        ["/figure/walk"]
    )
    body = triangles(stage, "/figure/body", rng)
    weights = rng.random((36, 3))
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    binding = skin(body, skeleton, rng.integers(0, 4, (36, 3)), weights, 3)
    binding.CreateGeomBindTransformAttr(matrix(rng))
    coat = triangles(stage, "/figure/coat", rng)
    binding = skin(coat, skeleton, rng.integers(0, 2, (36, 1)), np.ones(36), 1)
    binding.CreateJointsAttr(["hip/spine/head", "hip/leg"])
    sword = triangles(stage, "/figure/sword", rng)
    skin(sword, skeleton, [3], [1.0], 1, rigid=True)
    cart = triangles(stage, "/figure/cart", rng)
    cart.AddRotateXYZOp().Set(Gf.Vec3f(10, 20, 30), 0.0)
    cart.GetOrderedXformOps()[0].Set(Gf.Vec3f(80, -20, 10), 15.0)
    return stage


def turn(rng: np.random.Generator) -> Any:
    x, y, z, w = unit_quaternion(rng, float(rng.uniform(-3, 3)))
    return Gf.Quatf(w, x, y, z)


def by_usd(stage: Any, name: str, time: float) -> np.ndarray:
    """(V, 3) points of a mesh at a time code in metres, Y up, as USD poses them."""
    prim = stage.GetPrimAtPath(f"/figure/{name}")
    points = UsdGeom.Mesh(prim).GetPointsAttr().Get()
    cache, xforms = UsdSkel.Cache(), UsdGeom.XformCache(time)
    cache.Populate(UsdSkel.Root(stage.GetPrimAtPath("/figure")), Usd.PrimDefaultPredicate)
    query = cache.GetSkinningQuery(prim)
    if query and query.HasJointInfluences():
        skeleton = cache.GetSkelQuery(UsdSkel.BindingAPI(prim).GetInheritedSkeleton())
        moved = skeleton.ComputeSkinningTransforms(time)
        to_world = xforms.GetLocalToWorldTransform(skeleton.GetPrim())
        if query.IsRigidlyDeformed():
            to_world = query.ComputeSkinnedTransform(moved, time) * to_world
        else:
            assert query.ComputeSkinnedPoints(moved, points, time)
    else:
        to_world = xforms.GetLocalToWorldTransform(prim)
    p = np.array(points, np.float64) @ np.array(to_world)[:3, :3] + np.array(to_world)[3, :3]
    return p @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) * 0.01


def test_poses_are_those_of_usd(tmp_path: Path) -> None:
    stage = stage_of(tmp_path / "x.usda")
    stage.Save()
    asset = load(tmp_path / "x.usda", keep_rig=True)
    assert asset.rig.rate == RATE and [c.name for c in asset.rig.clips] == ["walk", "wave"]
    for clip in ("walk", "wave"):
        relation = UsdSkel.BindingAPI(stage.GetPrimAtPath("/figure/rig")).GetAnimationSourceRel()
        relation.SetTargets([f"/figure/{clip}"])
        for time in (0.0, 2.5, 5.0, 7.3, 15.0):
            matrices = pose(asset, clip, time / RATE)
            for mesh in asset.meshes:
                if mesh.name == "cart" and clip == "wave":
                    continue  # what prims do belongs to the clip that the stage plays
                expected = by_usd(stage, mesh.name, time)
                moved = pose_positions(mesh, matrices)
                if clip == "wave":  # so does the way of the root
                    moved = moved - moved.mean(axis=0)
                    expected = expected - expected.mean(axis=0)
                # vertices may be in another order, corners of faces are not
                height = np.ptp(expected, axis=0).max()
                error = np.abs(np.sort(moved, axis=0) - np.sort(expected, axis=0)).max()
                assert error < 1e-5 * height, (clip, time, mesh.name)


def test_influences_by_their_kind(tmp_path: Path) -> None:
    stage_of(tmp_path / "x.usda").Save()
    asset = load(tmp_path / "x.usda", keep_rig=True)
    skins = {m.name: m.skin for m in asset.meshes}
    assert skins["sword"].rigid and skins["cart"].rigid and not skins["coat"].rigid
    names = {asset.rig.nodes[n].name for n in asset.rig.bone_nodes[np.unique(skins["coat"].bones)]}
    assert names == {"head", "leg"}


def test_what_is_written_plays_the_same_in_usd(tmp_path: Path) -> None:
    """A glTF figure, written as USD, posed by UsdSkel."""
    asset = load(character(tmp_path / "x.glb"), keep_rig=True)
    save(asset, tmp_path / "figure.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "figure.usdc"))
    top = stage.GetDefaultPrim()
    assert top.IsA(UsdSkel.Root)
    assert top.GetVariantSets().GetVariantSet("clip").GetVariantNames() == ["spin_1", "walk"]
    cache, height = UsdSkel.Cache(), np.ptp(asset.bounds(), axis=0).max()
    cache.Populate(UsdSkel.Root(top), Usd.PrimDefaultPredicate)
    for prim in stage.Traverse():
        query = cache.GetSkinningQuery(prim) if prim.IsA(UsdGeom.Mesh) else None
        if not query or query.IsRigidlyDeformed():
            continue
        mesh = next(m for m in asset.meshes if str(prim.GetName()).endswith(m.name))
        skeleton = cache.GetSkelQuery(UsdSkel.BindingAPI(prim).GetInheritedSkeleton())
        for time in (0.0, 0.3, 1.4):
            points = UsdGeom.Mesh(prim).GetPointsAttr().Get()
            code = time * stage.GetTimeCodesPerSecond()
            assert query.ComputeSkinnedPoints(
                skeleton.ComputeSkinningTransforms(code), points, code
            )
            to_world = np.array(
                UsdGeom.XformCache(code).GetLocalToWorldTransform(skeleton.GetPrim())
            )
            p = np.array(points, np.float64) @ to_world[:3, :3] + to_world[3, :3]
            expected = pose_positions(mesh, pose(asset, "walk", time))
            # animated scales have half precision in USD
            assert np.abs(np.sort(p, axis=0) - np.sort(expected, axis=0)).max() < 4e-4 * height


def test_what_is_written_is_valid_usd(tmp_path: Path) -> None:
    validation = pytest.importorskip("pxr.UsdValidation")
    save(load(character(tmp_path / "x.glb"), keep_rig=True), tmp_path / "figure.usdc")
    registry = validation.ValidationRegistry()
    context = validation.ValidationContext(registry.GetOrLoadAllValidators())
    found = context.Validate(Usd.Stage.Open(str(tmp_path / "figure.usdc")))
    assert not [e.GetName() for e in found]


def change(path: Path, edit: Any) -> Path:
    stage = stage_of(path)
    edit(stage)
    stage.Save()
    return path


def edit_attribute(prim: str, name: str, value: Any) -> Any:
    return lambda stage: stage.GetPrimAtPath(prim).GetAttribute(name).Set(value)


def no_keys(stage: Any) -> None:
    for name in ("translations", "rotations", "scales"):
        stage.GetPrimAtPath("/figure/walk").GetAttribute(name).Clear()


def no_animation(stage: Any) -> None:
    stage.RemovePrim("/figure/walk")
    stage.OverridePrim("/figure/walk").GetReferences().AddReference("./motion.usda")


BAD = {
    "a joint that is not there": (
        edit_attribute("/figure/body", "primvars:skel:jointIndices", [9] * 108),
        "do not exist",
    ),
    "no bind transforms": (
        edit_attribute("/figure/rig", "bindTransforms", []),
        "0 bind transforms for 4 joints|UsdSkel cannot use it",
    ),
    "a singular bind transform": (
        edit_attribute("/figure/rig", "bindTransforms", [Gf.Matrix4d(0)] * 4),
        "singular",
    ),
    "no keys": (no_keys, "no keys"),
    "an animation that is missing": (no_animation, "'motion.usda' is missing|motion.usda"),
    "joints of the mesh that the skeleton lacks": (
        edit_attribute("/figure/coat", "skel:joints", ["hip/tail", "hip/leg"]),
        "'hip/tail' is not in the skeleton",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_rigs_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    edit, word = BAD[name]
    path = change(tmp_path / "x.usda", edit)
    with pytest.raises(InputError, match=word) as caught:
        load(path, keep_rig=True)
    assert "\n" not in str(caught.value) and "structure is broken" not in str(caught.value)
    assert load(path).meshes  # the static commands need none of it


def test_dual_quaternions_are_approximated_with_a_note(tmp_path: Path) -> None:
    path = tmp_path / "x.usda"

    def edit(stage: Any) -> None:
        binding = UsdSkel.BindingAPI(stage.GetPrimAtPath("/figure/body"))
        binding.CreateSkinningMethodAttr(UsdSkel.Tokens.dualQuaternion)

    asset = load(change(path, edit), keep_rig=True)
    assert any("dualQuaternion" in n and "linear blending" in n for n in asset.notes)


def test_a_refined_surface_keeps_its_skin(tmp_path: Path) -> None:
    def edit(stage: Any) -> None:
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/figure/body"))
        mesh.GetSubdivisionSchemeAttr().Set("catmullClark")

    asset = load(change(tmp_path / "x.usda", edit), keep_rig=True)
    body = next(m for m in asset.meshes if m.name == "body")
    assert len(body.skin.bones) == len(body.positions) > 36
    np.testing.assert_allclose(body.skin.weights.sum(axis=1), 1, atol=1e-6)


def test_blend_shapes_are_named(tmp_path: Path) -> None:
    def edit(stage: Any) -> None:
        shape = UsdSkel.BlendShape.Define(stage, "/figure/body/smile")
        shape.CreateOffsetsAttr([Gf.Vec3f(0)] * 36)
        binding = UsdSkel.BindingAPI(stage.GetPrimAtPath("/figure/body"))
        binding.CreateBlendShapesAttr(["smile"])
        binding.CreateBlendShapeTargetsRel().SetTargets([Sdf.Path("/figure/body/smile")])

    asset = load(change(tmp_path / "x.usda", edit), keep_rig=True)
    assert asset.contents.morph_targets == ("smile",)
    assert any("'smile'" in n for n in asset.notes)


@pytest.mark.parametrize("file", ["human/human.usdc", "fox/Fox.glb"])
def test_real_characters_survive(tmp_path: Path, assets_dir: Path, file: str) -> None:
    asset = load(assets_dir / file, keep_rig=True)
    asset = replace(asset, meshes=tuple(replace(m, material=Material()) for m in asset.meshes))
    save(asset, tmp_path / f"y{Path(file).suffix}")
    again = load(tmp_path / f"y{Path(file).suffix}", keep_rig=True)
    assert [c.name for c in again.rig.clips] == [c.name for c in asset.rig.clips]
    clip = asset.rig.clips[-1]
    for time in (clip.start, clip.start + 0.4 * clip.duration):
        p, q = (
            np.concatenate([pose_positions(m, pose(x, clip.name, time))[m.faces] for m in x.meshes])
            for x in (asset, again)
        )
        p, q = p.mean(axis=1), q.mean(axis=1)
        assert np.abs(p - q).max() < 1e-5 * np.ptp(p, axis=0).max()
