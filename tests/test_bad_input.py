"""Files that are damaged, hostile or strange: an asset, or one clear line. Nothing else."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from appearance_opt.asset import images, load, save
from appearance_opt.asset.types import Asset, Material, Texture
from appearance_opt.errors import InputError
from tests.conftest import make_asset
from tests.test_asset_gltf import triangle_document, write_glb

ROOTS = (
    "x.glb",
    "x.gltf",
    "x.bin",
    "x_0.png",
    "x.obj",
    "x.mtl",
    "x.usda",
    "x.usdc",
    "x.usdz",
    "x.ply",
    "x.stl",
)
OWNERS = {"x.bin": "x.gltf", "x_0.png": "x.gltf", "x.mtl": "x.obj"}
"""Which file to load when another one is damaged."""

NUMBERS = (
    b"-1",
    b"0",
    b"1e999",
    b"nan",
    b"9" * 23,
    b"2147483648",
    b"1e30",
    b"null",
    b'"x"',
    b"[]",
    b"{}",
    b"-0.5",
)
"""What numbers in text formats are replaced by."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one small textured asset in every format."""
    folder = tmp_path_factory.mktemp("whole")
    asset = make_asset(4, 6, 8)
    for suffix in (".glb", ".gltf", ".obj", ".usda", ".usdc", ".usdz"):
        save(asset, folder / f"x{suffix}")
    mesh = asset.meshes[0]
    soup = trimesh.Trimesh(mesh.positions, mesh.faces, process=False)
    soup.export(folder / "x.ply")
    soup.export(folder / "x.stl")
    return folder


def damaged(
    data: bytes, cut: float, changes: list[tuple[float, int]], number: tuple[float, int]
) -> bytes:
    """Bytes cut to a share of their length, some of them changed, one decimal number replaced."""
    out = bytearray(data[: max(int(cut * len(data)), 0)])
    for at, value in changes:
        if out:
            out[int(at * len(out)) % len(out)] = value
    digits = [i for i, b in enumerate(out) if 48 <= b < 58]
    at, which = number
    if digits and which < len(NUMBERS):
        i = digits[int(at * len(digits)) % len(digits)]
        out[i : i + 1] = NUMBERS[which]
    return bytes(out)


# (what fraction to keep, bytes to change, a number to replace): most examples damage in one way
# only
damages = st.one_of(
    st.tuples(st.floats(0, 1, exclude_max=True), st.just([]), st.just((0.0, len(NUMBERS)))),
    st.tuples(
        st.just(1.0),
        st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=6),
        st.just((0.0, len(NUMBERS))),
    ),
    st.tuples(
        st.just(1.0), st.just([]), st.tuples(st.floats(0, 1), st.integers(0, len(NUMBERS) - 1))
    ),
)


@pytest.mark.parametrize("name", ROOTS)
@settings(max_examples=40)
@given(damage=damages)
def test_damage_to_any_file_is_refused_or_harmless(whole: Path, name: str, damage: tuple) -> None:
    original = (whole / name).read_bytes()
    try:
        (whole / name).write_bytes(damaged(original, *damage))
        asset = load(whole / OWNERS.get(name, name))
        assert asset.triangle_count > 0
        for mesh in asset.meshes:
            assert np.isfinite(mesh.positions).all()
            assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.positions)
    except InputError as error:
        assert "\n" not in str(error)
        assert (
            "x" in str(error) and len(str(error)) < 600
        )  # measured: at most 340 with the folder's name
    finally:
        (whole / name).write_bytes(original)


@settings(max_examples=80)
@given(damage=damages, kind=st.sampled_from(["png8", "png16"]))
def test_damaged_pictures(damage: tuple, kind: str) -> None:
    rng = np.random.default_rng(0)
    scale, dtype = (255, np.uint8) if kind == "png8" else (65535, np.uint16)
    data = images.encode_png((rng.random((9, 7, 3)) * scale).astype(dtype))
    try:
        assert images.decode(damaged(data, *damage), "picture").ndim == 3
    except InputError as error:
        assert "picture" in str(error) and "\n" not in str(error)


def test_a_damaged_picture_prints_nothing_of_its_own(capfd: pytest.CaptureFixture) -> None:
    data = bytearray(images.encode_png(np.zeros((9, 7, 3), np.uint8)))
    data[60] ^= 255
    with pytest.raises(
        InputError, match="the image is damaged"
    ):  # how, depends on the version of OpenImageIO
        images.decode(bytes(data), "picture")
    with pytest.raises(InputError, match="cut short"):
        images.decode(bytes(data[:30]), "picture")
    assert capfd.readouterr().err == ""


def test_a_picture_that_claims_to_be_huge_is_refused_before_it_is_read() -> None:
    data = bytearray(images.encode_png(np.zeros((9, 7, 3), np.uint8)))
    data[16:24] = struct.pack(">II", 200_000, 200_000)
    data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    with pytest.raises(InputError, match=r"200000 ?x ?200000"):
        images.decode(bytes(data), "picture")


def test_textures_of_extreme_shapes_load(tmp_path: Path, ball: Asset) -> None:
    for shape in ((1, 1), (1, 4096), (4096, 1), (2, 16384)):
        pixels = np.full((*shape, 3), 200, np.uint8)
        material = replace(ball.meshes[0].material, base_color_texture=Texture(pixels, "srgb"))
        save(Asset((replace(ball.meshes[0], material=material),)), tmp_path / "x.glb")
        assert load(tmp_path / "x.glb").meshes[0].material.base_color_texture.pixels.shape == (
            *shape,
            3,
        )
    with pytest.raises(InputError, match="at most 16384"):
        images.decode(images.encode_png(np.zeros((1, 16385, 3), np.uint8)), "too wide")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"accessors": [{"componentType": 5126, "count": 10**12, "type": "VEC3"}]},
            "elements but no data",
        ),
        (
            {
                "accessors": [
                    {"bufferView": 0, "componentType": 5126, "count": 10**12, "type": "VEC3"}
                ]
            },
            "beyond",
        ),
        ({"buffers": [{"byteLength": 36, "uri": "a" * 5000}]}, "no file name"),
        ({"buffers": [{"byteLength": 36, "uri": "%2e%2e/secret.bin"}]}, "outside"),
        ({"buffers": [{"byteLength": 36, "uri": "link.bin"}]}, "outside"),
        ({"buffers": [{"byteLength": 36, "uri": "."}]}, "does not exist|outside"),
        ({"nodes": [{"mesh": 0, "scale": [float("nan"), 1, 1]}]}, "NaN"),
        ({"nodes": [{"mesh": 0, "scale": [0, 0, 0]}]}, "no triangles"),
        ({"scenes": [{"nodes": []}]}, "no triangles"),
    ],
)
def test_gltf_that_asks_for_too_much(tmp_path: Path, change: dict, words: str) -> None:
    folder = tmp_path / "asset"
    folder.mkdir()
    (tmp_path / "secret.bin").write_bytes(b"\0" * 36)
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    write_glb(folder / "x.glb", *triangle_document(**change))
    with pytest.raises(InputError, match=words):
        load(folder / "x.glb")


def test_deeply_nested_json_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.gltf").write_text("[" * 200_000)
    with pytest.raises(InputError, match=r"x\.gltf"):
        load(tmp_path / "x.gltf")


@pytest.mark.parametrize(
    "reference", ["../secret.png", "/etc/hostname", "C:/x.png", "http://a/b.png", "absent.png"]
)
def test_mtl_references_stay_in_the_folder(tmp_path: Path, reference: str) -> None:
    folder = tmp_path / "asset"
    folder.mkdir()
    (tmp_path / "secret.png").write_bytes(images.encode_png(np.zeros((2, 2, 3), np.uint8)))
    (folder / "x.mtl").write_text(f"newmtl a\nmap_Kd {reference}\n")
    (folder / "x.obj").write_text("mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"outside|not a file beside|does not exist"):
        load(folder / "x.obj")


def test_usd_textures_stay_in_the_folder(tmp_path: Path, ball: Asset) -> None:
    folder = tmp_path / "asset"
    folder.mkdir()
    save(ball, folder / "x.usda")
    textures = next(folder.glob("*_textures"))
    picture = next(textures.glob("*base_color*"))
    picture.rename(tmp_path / "secret.png")
    text = (folder / "x.usda").read_text()
    for elsewhere in ("../secret.png", str(tmp_path / "secret.png")):
        (folder / "x.usda").write_text(text.replace(f"./{textures.name}/{picture.name}", elsewhere))
        with pytest.raises(InputError, match="outside"):
            load(folder / "x.usda")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999999\n", "line 4"),
        ("v 1e39 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "NaN or infinite"),
        ("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "no triangles"),
        ("mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n", "missing or not a number"),
    ],
)
def test_obj_with_impossible_numbers(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "x.obj").write_text(text)
    (tmp_path / "x.mtl").write_text("newmtl a\nKd 0.5 0.5\n")
    with pytest.raises(InputError, match=words):
        load(tmp_path / "x.obj")


def test_binary_usd_that_crashes_usd_itself_is_refused(tmp_path: Path) -> None:
    """A count among the values, which nothing but USD can check: without the guard this process
    would end here with a segmentation fault."""
    save(make_asset(4, 6, 8), tmp_path / "x.usdc")
    data = bytearray((tmp_path / "x.usdc").read_bytes())
    assert data[88:96] == struct.pack("<Q", 1)  # length of the first list of the file
    data[88] = 13
    (tmp_path / "x.usdc").write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"reader crashes on it"):
        load(tmp_path / "x.usdc")


def test_binary_usd_with_impossible_counts_is_refused_at_once(whole: Path, tmp_path: Path) -> None:
    data = (whole / "x.usdc").read_bytes()
    (table,) = struct.unpack_from("<q", data, 16)
    sections = {}
    for k in range(struct.unpack_from("<Q", data, table)[0]):
        name, start, size = struct.unpack_from("<16sqq", data, table + 8 + 32 * k)
        sections[name.rstrip(b"\0").decode()] = (start, size)
    assert set(sections) == {"TOKENS", "STRINGS", "FIELDS", "FIELDSETS", "PATHS", "SPECS"}
    for start, _ in sections.values():
        bad = bytearray(data)
        struct.pack_into("<Q", bad, start, 1 << 40)  # as many elements
        (tmp_path / "x.usdc").write_bytes(bytes(bad))
        with pytest.raises(InputError, match="damaged or cut short"):
            load(tmp_path / "x.usdc")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_factors_that_are_no_numbers_are_refused(ball: Asset, value: float) -> None:
    from appearance_opt.asset.validate import repair

    for change in (
        {"roughness": value},
        {"base_color": (1.0, value, 1.0)},
        {"normal_scale": value},
    ):
        bad = replace(ball.meshes[0], material=replace(ball.meshes[0].material, **change))
        with pytest.raises(InputError, match="a factor is NaN or infinite"):
            repair(Asset((bad,)), "x.glb")


def test_values_beyond_their_range_are_clamped_with_a_note(ball: Asset) -> None:
    from appearance_opt.asset.validate import MAX_UV, repair

    mesh = ball.meshes[0]
    hdr = Texture(np.linspace(-1, 9, 12, dtype=np.float32).reshape(2, 2, 3), "linear")
    material = replace(Material(base_color=(2.0, -1.0, 0.5), roughness=3.0), base_color_texture=hdr)
    bad = replace(
        mesh, material=material, uvs=mesh.uvs * np.float32(1e9), colors=mesh.positions - 1
    )
    out = repair(Asset((bad, replace(bad, name="twin"))), "x.glb")
    got = out.meshes[0]
    assert got.material.base_color == (1.0, 0.0, 0.5) and got.material.roughness == 1.0
    assert got.material is out.meshes[1].material  # shared before, shared after
    assert (
        got.material.base_color_texture.pixels.min() >= 0
        and got.material.base_color_texture.pixels.max() <= 1
    )
    assert np.abs(got.uvs).max() <= MAX_UV and got.colors.min() >= 0
    assert (
        sum("clamped" in n for n in out.notes) == 4
    )  # uvs and colours of both meshes, factors and texels
    assert sum(n.startswith("meshes 'ball', 'twin': ") and "clamped" in n for n in out.notes) == 2


def test_attributes_that_do_not_fit_the_positions_are_refused(ball: Asset) -> None:
    from appearance_opt.asset.validate import repair

    mesh = ball.meshes[0]
    for change in (
        {"normals": mesh.normals[:-1]},
        {"uvs": mesh.positions},
        {"tangents": np.zeros((0, 4), np.float32)},
    ):
        with pytest.raises(InputError, match="numbers for"):
            repair(Asset((replace(mesh, **change),)), "x.glb")


@pytest.mark.parametrize("where", ["stl", "ply"])
def test_geometry_files_with_faces_out_of_range(tmp_path: Path, where: str) -> None:
    if where == "ply":
        text = (
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
            "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n"
        )
        (tmp_path / "x.ply").write_text(text)
    else:  # a binary STL that announces more triangles than it has
        (tmp_path / "x.stl").write_bytes(b"\0" * 80 + struct.pack("<I", 10**6) + b"\0" * 50)
    with pytest.raises(InputError, match=rf"x\.{where}"):
        load(tmp_path / f"x.{where}")


def test_a_writer_that_runs_out_of_disk_in_the_last_flush_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import OpenImageIO as oiio

    real = oiio.ImageOutput.create

    class Full:
        """An output whose buffered bytes do not reach the disk."""

        def __init__(self, path: str) -> None:
            self._real = real(path)

        def __getattr__(self, name: str):
            return getattr(self._real, name)

        def close(self) -> bool:
            self._real.close()
            return False

    monkeypatch.setattr(
        oiio, "ImageOutput", type("Output", (), {"create": staticmethod(partial(Full))})
    )
    with pytest.raises(OSError, match=r"could not be encoded .* disk"):
        images.encode_png(np.zeros((4, 4, 3), np.uint8))
