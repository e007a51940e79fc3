"""Codecs of textures, quantised and compressed vertices: what is written is read back."""

from __future__ import annotations

import json
import os
import stat
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from appearance_opt.asset import FileOptions, images, ktx2, load, save
from appearance_opt.asset.file_options import PLAIN, TextureFormat, for_target, parse_textures
from appearance_opt.asset.gltf_accessors import _chunks
from appearance_opt.asset.types import Asset, Material, Mesh, Texture, Volume
from appearance_opt.errors import InputError
from appearance_opt.jobs.simplify import simplify
from appearance_opt.options.files import OutputOptions
from tests.conftest import grid_sphere

LOSSY = TextureFormat("webp", "lossy", 90)


def waves(size: int = 64, channels: int = 3, phase: float = 0.0) -> np.ndarray:
    """Smooth 8-bit pixels, other ones in each channel."""
    y, x = np.mgrid[:size, :size] * (2 * np.pi / size)
    planes = [np.sin(x + k + phase) * np.cos(y - k) for k in range(channels)]
    return (127.5 + 110 * np.stack(planes, axis=-1)).astype(np.uint8)


def normals_of_waves(size: int = 64) -> np.ndarray:
    """A normal map: unit vectors as 8 bits."""
    n = waves(size).astype(np.float64) / 127.5 - 1
    n[..., 2] = 1.5
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    return np.round((n + 1) * 127.5).astype(np.uint8)


def part(material: Material, offset: float = 0.0, name: str = "part") -> Mesh:
    positions, faces, uvs = grid_sphere(8, 12)
    used, faces = np.unique(faces, return_inverse=True)
    positions, uvs, faces = positions[used], uvs[used], faces.reshape(-1, 3).astype(np.int32)
    normals = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    tangents = np.cross([0, 1, 0], normals)
    length = np.linalg.norm(tangents, axis=1, keepdims=True)
    tangents = np.where(length > 1e-6, tangents / np.maximum(length, 1e-6), [1, 0, 0])
    tangents -= normals * (tangents * normals).sum(axis=1, keepdims=True)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    sign = np.where(np.arange(len(normals)) % 2 == 0, 1, -1)[:, None]
    return Mesh(
        (positions + [offset, 0.3, -0.2]).astype(np.float32),
        faces,
        normals.astype(np.float32),
        uvs,
        np.concatenate([tangents, sign], axis=1).astype(np.float32),
        np.linspace(0, 1, 4 * len(normals)).reshape(-1, 4).astype(np.float32)[:, :3],
        material,
        name,
    )


def painted(**changes: Any) -> Material:
    return replace(
        Material(
            "painted",
            metalness=1.0,
            base_color_texture=Texture(waves(), "srgb"),
            orm_texture=Texture(waves(phase=1.0)),
            normal_texture=Texture(normals_of_waves()),
        ),
        **changes,
    )


def document(path: Path) -> dict[str, Any]:
    text = _chunks(path.read_bytes(), path)[0] if path.suffix == ".glb" else path.read_bytes()
    return json.loads(text)


def corner_rows(mesh: Mesh, name: str) -> np.ndarray:
    """(F, 3, width) an attribute at the corners of the faces, in an order of their positions: that
    of vertices and faces may change."""
    values, where = getattr(mesh, name), mesh.positions[mesh.faces].round(3)
    first = np.lexsort(where.transpose(2, 0, 1), axis=1)[:, :1]
    turn = (first + np.arange(3)) % 3  # faces may begin with another corner
    rows = np.take_along_axis(values[mesh.faces], turn[..., None], axis=1)
    keys = np.take_along_axis(where, turn[..., None], axis=1).reshape(len(rows), -1)
    return rows[np.lexsort(keys.T)]


# what the options say


def test_what_is_said_of_one_kind_goes_before_what_is_said_of_all() -> None:
    options = parse_textures("color=webp:85,jpeg,normal=png")
    assert options.color == TextureFormat("webp", "lossy", 85)
    assert options.normal == PLAIN.normal
    assert options.material == TextureFormat("jpeg", "lossy", 90)
    assert parse_textures("normal=jpg:70", options).color == options.color


def test_normals_are_kept_well() -> None:
    assert parse_textures("webp").normal.mode == "lossless"
    assert parse_textures("ktx2").normal.mode == "uastc"
    assert parse_textures("ktx2").color.mode == "etc1s"
    assert parse_textures("ktx2:uastc").color.mode == "uastc"
    assert parse_textures("jpeg").normal.quality > parse_textures("jpeg").color.quality


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("gif", "'gif' is no codec; choose from png, jpeg, webp, ktx2"),
        ("colour=png", "'colour' is no kind of map; choose from color, normal, material"),
        ("webp:0", "choose a quality of 1 to 100 or lossless"),
        ("png:90", "'90' behind png: choose lossless"),
        ("jpeg:best", "choose a quality of 1 to 100"),
        ("color=png,color=webp", "'color' is given twice"),
        ("", "choose from png, jpeg, webp, ktx2"),
    ],
)
def test_what_is_no_codec_is_one_line(text: str, reason: str) -> None:
    with pytest.raises(InputError) as error:
        parse_textures(text)
    assert str(error.value).startswith(f"--textures {text}: ") and reason in str(error.value)


@pytest.mark.parametrize(
    ("name", "options", "reason"),
    [
        ("a.usda", parse_textures("webp"), ".usda files cannot hold webp textures"),
        ("a.usdz", FileOptions(normal=LOSSY), "use --textures png or jpeg"),
        ("a.obj", FileOptions(quantize=True), "--quantize is for .glb and .gltf"),
        ("a.usdc", FileOptions(compress="meshopt"), "--compress meshopt is for .glb and .gltf"),
    ],
)
def test_what_a_format_cannot_hold_is_refused(
    tmp_path: Path, name: str, options: FileOptions, reason: str
) -> None:
    with pytest.raises(InputError, match=reason):
        save(Asset((part(painted()),)), tmp_path / name, options)
    assert not list(tmp_path.iterdir())


def test_what_is_not_installed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match="basisu, toktx or ktx on the path"):
        parse_textures("ktx2").check(tmp_path / "a.glb")
    with pytest.raises(InputError, match="pip install meshopt"):
        FileOptions(compress="meshopt").check(tmp_path / "a.glb")
    # what suits a use does without
    assert for_target("game", tmp_path / "a.glb").color.codec == "png"
    assert for_target("web", tmp_path / "a.glb").compress == "none"


def test_a_target_heeds_what_the_format_can_hold(tmp_path: Path) -> None:
    for target in ("web", "game", "film"):
        for suffix in (".glb", ".gltf", ".usdz", ".usda", ".obj"):
            options = for_target(target, tmp_path / f"a{suffix}")  # type: ignore[arg-type]
            options.check(tmp_path / f"a{suffix}")
    web = for_target("web", tmp_path / "a.glb")
    assert (web.color.codec, web.normal.codec, web.quantize) == ("webp", "jpeg", True)
    assert for_target("web", tmp_path / "a.usdz").color.codec == "jpeg"
    assert for_target("film", tmp_path / "a.glb") == PLAIN


def test_a_target_fills_what_is_not_given(tmp_path: Path) -> None:
    pytest.importorskip("meshopt")
    given = OutputOptions(target="web", textures="color=png", quantize=False)
    options = given.for_file(tmp_path / "a.glb")
    assert options.color == PLAIN.color
    assert options.normal == for_target("web", tmp_path / "a.glb").normal
    assert (options.quantize, options.compress) == (False, "meshopt")
    with pytest.raises(InputError, match="--for print: choose from web, game, film"):
        OutputOptions(target="print")


def test_a_job_refuses_what_it_could_not_write_before_it_reads(tmp_path: Path) -> None:
    for values, name in (
        ({"textures": "webp"}, "out.usda"),
        ({"compress": "meshopt"}, "out.obj"),
        ({"quantize": True, "target": "web"}, "out.usdz"),
    ):
        with pytest.raises(InputError, match=r"out\.(usda|obj|usdz): "):
            simplify(tmp_path / "absent.glb", tmp_path / name, triangles=10, **values)
    assert not list(tmp_path.iterdir())


# textures


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize("text", ["jpeg:95", "webp:95", "webp:lossless"])
def test_textures_of_other_codecs_come_back(tmp_path: Path, suffix: str, text: str) -> None:
    asset = Asset((part(painted()),))
    path = tmp_path / f"a{suffix}"
    save(asset, path, parse_textures(text))
    written = document(path)
    webp = text.startswith("webp")
    assert written.get("extensionsRequired", []) == (["EXT_texture_webp"] if webp else [])
    assert all(("source" in t) != webp for t in written["textures"])
    assert {i.get("mimeType") for i in written["images"]} <= {"image/webp", "image/jpeg", None}
    again, given = load(path).meshes[0].material, asset.meshes[0].material
    for name, first in (
        ("base_color_texture", 0),
        ("orm_texture", 1),
        ("normal_texture", 0),
    ):
        found, truth = (getattr(m, name).pixels[..., first:] for m in (again, given))
        error = np.abs(found.astype(int) - truth)
        assert error.max() <= (0 if text == "webp:lossless" else 24)
        assert error.mean() <= (0 if text == "webp:lossless" else 2.5)


@pytest.mark.parametrize("suffix", [".usda", ".usdz", ".obj"])
def test_jpeg_in_other_formats(tmp_path: Path, suffix: str) -> None:
    save(Asset((part(painted()),)), tmp_path / f"a{suffix}", parse_textures("jpeg"))
    if suffix != ".usdz":
        assert len(list(tmp_path.rglob("*.jpg"))) >= 3 and not list(tmp_path.rglob("*.png"))
    material = load(tmp_path / f"a{suffix}").meshes[0].material
    assert material.base_color_texture is not None and material.normal_texture is not None
    error = material.base_color_texture.pixels[..., :3].astype(int) - waves()
    assert np.abs(error).mean() < 2.5


def test_alpha_stays(tmp_path: Path) -> None:
    """JPEG has none: PNG takes its place, but for an alpha that says nothing. WebP gives up the
    colours under an alpha of zero, which filters mix into what lies beside it: they stay."""
    pixels = waves(channels=4)
    pixels[:32, :, 3] = 0
    mesh = part(painted(base_color_texture=Texture(pixels, "srgb"), alpha_mode="mask"))
    for text, codec in (("jpeg", "png"), ("webp", "webp"), ("webp:lossless", "webp")):
        save(Asset((mesh,)), tmp_path / "a.glb", parse_textures(text))
        assert document(tmp_path / "a.glb")["images"][0]["mimeType"] == f"image/{codec}"
        found = load(tmp_path / "a.glb").meshes[0].material.base_color_texture
        assert found is not None
        error = np.abs(found.pixels.astype(int) - pixels)
        assert error[..., 3].max() <= 1 and error[..., :3].mean() < 2.5
    pixels[..., 3] = 255
    save(Asset((mesh,)), tmp_path / "a.glb", parse_textures("jpeg"))
    assert document(tmp_path / "a.glb")["images"][0]["mimeType"] == "image/jpeg"


def test_a_channel_that_someone_reads_stays(tmp_path: Path) -> None:
    """Red of roughness and metalness repeats green, unless it is occlusion."""
    for occlusion in (False, True):
        mesh = part(painted(has_occlusion=occlusion, alpha_mode="blend"))
        save(Asset((mesh,)), tmp_path / "a.glb", parse_textures("webp:lossless"))
        orm = load(tmp_path / "a.glb").meshes[0].material.orm_texture
        assert orm is not None
        np.testing.assert_array_equal(orm.pixels[..., 0], waves(phase=1.0)[..., 1 - occlusion])


def test_what_materials_share_stays_shared(tmp_path: Path) -> None:
    """Also when a file is read and written again."""
    one = painted()
    meshes = (part(one), part(replace(one, double_sided=False), 3.0))
    save(Asset(meshes), tmp_path / "a.glb")
    save(load(tmp_path / "a.glb"), tmp_path / "b.glb")
    assert len(document(tmp_path / "b.glb")["images"]) == 3


def test_too_large_for_webp_is_said() -> None:
    with pytest.raises(InputError, match="too large for WebP"):
        images.encode_webp(np.zeros((1, 16384, 3), np.uint8), 90)


ENCODER = """#!/bin/sh
echo "$0 $@" >> {log}
for last; do :; done
for word; do case "$word" in *.ktx2) target="$word";; esac; done
cp {ready} "$target"
"""


@pytest.mark.parametrize("name", list(ktx2.ENCODERS))
def test_an_encoder_on_the_path_writes_ktx2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    ready, log, program = tmp_path / "ready", tmp_path / "log", tmp_path / "bin" / name
    ready.write_bytes(b"what the encoder made")
    program.parent.mkdir()
    program.write_text(ENCODER.format(log=log, ready=ready))
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}/usr/bin{os.pathsep}/bin")
    mesh = part(painted())
    save(Asset((mesh,)), tmp_path / "a.gltf", parse_textures("color=ktx2:60,normal=ktx2"))
    written = document(tmp_path / "a.gltf")
    assert written["extensionsRequired"] == ["KHR_texture_basisu"]
    sources = [t.get("extensions", {}).get("KHR_texture_basisu") for t in written["textures"]]
    assert sources == [{"source": 0}, None, {"source": 2}]
    assert written["images"][0] == {"uri": "a_0.ktx2", "mimeType": "image/ktx2"}
    assert (tmp_path / "a_0.ktx2").read_bytes() == ready.read_bytes()
    calls = log.read_text()
    assert "153" in calls and "uastc" in calls  # 60 of 100, of 255
    assert ("linear" in calls) and "mip" in calls


def test_an_encoder_that_fails_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "basisu"
    program.write_text("#!/bin/sh\necho out of luck >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}/usr/bin{os.pathsep}/bin")
    with pytest.raises(InputError, match=r"basisu could not encode a texture \(out of luck\)"):
        save(Asset((part(painted()),)), tmp_path / "a.glb", parse_textures("ktx2"))
    assert [p.name for p in tmp_path.iterdir()] == ["basisu"]


def test_ktx2_comes_back(tmp_path: Path) -> None:
    pytest.importorskip("opengl_basisu")
    if ktx2.encoder() is None:
        pytest.skip("no encoder of KTX 2.0 on the path")
    odd = Texture(waves()[:30, :50].copy(), "srgb")
    given = painted(emission=(1.0, 1.0, 1.0), emission_texture=odd)
    save(Asset((part(given),)), tmp_path / "a.glb", parse_textures("ktx2:uastc"))
    found = load(tmp_path / "a.glb").meshes[0].material
    assert found.emission_texture is not None
    assert found.emission_texture.pixels.shape[:2] == (32, 52)
    for name in ("base_color_texture", "normal_texture"):
        error = getattr(found, name).pixels.astype(int) - getattr(given, name).pixels
        assert np.abs(error).mean() < 2.5


# vertices


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_compression_alone_loses_nothing(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("meshopt")
    mesh = part(painted())
    save(Asset((mesh,)), tmp_path / f"a{suffix}", FileOptions(compress="meshopt"))
    assert document(tmp_path / f"a{suffix}")["extensionsRequired"] == ["EXT_meshopt_compression"]
    again = load(tmp_path / f"a{suffix}").meshes[0]
    for name in ("positions", "uvs", "colors"):
        np.testing.assert_array_equal(corner_rows(again, name), corner_rows(mesh, name))
    for name in ("normals", "tangents"):  # brought to unit length, as ever
        np.testing.assert_allclose(
            corner_rows(again, name), corner_rows(mesh, name), rtol=0, atol=1e-6
        )


@pytest.mark.parametrize("compress", ["none", "meshopt"])
def test_quantised_vertices_are_as_near_as_is_said(tmp_path: Path, compress: Any) -> None:
    pytest.importorskip("meshopt")
    meshes = (part(painted()), part(painted(double_sided=False), 1.7, "beside"))
    save(Asset(meshes), tmp_path / "a.glb", FileOptions(quantize=True, compress=compress))
    assert "KHR_mesh_quantization" in document(tmp_path / "a.glb")["extensionsRequired"]
    extent = 2 + 1.7
    for again, mesh in zip(load(tmp_path / "a.glb").meshes, meshes, strict=True):
        assert again.name == mesh.name
        for name, bound in (
            ("positions", 0.51 * extent / 65535),
            ("uvs", 0.51 / 65535),
            ("colors", 0.51 / 65535),
        ):
            found, truth = corner_rows(again, name), corner_rows(mesh, name)
            assert np.abs(found - truth).max() <= bound + 3e-7, name
        for name, degrees in (("normals", 0.1), ("tangents", 0.1)):
            found, truth = (corner_rows(m, name)[..., :3].astype(float) for m in (again, mesh))
            angle = np.degrees(np.linalg.norm(np.cross(found, truth), axis=-1))
            assert angle.max() < degrees / (1 if compress == "meshopt" else 10)
        sign = corner_rows(again, "tangents")[..., 3]
        np.testing.assert_array_equal(sign, corner_rows(mesh, "tangents")[..., 3])


def test_meshes_that_touch_still_touch(tmp_path: Path) -> None:
    """Vertices in one place stay in one place: all meshes have one grid."""
    mesh = part(painted())
    half = len(mesh.faces) // 2
    meshes = tuple(replace(mesh, faces=f) for f in (mesh.faces[:half], mesh.faces[half:]))
    save(Asset(meshes), tmp_path / "a.glb", FileOptions(quantize=True))
    places = [
        {tuple(row) for row in m.positions[m.faces].reshape(-1, 3).tolist()}
        for m in load(tmp_path / "a.glb").meshes
    ]
    rows = [m.positions[m.faces].reshape(-1, 3).round(5) for m in meshes]
    truth = [{tuple(row) for row in places} for places in rows]
    assert len(places[0] & places[1]) == len(truth[0] & truth[1]) > 0


def test_coordinates_that_repeat_a_texture_stay_floats(tmp_path: Path) -> None:
    mesh = part(painted())
    assert mesh.uvs is not None
    mesh = replace(mesh, uvs=mesh.uvs * 3 - 1)
    save(Asset((mesh,)), tmp_path / "a.glb", FileOptions(quantize=True))
    np.testing.assert_array_equal(load(tmp_path / "a.glb").meshes[0].uvs, mesh.uvs)


def test_thickness_is_not_scaled(tmp_path: Path) -> None:
    """A node's scale would scale it (KHR_materials_volume): such positions stay floats."""
    glass = painted(transmission=0.9, volume=Volume(0.25))
    mesh = part(glass)
    save(Asset((mesh,)), tmp_path / "a.glb", FileOptions(quantize=True))
    again = load(tmp_path / "a.glb")
    assert again.meshes[0].material.volume == Volume(0.25) and not again.notes
    np.testing.assert_array_equal(again.meshes[0].positions, mesh.positions)


def test_far_away_assets_are_quantised_in_place(tmp_path: Path) -> None:
    asset = Asset((part(painted()),), origin=(512345.5, 10.0, -4000000.25))
    save(asset, tmp_path / "a.glb", FileOptions(quantize=True))
    again = load(tmp_path / "a.glb")
    truth = asset.meshes[0].positions[asset.meshes[0].faces].astype(float) + asset.origin
    found = again.meshes[0].positions[again.meshes[0].faces].astype(float) + again.origin
    assert np.abs(found - truth).max() < 0.51 * 2 / 65535 + 1e-6
