"""glTF in and out."""

from __future__ import annotations

import json
import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appearance_opt.asset import load, save
from appearance_opt.asset.types import Asset, Material, Mesh
from appearance_opt.errors import InputError


def write_glb(path: Path, document: dict, binary: bytes = b"") -> None:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    path.write_bytes(
        head
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )


def triangle_document(**changes: object) -> tuple[dict, bytes]:
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    document: dict = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "scene": 0,
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36}],
    }
    document.update(changes)
    return document, positions.tobytes()


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_round_trip_is_exact(tmp_path: Path, ball: Asset, suffix: str) -> None:
    save(ball, tmp_path / f"x{suffix}")
    again = load(tmp_path / f"x{suffix}").meshes[0]
    mesh = ball.meshes[0]
    used = np.unique(mesh.faces)  # unused pole vertices are dropped on loading
    np.testing.assert_array_equal(again.positions, mesh.positions[used])
    np.testing.assert_array_equal(again.uvs, mesh.uvs[used])
    np.testing.assert_array_equal(
        again.material.base_color_texture.pixels, mesh.material.base_color_texture.pixels
    )
    np.testing.assert_array_equal(
        again.material.orm_texture.pixels, mesh.material.orm_texture.pixels
    )
    assert again.material.base_color_texture.color_space == "srgb"
    assert np.array_equal(used[again.faces], mesh.faces)


@settings(max_examples=25)
@given(count=st.integers(1, 40), seed=st.integers(0, 2**31))
def test_round_trip_of_random_triangles(tmp_path: Path, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(3 * count, 3)).astype(np.float32)
    mesh = Mesh(
        positions,
        np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        material=Material(base_color=(0.2, 0.4, 0.6)),
    )
    save(Asset((mesh,)), tmp_path / "x.glb")
    again = load(tmp_path / "x.glb").meshes[0]
    np.testing.assert_array_equal(again.positions[again.faces], positions.reshape(-1, 3, 3))
    assert again.material.base_color == pytest.approx((0.2, 0.4, 0.6))


@settings(max_examples=120)
@given(
    cut=st.integers(0, 2000),
    flips=st.lists(st.tuples(st.integers(0, 5000), st.integers(1, 255)), max_size=4),
)
def test_damaged_files_are_refused_or_read(
    tmp_path: Path, cut: int, flips: list[tuple[int, int]]
) -> None:
    document, binary = triangle_document()
    write_glb(tmp_path / "whole.glb", document, binary)
    data = bytearray((tmp_path / "whole.glb").read_bytes())
    for at, value in flips:
        data[at % len(data)] ^= value
    (tmp_path / "x.glb").write_bytes(bytes(data[: max(len(data) - cut, 0)]))
    try:
        assert load(tmp_path / "x.glb").triangle_count > 0
    except InputError as error:
        assert "\n" not in str(error)
        assert "x.glb" in str(error)


def test_node_transforms_and_mirroring(tmp_path: Path) -> None:
    document, binary = triangle_document(
        nodes=[{"children": [1], "scale": [-2, 1, 1]}, {"mesh": 0, "translation": [1, 0, 0]}]
    )
    normals, tangents = np.float32([0, 0, 1]), np.float32([1, 0, 0, 1])
    for k, (name, row) in enumerate((("NORMAL", normals), ("TANGENT", tangents)), 1):
        data = np.tile(row, (3, 1)).tobytes()
        document["meshes"][0]["primitives"][0]["attributes"][name] = k
        accessor = {"bufferView": k, "componentType": 5126, "count": 3, "type": f"VEC{len(row)}"}
        document["accessors"].append(accessor)
        document["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)}
        )
        binary += data
    document["buffers"][0]["byteLength"] = len(binary)
    write_glb(tmp_path / "x.glb", document, binary)
    mesh = load(tmp_path / "x.glb").meshes[0]
    p = mesh.positions[mesh.faces[0]]
    assert {tuple(v) for v in p.tolist()} == {(-2, 0, 0), (-4, 0, 0), (-2, 1, 0)}
    # a mirrored node keeps its outside outside
    assert np.cross(p[1] - p[0], p[2] - p[0])[2] > 0
    np.testing.assert_array_equal(mesh.normals, np.tile([0, 0, 1], (3, 1)))
    # the bitangent is that of the file, (0, 1, 0), which the node leaves as it is: cross(normal,
    # tangent) is not
    np.testing.assert_array_equal(mesh.tangents, np.tile([-1, 0, 0, -1], (3, 1)))


def test_strips_become_triangles_of_one_winding(tmp_path: Path) -> None:
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    document, _ = triangle_document(
        bufferViews=[{"buffer": 0, "byteLength": 48}], buffers=[{"byteLength": 48}]
    )
    document["accessors"][0]["count"] = 4
    document["meshes"][0]["primitives"][0]["mode"] = 5
    write_glb(tmp_path / "x.glb", document, positions.tobytes())
    mesh = load(tmp_path / "x.glb").meshes[0]
    p = mesh.positions[mesh.faces]
    assert len(p) == 2
    assert (np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2] > 0).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"asset": {"version": "1.0"}}, "version"),
        ({"meshes": []}, "broken"),
        ({"bufferViews": [{"buffer": 0, "byteLength": 3600}]}, "cut short"),
        ({"buffers": [{"byteLength": 36, "uri": "../secret.bin"}]}, "outside"),
        ({"buffers": [{"byteLength": 36, "uri": "file:///etc/passwd"}]}, "not a file beside it"),
        ({"buffers": [{"byteLength": 36, "uri": "absent.bin"}]}, "does not exist"),
        ({"nodes": [{"mesh": 0, "children": [0]}]}, "ancestor"),
    ],
)
def test_unusable_files_say_why(tmp_path: Path, change: dict, words: str) -> None:
    folder = tmp_path / "asset"
    folder.mkdir()
    (tmp_path / "secret.bin").write_bytes(b"\0" * 36)
    document, binary = triangle_document(**change)
    write_glb(folder / "x.glb", document, binary)
    with pytest.raises(InputError, match=words):
        load(folder / "x.glb")


def draco_document(points: np.ndarray, uvs: np.ndarray, faces: np.ndarray) -> tuple[dict, bytes]:
    """A file whose geometry is compressed and has no other data; texture coordinates are normalized
    bytes."""
    dracopy = pytest.importorskip("DracoPy")
    data = dracopy.encode(
        points,
        faces,
        quantization_bits=24,
        preserve_order=True,
        generic_attributes={1: (uvs * 255).astype(np.uint8)},
    )
    count = {"count": len(points)}
    extension = {
        "bufferView": 0,
        "attributes": {"POSITION": 2, "TEXCOORD_0": 1},
    }  # the encoder numbers positions last
    document, _ = triangle_document(
        meshes=[
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "TEXCOORD_0": 1},
                        "indices": 2,
                        "extensions": {"KHR_draco_mesh_compression": extension},
                    }
                ]
            }
        ],
        accessors=[
            {"componentType": 5126, "type": "VEC3", **count},
            {"componentType": 5121, "type": "VEC2", "normalized": True, **count},
            {"componentType": 5125, "type": "SCALAR", "count": faces.size},
        ],
        bufferViews=[{"buffer": 0, "byteLength": len(data)}],
        buffers=[{"byteLength": len(data)}],
        extensionsUsed=["KHR_draco_mesh_compression"],
        extensionsRequired=["KHR_draco_mesh_compression"],
    )
    return document, data


QUAD = (
    np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 3]], np.float32),
    np.array([[0, 0], [1, 0], [1, 0.2], [0, 0.2]], np.float32),
    np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
)


def test_draco_compressed_geometry(tmp_path: Path) -> None:
    points, uvs, faces = QUAD
    write_glb(tmp_path / "x.glb", *draco_document(*QUAD))
    mesh = load(tmp_path / "x.glb").meshes[0]
    np.testing.assert_allclose(mesh.positions[mesh.faces], points[faces], atol=1e-5)
    np.testing.assert_allclose(mesh.uvs[mesh.faces], uvs[faces], atol=1e-6)


def test_damaged_draco_data_is_refused(tmp_path: Path) -> None:
    document, data = draco_document(*QUAD)
    write_glb(tmp_path / "x.glb", document, b"\0" * len(data))
    with pytest.raises(InputError, match="Draco data is damaged"):
        load(tmp_path / "x.glb")


def test_without_the_package_draco_names_it_or_takes_the_other_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_glb(tmp_path / "alone.glb", *draco_document(*QUAD))
    document, binary = triangle_document(extensionsUsed=["KHR_draco_mesh_compression"])
    extension = {"bufferView": 0, "attributes": {"POSITION": 0}}
    document["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": extension}
    write_glb(tmp_path / "both.glb", document, binary)
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(InputError, match=r"pip install 'appearance-opt\[draco\]'"):
        load(tmp_path / "alone.glb")
    assert len(load(tmp_path / "both.glb").meshes[0].faces) == 1


def meshopt_document(
    extension: str = "EXT_meshopt_compression", filtered: bool = False
) -> tuple[dict, bytes]:
    """QUAD as gltfpack would write it: compressed positions and triangles, and a buffer that only
    stands for the plain ones; ``filtered``: positions as mantissas of 20 bits that share their
    exponents."""
    meshopt = pytest.importorskip("meshopt")
    points, _, faces = QUAD
    faces = faces.astype(np.uint16)
    stored = meshopt.encode_filter_exp(points, 20) if filtered else points
    parts = [
        meshopt.encode_gltf_buffer(stored, "ATTRIBUTES"),
        meshopt.encode_gltf_buffer(faces, "TRIANGLES"),
    ]
    lengths = [len(p) for p in parts]
    packed = [
        {
            "count": len(points),
            "byteStride": 12,
            "mode": "ATTRIBUTES",
            "filter": "EXPONENTIAL" if filtered else "NONE",
        },
        {"count": faces.size, "byteStride": 2, "mode": "TRIANGLES"},
    ]
    for k, (view, length) in enumerate(zip(packed, lengths, strict=True)):
        view.update(buffer=0, byteOffset=lengths[0] * k, byteLength=length)
    document, _ = triangle_document(
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        accessors=[
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": len(points)},
            {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": faces.size},
        ],
        bufferViews=[
            {"buffer": 1, "byteLength": 48, "byteStride": 12, "extensions": {extension: packed[0]}},
            {"buffer": 1, "byteOffset": 48, "byteLength": 12, "extensions": {extension: packed[1]}},
        ],
        buffers=[
            {"byteLength": sum(lengths)},
            {"byteLength": 60, "extensions": {extension: {"fallback": True}}},
        ],
        extensionsUsed=[extension],
        extensionsRequired=[extension],
    )
    return document, b"".join(parts)


@pytest.mark.parametrize("extension", ["EXT_meshopt_compression", "KHR_meshopt_compression"])
@pytest.mark.parametrize("filtered", [False, True])
def test_meshopt_compressed_geometry(tmp_path: Path, extension: str, filtered: bool) -> None:
    points, _, faces = QUAD
    write_glb(tmp_path / "x.glb", *meshopt_document(extension, filtered))
    mesh = load(tmp_path / "x.glb").meshes[0]
    found, wanted = (
        sorted(map(sorted, p.tolist())) for p in (mesh.positions[mesh.faces], points[faces])
    )
    np.testing.assert_allclose(found, wanted, atol=1e-5 if filtered else 0)


@pytest.mark.parametrize(
    "change", [{"count": 2**40}, {"count": -3}, {"byteStride": 13}, {"mode": "POINTS"}]
)
def test_meshopt_data_that_cannot_be_is_refused(tmp_path: Path, change: dict) -> None:
    document, data = meshopt_document()
    document["bufferViews"][0]["extensions"]["EXT_meshopt_compression"].update(change)
    write_glb(tmp_path / "x.glb", document, data)
    with pytest.raises(InputError, match="meshopt data is damaged"):
        load(tmp_path / "x.glb")


def test_damaged_meshopt_data_is_refused(tmp_path: Path) -> None:
    document, data = meshopt_document()
    write_glb(tmp_path / "x.glb", document, b"\0" * len(data))
    with pytest.raises(InputError, match="meshopt data is damaged"):
        load(tmp_path / "x.glb")


def test_without_the_package_meshopt_names_it_or_takes_the_fallback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, data = meshopt_document()
    write_glb(tmp_path / "alone.glb", document, data)
    document["buffers"][1]["uri"] = "plain.bin"
    write_glb(tmp_path / "both.glb", document, data)
    points, _, faces = QUAD
    (tmp_path / "plain.bin").write_bytes(points.tobytes() + faces.astype(np.uint16).tobytes())
    monkeypatch.setitem(sys.modules, "meshopt", None)
    with pytest.raises(InputError, match=r"pip install meshopt"):
        load(tmp_path / "alone.glb")
    mesh = load(tmp_path / "both.glb").meshes[0]
    np.testing.assert_array_equal(mesh.positions[mesh.faces], points[faces])


def test_non_finite_positions_are_refused(tmp_path: Path) -> None:
    document, _ = triangle_document()
    write_glb(tmp_path / "x.glb", document, np.full((3, 3), np.nan, np.float32).tobytes())
    with pytest.raises(InputError, match="3 positions are NaN"):
        load(tmp_path / "x.glb")


def test_a_degenerate_face_is_dropped_with_a_note(tmp_path: Path, ball: Asset) -> None:
    mesh = ball.meshes[0]
    bad = replace(mesh, faces=np.concatenate([mesh.faces, [[5, 5, 6]]]).astype(np.int32))
    save(Asset((bad,)), tmp_path / "x.glb")
    again = load(tmp_path / "x.glb")
    assert again.triangle_count == len(mesh.faces)
    assert any("1 degenerate" in n for n in again.notes)


def test_real_helmet_becomes_one_scene(assets_dir: Path) -> None:
    asset = load(assets_dir / "flight_helmet" / "FlightHelmet.gltf")
    assert asset.triangle_count == 94722
    assert len({id(m.material) for m in asset.meshes}) == 5 + 1 - (6 - len(asset.meshes))
    assert all(m.normals is not None and m.uvs is not None for m in asset.meshes)


@pytest.mark.parametrize("stem", ["my #1", "50%20off?", "ä b"])
def test_uris_are_percent_encoded(tmp_path: Path, ball: Asset, stem: str) -> None:
    """RFC 3986: a plain # would start a fragment, and a plain % an escape."""
    save(ball, tmp_path / f"{stem}.gltf")
    document = json.loads((tmp_path / f"{stem}.gltf").read_text())
    for uri in [x["uri"] for x in document["buffers"] + document["images"]]:
        assert set(uri) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789._-%")
    assert load(tmp_path / f"{stem}.gltf").meshes[0].material.base_color_texture is not None
