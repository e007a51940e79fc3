"""What is written as USD: points welded by position, face-varying attributes; what is read back is
the same."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from appearance_opt.asset import load, save, usd_write
from appearance_opt.asset.height import displacement_of
from appearance_opt.asset.types import Asset, Material, Mesh
from tests.conftest import grid_sphere

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
SIDES = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)
OUTWARD = np.array(
    [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], np.float32
)


def box() -> Mesh:
    """A cube with hard edges: 24 vertices at 8 places, each side with texture coordinates of its
    own."""
    faces = np.array(
        [[4 * k, 4 * k + i, 4 * k + i + 1] for k in range(6) for i in (1, 2)], np.int32
    )
    square = np.array([[0, 0], [0, 1], [1, 1], [1, 0]], np.float32)
    uvs = np.concatenate([(square + (k % 3, k // 3)) / 4 for k in range(6)]).astype(np.float32)
    return Mesh(CORNERS[SIDES.ravel()], faces, np.repeat(OUTWARD, 4, axis=0), uvs)


def sphere() -> Mesh:
    """A smooth ball with a seam in its texture coordinates."""
    positions, faces, uvs = grid_sphere(8, 12)
    ends = positions[faces]
    faces = faces[
        np.linalg.norm(np.cross(ends[:, 1] - ends[:, 0], ends[:, 2] - ends[:, 0]), axis=1) > 1e-6
    ]
    used, corners = np.unique(faces, return_inverse=True)
    p = positions[used].astype(np.float32)
    _, first, place = np.unique(np.round(p, 5), axis=0, return_index=True, return_inverse=True)
    p = p[first[place.ravel()]]  # the two ends of the seam meet exactly
    return Mesh(p, corners.reshape(-1, 3).astype(np.int32), p, uvs[used].astype(np.float32))


@dataclass(frozen=True)
class Primvar:
    interpolation: str
    stored: int
    flat: int
    indexed: bool


@dataclass(frozen=True)
class Written:
    """A mesh as it is in a file: points (P, 3), the point of each corner, primvars by name."""

    points: np.ndarray
    corners: np.ndarray
    primvars: dict[str, Primvar]


def written(path: Path) -> list[Written]:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    found = []
    for prim in (UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)):
        primvars = {
            p.GetPrimvarName(): Primvar(
                p.GetInterpolation(), len(p.Get()), len(p.ComputeFlattened()), p.IsIndexed()
            )
            for p in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithAuthoredValues()
        }
        arrays = (
            np.array(a.Get()) for a in (prim.GetPointsAttr(), prim.GetFaceVertexIndicesAttr())
        )
        found.append(Written(*arrays, primvars))
    return found


def assert_valid(path: Path) -> None:
    """Nothing that OpenUSD's own validators find fault with."""
    usd, validation = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdValidation")
    context = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
    stage = usd.Stage.Open(str(path))
    assert not [e.GetMessage() for e in context.Validate(stage)]


def assert_same_corners(got: Mesh, expected: Mesh) -> None:
    """The same triangles in the same order, whatever the order of their vertices."""
    for name in ("positions", "normals", "uvs", "colors"):
        values = getattr(expected, name)
        if values is None:
            assert getattr(got, name) is None
        else:
            np.testing.assert_allclose(
                getattr(got, name)[got.faces], values[expected.faces], atol=1e-6
            )


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
@pytest.mark.parametrize(("make", "places"), [(box, 8), (sphere, 2 + 7 * 12)])
def test_points_are_welded_and_what_differs_at_corners_stays(
    tmp_path: Path, suffix: str, make: Any, places: int
) -> None:
    mesh, path = make(), tmp_path / f"x{suffix}"
    save(Asset((mesh,)), path)
    again = load(path).meshes[0]
    assert_same_corners(again, mesh)
    assert len(again.positions) == len(mesh.positions)  # split at seams, and nowhere else
    (file,) = written(path)
    corners = file.corners
    assert len(file.points) == places
    assert_valid(path)
    np.testing.assert_array_equal(file.points[corners], mesh.positions[mesh.faces.ravel()])
    edges = np.sort(
        np.stack([corners, np.roll(corners.reshape(-1, 3), -1, axis=1).ravel()], axis=1), axis=1
    )
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # closed, as the surface is


def test_each_attribute_is_face_varying_with_indices_where_that_is_smaller(tmp_path: Path) -> None:
    mesh = box()
    loose = Mesh(mesh.positions[mesh.faces.ravel()], np.arange(36, dtype=np.int32).reshape(12, 3))
    rng = np.random.default_rng(0)
    loose = replace(
        loose, uvs=rng.random((36, 2)).astype(np.float32), normals=np.repeat(OUTWARD, 6, axis=0)
    )
    save(Asset((mesh, loose)), tmp_path / "x.usda")
    shared, own = (m.primvars for m in written(tmp_path / "x.usda"))
    assert shared == {
        "normals": Primvar("faceVarying", 6, 36, True),
        "st": Primvar("faceVarying", 12, 36, True),
    }
    assert own == {
        "normals": Primvar("faceVarying", 6, 36, True),
        "st": Primvar("faceVarying", 36, 36, False),
    }
    for got, expected in zip(load(tmp_path / "x.usda").meshes, (mesh, loose), strict=True):
        assert_same_corners(got, expected)


def test_vertex_colours_and_their_alpha_belong_to_corners(tmp_path: Path) -> None:
    """Two triangles that meet in an edge, of different colours there."""
    positions = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32
    )
    colors = np.array([[1, 0, 0, 0.5]] * 3 + [[0, 0, 1, 0.25]] * 3, np.float32)
    up = np.tile(np.float32([0, 0, 1]), (6, 1))
    faces, glass = np.arange(6, dtype=np.int32).reshape(2, 3), Material(alpha_mode="blend")
    mesh = Mesh(positions, faces, up, colors=colors, material=glass)
    save(Asset((mesh,)), tmp_path / "x.usda")
    assert len(written(tmp_path / "x.usda")[0].points) == 4
    assert_same_corners(load(tmp_path / "x.usda").meshes[0], mesh)


def test_both_zeros_are_one_place(tmp_path: Path) -> None:
    positions = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, -0.0, 0], [0, 1, -0.0], [-1, 0, 0]], np.float32
    )
    mesh = Mesh(
        positions,
        np.arange(6, dtype=np.int32).reshape(2, 3),
        np.tile(np.float32([0, 0, 1]), (6, 1)),
    )
    save(Asset((mesh,)), tmp_path / "x.usdc")
    assert len(written(tmp_path / "x.usdc")[0].points) == 4


def test_parts_of_two_kinds_displaced_and_in_groups(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Many meshes, single- and double-sided ones in turn, all with a displacement map."""
    monkeypatch.setattr(usd_write, "SIBLINGS", 3)
    ramp = np.linspace(-0.1, 0.1, 16, dtype=np.float32).reshape(4, 4)
    material = Material(displacement=displacement_of(ramp))
    kinds = [replace(material, double_sided=k % 2 == 0) for k in range(2)]
    shapes = [box(), sphere()]
    meshes = [
        replace(
            shapes[k // 2 % 2],
            positions=shapes[k // 2 % 2].positions + np.float32(4 * k),
            material=kinds[k % 2],
        )
        for k in range(8)
    ]
    save(Asset(tuple(meshes)), tmp_path / "x.usdc")
    again = load(tmp_path / "x.usdc").meshes
    assert len(again) == 8
    for got, expected in zip(again, meshes, strict=True):
        assert_same_corners(got, expected)
        assert got.material.double_sided is expected.material.double_sided
    assert sum(len(m.points) for m in written(tmp_path / "x.usdc")) == 4 * (8 + 86)
