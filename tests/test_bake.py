"""Baking: known answers, what LOW keeps, what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from appearance_opt.asset import load, save
from appearance_opt.asset.images import read
from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.baking import texel_points
from appearance_opt.baking.align import align
from appearance_opt.baking.check import overlap
from appearance_opt.baking.closed_form import BakedMaps, Settings
from appearance_opt.baking.closed_form import bake as closed_form
from appearance_opt.baking.target_mesh import prepare, unwrap_asset
from appearance_opt.baking.texel_points import TexelPoints
from appearance_opt.config import BakeOptions, bake_options, read_toml, with_values
from appearance_opt.errors import InputError
from appearance_opt.evaluate.metrics import compare_images
from appearance_opt.initial.sphere import sphere
from appearance_opt.jobs.bake import bake
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.latent.parameter import Rates
from appearance_opt.reference.curvature import mean_curvature
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.survey import MeshSurvey
from appearance_opt.render.images import render_image
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.views import ViewSampler
from scenes.analytic import sphere_mesh
from tests.drawing import drawn_of
from tests.test_cli import run

SIZE = 64
CLOSED = bake_options(closed_form=True, texture_size=SIZE, samples=1)


def asset_of(mesh: LatentMesh, name: str = "low") -> Asset:
    """A latent as an asset without material."""
    return Asset(
        (Mesh(mesh.positions[mesh.frame_vertex], mesh.frame_faces, uvs=mesh.uvs, name=name),), name
    )


@pytest.fixture(scope="module")
def low_sphere() -> Asset:
    """300 triangles inscribed in the unit sphere, with an atlas."""
    return asset_of(sphere(300, (0.0, 0.0, 0.0), 1.0, SIZE))


def square(
    z: float = 0.0, half: float = 1.0, normal: tuple[float, float, float] = (0, 0, 1), n: int = 1
) -> Mesh:
    """[-half, half]^2 facing +Z, n x n quads; u grows with x, v against y."""
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1)))
    p = np.stack([half * (2 * u - 1), half * (1 - 2 * v), np.full_like(u, z)], axis=1).astype(
        np.float32
    )
    i = np.arange((n + 1) * n).reshape(n, n + 1)[:, :-1].ravel()
    f = np.concatenate(
        [np.stack([i, i + n + 1, i + 1], 1), np.stack([i + 1, i + n + 1, i + n + 2], 1)]
    )
    normals = np.tile(np.asarray(normal, np.float32) / np.linalg.norm(normal), (len(p), 1)).astype(
        np.float32
    )
    return Mesh(
        p, f.astype(np.int32), normals, np.stack([u, v], 1).astype(np.float32), name="square"
    )


def cube() -> Mesh:
    """A cube with hard edges and one square of the atlas per face."""
    p, n, uv, f = [], [], [], []
    for k, (axis, sign) in enumerate((a, s) for a in range(3) for s in (1, -1)):
        normal = np.zeros(3)
        normal[axis] = sign
        a = np.roll(np.abs(normal), 1)
        b = np.cross(normal, a)
        f += [[4 * k, 4 * k + 1, 4 * k + 2], [4 * k, 4 * k + 2, 4 * k + 3]]
        for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            p.append(0.5 * (normal + x * a + y * b))
            n.append(normal)
            uv.append([(k % 3 + 0.5 + 0.4 * x) / 3, (k // 3 + 0.5 - 0.4 * y) / 2])
    arrays = (np.array(v, np.float32) for v in (p, n, uv))
    positions, normals, uvs = arrays
    return Mesh(positions, np.array(f, np.int32), normals, uvs, name="cube")


def baked_pair(high: Asset, low: Asset, *fields: str, **settings) -> tuple[BakedMaps, LatentMesh]:
    mesh = prepare(low).mesh
    return closed_form(
        MeshSurvey(MeshReference(high)), mesh, Settings(SIZE, fields, **settings)
    ), mesh


def texel_rays(mesh: LatentMesh) -> tuple[np.ndarray, ...]:
    """(texel, position, direction, normal, tangent, handedness) of the centres of all texels."""
    with dr.suspend_grad():
        found = TexelPoints(mesh, SIZE).band(0, 0.5, 0.5)
    assert found is not None and found.here.tangent is not None
    here = found.here
    vectors = (np.array(v).T for v in (here.position, found.along, here.normal, here.tangent))
    return np.array(found.texel), *vectors, np.array(here.handedness)


def test_a_sphere_over_a_coarse_one_has_known_normals_and_heights(low_sphere: Asset) -> None:
    high = Asset((sphere_mesh(40_000, Material("white")),), "high")
    baked, mesh = baked_pair(high, low_sphere, "normal", "object-normal", "displacement")
    assert baked.missed.sum() == 0
    texel, p, along, n, t, hand = texel_rays(mesh)
    b = np.sum(p * along, axis=1)
    height = -b + np.sqrt(b * b - np.sum(p * p, axis=1) + 1)
    maps = {k: v.ravel()[texel] for k, v in baked.maps.items()}
    # the high sphere's own facets lie up to 1.4e-4 below the sphere (measured 1.4e-4)
    np.testing.assert_allclose(maps["displacement"], height, atol=3e-4)
    assert height.max() > 0.01
    expected = p + height[:, None] * along
    found = np.stack([maps[f"object_{a}"] for a in "xyz"], axis=1)
    # measured 0.03 degrees
    assert np.degrees(np.arccos(np.clip(np.sum(found * expected, axis=1), -1, 1))).max() < 0.1
    bitangent = np.cross(n, t) * hand[:, None]
    shaded = sum(
        maps[f"normal_{a}"][:, None] * v for a, v in zip("xyz", (t, bitangent, n), strict=True)
    )
    shaded /= np.linalg.norm(shaded, axis=1, keepdims=True)
    # the same normal through the shader's tangent basis: only float32 in between (measured 0.04
    # degrees)
    assert np.degrees(np.arccos(np.clip(np.sum(shaded * expected, axis=1), -1, 1))).max() < 0.1


def test_tilts_have_the_sign_that_engines_expect(tmp_path: Path) -> None:
    low = Asset((square(),), "low")
    tilt = np.array([0.3, 0.2, 1.0]) / np.linalg.norm([0.3, 0.2, 1.0])
    high = Asset((square(normal=tuple(tilt), n=4),), "high")
    files = {}
    for green in ("opengl", "directx"):
        options = with_values(CLOSED, maps=("normal",), green=green)
        bake(high, low, tmp_path / f"{green}.glb", options, loose=tmp_path / green)
        files[green] = read(tmp_path / green / f"{green}_normal.png")
    gl, dx = files["opengl"].astype(int), files["directx"].astype(int)
    # +X is towards growing u, +Y (up in the picture) is against growing v; 8 bits: half a step
    np.testing.assert_allclose(gl[20, 30] / 255 * 2 - 1, tilt, atol=1 / 255 + 1e-6)
    assert np.abs(gl[..., 1] + dx[..., 1] - 255).max() <= 1
    np.testing.assert_array_equal(gl[..., [0, 2]], dx[..., [0, 2]])
    # the file itself holds what its format asks for
    for name in ("opengl", "directx"):
        stored = load(tmp_path / f"{name}.glb").meshes[0].material.normal_texture
        np.testing.assert_array_equal(stored.pixels[..., :3], files["opengl"])
    assert (
        json.loads((tmp_path / "directx" / "directx_maps.json").read_text())["maps"]["normal"][
            "green"
        ]
        == "directx"
    )


@pytest.mark.parametrize(("radius", "height"), [(0.5, 0.5), (0.3, 0.6)])
def test_occlusion_under_a_disc(radius: float, height: float) -> None:
    ring = np.linspace(0, 2 * np.pi, 129)[:-1]
    rim = np.stack([radius * np.cos(ring), radius * np.sin(ring), np.full_like(ring, height)], 1)
    p = np.concatenate([rim, [[0, 0, height]]]).astype(np.float32)
    f = np.stack([np.roll(np.arange(128), -1), np.arange(128), np.full(128, 128)], 1).astype(
        np.int32
    )
    high = Asset((square(n=2), Mesh(p, f, name="disc")), "high")
    baked, _ = baked_pair(high, Asset((square(),), "low"), "ao", ao_rays=1024, reach=0.1)
    middle = baked.maps["occlusion"][
        SIZE // 2 - 1 : SIZE // 2 + 1, SIZE // 2 - 1 : SIZE // 2 + 1
    ].mean()
    # cosine-weighted form factor of a disc seen from below its centre; measured within 0.002
    assert middle == pytest.approx(1 - radius**2 / (radius**2 + height**2), abs=0.005)
    near, _ = baked_pair(
        high, Asset((square(),), "low"), "ao", ao_rays=16, reach=0.1, ao_distance=0.9 * height
    )
    assert near.maps["occlusion"].min() == 1


def test_curvature_of_spheres_and_a_cube() -> None:
    ball = sphere_mesh(5_000, Material("white"), 0.5)
    # discretisation: measured 2.0005 to 2.0026
    np.testing.assert_allclose(mean_curvature(ball.positions, ball.faces), 2.0, rtol=0.003)
    np.testing.assert_allclose(
        mean_curvature(ball.positions, ball.faces[:, ::-1]), -2.0, rtol=0.003
    )
    flat = square(n=4)
    np.testing.assert_array_equal(mean_curvature(flat.positions, flat.faces), 0)
    box = cube()
    # half of three edges of length 1 at a right angle, over an eighth of the surface
    expected = 3 * 0.5 * (np.pi / 2) * 0.5 / (6 / 8)
    np.testing.assert_allclose(mean_curvature(box.positions, box.faces), expected, rtol=1e-6)
    baked, _ = baked_pair(
        Asset((ball,), "b"), asset_of(sphere(300, (0, 0, 0), 0.5, SIZE)), "curvature"
    )
    np.testing.assert_allclose(baked.maps["curvature"], 2.0, rtol=0.003)


def test_hard_edges_keep_their_normals_and_leave_no_gap() -> None:
    low = Asset((cube(),), "low")
    baked, mesh = baked_pair(low, low, "normal", "displacement")
    assert baked.missed.sum() == 0
    flat = np.stack([baked.maps[f"normal_{a}"] for a in "xyz"], axis=-1)
    # the faces' own normals in their own bases: nothing to correct (measured 2e-7)
    np.testing.assert_allclose(flat, np.broadcast_to([0, 0, 1], flat.shape), atol=1e-5)
    _, _, along, normal, _, _ = texel_rays(mesh)
    assert np.sum(along * normal, axis=1).min() < 0.7  # rays fan out towards the corners


def test_low_is_kept_to_the_last_bit(tmp_path: Path, low_sphere: Asset) -> None:
    box = cube()
    moved = replace(box, positions=box.positions + np.float32(3.1), uvs=box.uvs * 0.5)
    ball = low_sphere.meshes[0]
    low = Asset((replace(ball, uvs=ball.uvs * 0.5 + 0.5), moved), "low")
    save(low, tmp_path / "low.glb")
    bake(low, tmp_path / "low.glb", tmp_path / "out.glb", CLOSED)
    before, after = load(tmp_path / "low.glb", keep_layout=True), load(tmp_path / "out.glb")
    assert len(before.meshes) == len(after.meshes) == 2
    for a, b in zip(before.meshes, after.meshes, strict=True):
        np.testing.assert_array_equal(a.positions.view(np.uint32), b.positions.view(np.uint32))
        np.testing.assert_array_equal(a.faces, b.faces)
        np.testing.assert_array_equal(a.uvs.view(np.uint32), b.uvs.view(np.uint32))
        assert b.material.normal_texture is not None and b.tangents is not None
    np.testing.assert_array_equal(before.meshes[1].normals, after.meshes[1].normals)


def test_maps_that_are_not_asked_for_stay(tmp_path: Path, ball: Asset) -> None:
    pixels = np.full((4, 4, 3), 200, np.uint8)
    material = Material("own", roughness=0.25, base_color_texture=Texture(pixels, "srgb"))
    low = replace(ball, meshes=(replace(ball.meshes[0], material=material),))
    result = bake(ball, low, None, with_values(CLOSED, maps=("normal",))).asset.meshes[0].material
    assert result.base_color_texture is material.base_color_texture and result.roughness == 0.25
    assert result.orm_texture is None and result.normal_texture is not None


def test_bands_and_one_piece_agree(
    ball: Asset, low_sphere: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, _ = baked_pair(ball, low_sphere, "material", "ao", samples=2, ao_rays=4)
    monkeypatch.setattr(texel_points, "BAND", SIZE * 24)  # 24 does not divide 64
    banded, _ = baked_pair(ball, low_sphere, "material", "ao", samples=2, ao_rays=4)
    np.testing.assert_array_equal(whole.covered, banded.covered)
    for name in ("red", "roughness"):
        # float32 in another order (measured 6e-8)
        np.testing.assert_allclose(whole.maps[name], banded.maps[name], atol=1e-6)
    # other random shifts of the rays (measured 0.002)
    assert whole.maps["occlusion"].mean() == pytest.approx(
        banded.maps["occlusion"].mean(), abs=0.01
    )


def test_a_latent_with_its_own_normals_is_drawn_as_the_asset() -> None:
    rng = np.random.default_rng(0)
    normal = rng.uniform(96, 160, (8, 8, 3)).astype(np.uint8)
    normal[..., 2] = 255
    big = normal.repeat(8, 0).repeat(8, 1)
    box = cube()
    asset = Asset(
        (replace(box, material=Material("m", (0.8, 0.5, 0.3), 0.5, normal_texture=Texture(big))),),
        "cube",
    )
    low = prepare(asset)
    n = big.astype(np.float32) / 255 * 2 - 1
    maps = {"red": 0.8, "green": 0.5, "blue": 0.3, "roughness": 0.5, "metalness": 0.0}
    maps.update({f"normal_{a}": n[..., k] for k, a in enumerate("xyz")})
    model = latent_of(low.mesh, maps, frozenset(["normal"]), Rates())
    views = ViewSampler((0.0, 0.0, 0.0), 0.9).draw(0, 3)
    ours = render_image(drawn_of(model), Batch(views.records(), Grid(3, 64)), 4)
    theirs = MeshReference(low.asset).render(views, 64, 4)
    # the same data through two paths: texels are clamped and stored once more (measured 70 dB)
    assert compare_images(theirs, np.array(ours).reshape(theirs.shape)).psnr > 55
    assert model.topology.edges.count == 18  # 12 edges and 6 diagonals: hard edges are no borders


def test_the_fit_improves_on_the_closed_form_and_keeps_the_shape(
    ball: Asset, tmp_path: Path
) -> None:
    low = asset_of(sphere(600, (0.0, 0.0, 0.0), 1.0, 32))
    options = bake_options(texture_size=32, resolution=192, pool=8, steps=40)
    result = bake(ball, low, tmp_path / "out.usda", options, report=tmp_path / "report")
    assert result.fit is not None
    # few texels for the picture: images choose them better than rays do (measured +0.39 dB)
    assert max(p.psnr for p in result.fit.curve) > result.fit.curve[0].psnr + 0.1
    np.testing.assert_array_equal(result.asset.meshes[0].positions, low.meshes[0].positions)
    np.testing.assert_array_equal(result.asset.meshes[0].uvs, low.meshes[0].uvs)
    metrics = json.loads((tmp_path / "report" / "report.json").read_text())["metrics"]
    # what is written is what was fitted: filling gutters again after the fit loses 0.2 dB here
    assert metrics["fitted"]["psnr_covered"] > metrics["closed form"]["psnr_covered"]
    assert (tmp_path / "report" / "map_coverage__red__missed_.png").is_file()
    assert load(tmp_path / "out.usda").triangle_count == len(low.meshes[0].faces)


def test_rays_that_miss_are_counted_and_filled() -> None:
    high = square(n=8)
    hole = replace(
        high, faces=high.faces[(np.abs(high.positions[high.faces].mean(axis=1)) > 0.25).any(axis=1)]
    )
    baked, _ = baked_pair(
        Asset((hole,), "h"), Asset((square(),), "l"), "material", "displacement", reach=0.1
    )
    # a hole of half the width has a quarter of the area
    assert baked.missed_share == pytest.approx(1 / 16, abs=0.01)
    assert baked.missed[SIZE // 2, SIZE // 2] and np.isfinite(baked.maps["red"]).all()
    np.testing.assert_allclose(baked.maps["displacement"], 0, atol=1e-6)


def test_outermost_sees_what_floats(low_sphere: Asset) -> None:
    high = Asset(tuple(sphere_mesh(2_000, Material("m"), r) for r in (1.0, 1.05)), "shells")
    near, _ = baked_pair(high, low_sphere, "displacement", reach=0.15)
    far, _ = baked_pair(high, low_sphere, "displacement", reach=0.15, pick="outermost")
    difference = (far.maps["displacement"] - near.maps["displacement"])[near.covered]
    # 0.05 between the shells, along rays that are not quite radial, and facets of both (measured 0.048 to 0.053)
    assert difference.min() > 0.04 and difference.max() < 0.06


def test_align_finds_scale_and_place(ball: Asset, low_sphere: Asset) -> None:
    shape = replace(
        low_sphere.meshes[0], positions=low_sphere.meshes[0].positions * np.float32([1, 0.6, 0.8])
    )
    bumpy = replace(
        ball.meshes[0], positions=ball.meshes[0].positions * np.float32([1, 0.6, 0.8]), normals=None
    )
    apart = replace(bumpy, positions=bumpy.positions * np.float32(0.25) + np.float32([3, -2, 1]))
    placed, scale, _ = align(Asset((apart,), "high"), Asset((shape,), "low"))
    # an inscribed polyhedron is smaller than its sphere: measured 0.985 of it
    assert scale == pytest.approx(4.0, rel=0.03)
    low, high = placed.bounds()
    np.testing.assert_allclose((low + high) / 2, 0, atol=0.01)
    result = bake(
        Asset((apart,), "high"), Asset((shape,), "low"), None, with_values(CLOSED, align=True)
    )
    assert any("HIGH was scaled by" in n for n in result.notes) and result.missed_share == 0


def test_unwrap_gives_an_atlas_and_keeps_faces() -> None:
    low = Asset(
        (replace(cube(), uvs=None), replace(cube(), uvs=None, positions=cube().positions + 2)),
        "low",
    )
    out = unwrap_asset(low, SIZE)
    for a, b in zip(low.meshes, out.meshes, strict=True):
        np.testing.assert_array_equal(a.positions[a.faces], b.positions[b.faces])
        np.testing.assert_array_equal(a.normals[a.faces], b.normals[b.faces])
    assert overlap(prepare(out).mesh)[0] == 0


def test_overlap_counts_triangles_and_ignores_shared_edges(low_sphere: Asset) -> None:
    assert overlap(prepare(low_sphere).mesh, 512) == (0, 0.0)
    two = square(n=1)
    mesh = prepare(Asset((two, replace(two, uvs=two.uvs * np.float32([0.5, 1]))), "low")).mesh
    # all of the second square lies in the first, which has half of its area there (measured 0.5)
    assert overlap(mesh, 256) == (4, pytest.approx(0.5, abs=0.02))


def _without_area(mesh: Mesh) -> Mesh:
    uvs = mesh.uvs.copy()
    uvs[mesh.faces[0]] = uvs[mesh.faces[0][0]]
    return replace(mesh, uvs=uvs)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: replace(m, uvs=None), "1 of 1 meshes have no texture coordinates; use --unwrap"),
        (
            lambda m: replace(m, uvs=m.uvs * 3),
            "of 24 texture coordinates lie outside the unit square",
        ),
        (
            lambda m: replace(m, uvs=m.uvs % np.float32([1, 0.5])),
            "of 12 triangles overlap others in texture space",
        ),
        (_without_area, "2 triangles have no area in texture space, 17 % of the surface"),
        (
            lambda m: replace(m, positions=m.positions + 1),
            r"1.732 m apart \(100 % of HIGH's size\)",
        ),
        (lambda m: replace(m, positions=m.positions * 3), "LOW is 3 times as large; use --align"),
    ],
)
def test_unusable_pairs_are_refused(change, words: str, tmp_path: Path) -> None:
    high = Asset((cube(),), "high")
    with pytest.raises(InputError, match=words):
        bake(high, Asset((change(cube()),), "low"), tmp_path / "out.glb", CLOSED)
    assert not list(tmp_path.iterdir())


def test_a_cage_that_reaches_nothing_is_refused(ball: Asset) -> None:
    low = asset_of(sphere(60, (0.0, 0.0, 0.0), 0.97, SIZE))
    with pytest.raises(
        InputError,
        match=r"of the rays found nothing of HIGH within 0\.0001 m: give a larger --cage",
    ):
        bake(ball, low, None, with_values(CLOSED, cage=1e-4))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"maps": "norml"}, "did you mean 'normal'"),
        ({"maps": ""}, "some of normal"),
        ({"fit": "shape"}, "LOW keeps its shape"),
        ({"bits": 12}, "8 or 16"),
        ({"green": "vulkan"}, "choose from opengl, directx"),
        ({"cage": -1.0}, "a positive distance"),
        ({"triangles": 5}, "unknown key 'triangles'"),
    ],
)
def test_options_are_checked(values: dict, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        bake_options(**values)


def test_the_public_function_is_not_hidden_by_a_package() -> None:
    import appearance_opt

    assert appearance_opt.bake is bake


def test_bake_as_a_user_would(ball: Asset, low_sphere: Asset, tmp_path: Path) -> None:
    save(ball, tmp_path / "high.glb")
    save(low_sphere, tmp_path / "low.glb")
    (tmp_path / "job.toml").write_text(
        'texture-size = 64\nmaps = "normal,ao,displacement"\nbits = 16\nao-rays = 4\n'
    )
    assert read_toml(tmp_path / "job.toml", BakeOptions)["bits"] == 16
    command = [
        "bake",
        "high.glb",
        "low.glb",
        "--out",
        "out.glb",
        "--closed-form",
        "--config",
        "job.toml",
        "--no-report",
    ]
    done = run(*command, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "0.00 % of the texels missed" in done.stdout
    assert load(tmp_path / "out.glb").meshes[0].material.normal_texture.pixels.dtype == np.uint16
    names = {p.name for p in (tmp_path / "out_maps").iterdir()}
    expected = {
        "normal.png",
        "ao.png",
        "displacement.png",
        "displacement.exr",
        "coverage.png",
        "maps.json",
    }
    assert names == {f"out_{n}" for n in expected}
    assert (tmp_path / "out_displacement.png").read_bytes() == (
        tmp_path / "out_maps/out_displacement.png"
    ).read_bytes()
    done = run("bake", "high.glb", "low.glb", "--out", "low.glb", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("error: low.glb: is the input itself")
    assert "Traceback" not in done.stderr
