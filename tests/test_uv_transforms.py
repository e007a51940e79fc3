"""glTF textures of one material under transforms and wrap modes of their own, against the
specification by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import Asset, load
from appearance_opt.asset.images import encode_png
from appearance_opt.asset.resampling import bilinear
from tests.test_asset_gltf import write_glb

WRAPS = {"repeat": 10497, "clamp": 33071, "mirror": 33648}
SLOTS = ("base_color_texture", "orm_texture", "normal_texture")


def quad(
    path: Path,
    textures: list[tuple[np.ndarray, tuple[str, str], dict | None]],
    low: float,
    high: float,
) -> Asset:
    """A quad with corners at (low, low) and (high, high) of the texture coordinates, its textures
    in the order of ``SLOTS``: (pixels, wrap modes, KHR_texture_transform)."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    uvs = np.array([[low, low], [high, low], [high, high], [low, high]], np.float32)
    faces = np.array([0, 1, 2, 0, 2, 3], np.uint16)
    chunks = [
        positions.tobytes(),
        uvs.tobytes(),
        faces.tobytes(),
        *(encode_png(p) for p, _, _ in textures),
    ]
    views, binary = [], b""
    for chunk in chunks:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(chunk)})
        binary += chunk + b"\0" * (-len(chunk) % 4)
    infos = [
        {"index": k, **({} if t is None else {"extensions": {"KHR_texture_transform": t}})}
        for k, (_, _, t) in enumerate(textures)
    ]
    material: dict = {"pbrMetallicRoughness": {"baseColorTexture": infos[0]}}
    if len(infos) > 1:
        material["pbrMetallicRoughness"]["metallicRoughnessTexture"] = infos[1]
    if len(infos) > 2:
        material["normalTexture"] = infos[2]
    count = range(len(textures))
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_texture_transform"],
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
                ]
            }
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        "materials": [material],
        "textures": [{"source": k, "sampler": k} for k in count],
        "samplers": [{"wrapS": WRAPS[w[0]], "wrapT": WRAPS[w[1]]} for _, w, _ in textures],
        "images": [{"bufferView": 3 + k, "mimeType": "image/png"} for k in count],
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    write_glb(path, json.loads(json.dumps(document)), binary)
    return load(path)


def wrapped(i: int, size: int, mode: str) -> int:
    if mode == "repeat":
        return i % size
    if mode == "clamp":
        return min(max(i, 0), size - 1)
    i %= 2 * size
    return i if i < size else 2 * size - 1 - i


def lookup(
    pixels: np.ndarray, wrap: tuple[str, str], transform: dict | None, u: float, v: float
) -> np.ndarray:
    """Bilinear lookup as glTF 2.0 and KHR_texture_transform say: translation * rotation * scale."""
    t = transform or {}
    a, (sx, sy), (ox, oy) = t.get("rotation", 0.0), t.get("scale", (1, 1)), t.get("offset", (0, 0))
    x, y = sx * u, sy * v
    u, v = math.cos(a) * x + math.sin(a) * y + ox, -math.sin(a) * x + math.cos(a) * y + oy
    height, width = pixels.shape[:2]
    x, y = u * width - 0.5, v * height - 0.5
    i, j = math.floor(x), math.floor(y)
    total = np.zeros(pixels.shape[2])
    for di, wx in ((0, 1 - x + i), (1, x - i)):
        for dj, wy in ((0, 1 - y + j), (1, y - j)):
            total += (
                wx * wy * pixels[wrapped(j + dj, height, wrap[1]), wrapped(i + di, width, wrap[0])]
            )
    return total


CASES = {
    "wraps": [((8, 8), ("repeat", "repeat"), None), ((8, 8), ("clamp", "clamp"), None)],
    "anisotropic": [((4, 8), ("repeat", "mirror"), None)],
    "offset": [
        ((8, 8), ("repeat", "repeat"), None),
        ((4, 4), ("repeat", "repeat"), {"offset": [0.25, 0.1]}),
    ],
    "detail": [
        ((8, 8), ("mirror", "repeat"), None),
        ((8, 8), ("repeat", "repeat"), {"scale": [3, 2]}),
    ],
    "turned": [
        ((8, 8), ("repeat", "repeat"), {"rotation": 0.5, "scale": [2, -1]}),
        ((4, 8), ("clamp", "mirror"), {"rotation": -0.25}),
        ((8, 8), ("repeat", "repeat"), {"rotation": 1.0, "offset": [0.5, 0.0]}),
    ],
}


@pytest.mark.parametrize("case", CASES)
def test_each_texture_keeps_its_transform_and_wrap_mode(tmp_path: Path, case: str) -> None:
    rng = np.random.default_rng(0)
    textures = [(rng.integers(0, 256, (*s, 3), np.uint8), wrap, t) for s, wrap, t in CASES[case]]
    low, high = -0.3, 1.6
    asset = quad(tmp_path / "quad.glb", textures, low, high)
    mesh = asset.meshes[0]
    assert any("resampled to common texture coordinates" in note for note in asset.notes)
    # corners are an affine image of the file's coordinates: this is its inverse
    uvs = np.asarray(mesh.uvs, np.float64)
    to_new = np.stack([uvs[1] - uvs[0], uvs[3] - uvs[0]], axis=1) / (high - low)
    for slot, (pixels, wrap, transform) in zip(SLOTS, textures, strict=False):
        new = getattr(mesh.material, slot)
        assert new.wrap == ("clamp", "clamp")
        height, width = new.pixels.shape[:2]
        checked = 0
        for row in range(height):
            for column in range(width):
                centre = np.array([(column + 0.5) / width, (row + 0.5) / height])
                u, v = np.linalg.solve(to_new, centre - uvs[0]) + low
                if low <= u <= high and low <= v <= high:
                    expected = lookup(pixels, wrap, transform, u, v)
                    # rounding to 8 bits, and coordinates in single precision (measured 0.5003)
                    assert np.abs(new.pixels[row, column] - expected).max() < 0.505
                    checked += 1
        assert checked > 100


def test_a_shared_transform_moves_the_coordinates_alone(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8)
    shared = {"scale": [2, 3], "offset": [0.5, 0.25]}
    asset = quad(tmp_path / "quad.glb", [(pixels, ("mirror", "mirror"), shared)] * 3, -1.0, 1.0)
    mesh = asset.meshes[0]
    np.testing.assert_allclose(
        mesh.uvs, [[-1.5, -2.75], [2.5, -2.75], [2.5, 3.25], [-1.5, 3.25]], atol=1e-6
    )
    for slot in SLOTS:
        np.testing.assert_array_equal(getattr(mesh.material, slot).pixels, pixels)
    assert not any("resampled" in note for note in asset.notes)


def test_wrap_modes_do_not_matter_within_the_image(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8)
    textures = [(pixels, ("repeat", "repeat"), None), (pixels, ("clamp", "repeat"), None)]
    mesh = quad(tmp_path / "quad.glb", textures, 0.0, 1.0).meshes[0]
    np.testing.assert_array_equal(mesh.uvs, [[0, 0], [1, 0], [1, 1], [0, 1]])
    np.testing.assert_array_equal(mesh.material.orm_texture.pixels, pixels)


def test_what_would_be_too_large_is_left_with_a_note(tmp_path: Path) -> None:
    pixels = np.zeros((8, 8, 3), np.uint8)
    textures = [(pixels, ("repeat", "repeat"), None), (pixels, ("clamp", "clamp"), None)]
    asset = quad(tmp_path / "quad.glb", textures, 0.0, 10_000.0)
    assert any(
        "too large to be resampled: the first one's are used" in note for note in asset.notes
    )
    assert asset.meshes[0].uvs.max() == 10_000


def two_sets(
    path: Path, color: np.ndarray, orm: np.ndarray, normal: np.ndarray | None, second
) -> Asset:
    """A grid over the unit square in x and y, its first texture coordinates (x, 1 - y). Base colour
    and normal map read the second ones, which are ``second`` of the first; roughness and metalness
    the first."""
    side = np.linspace(0, 1, 9)
    x, y = (c.ravel() for c in np.meshgrid(side, side))
    index = np.arange(81).reshape(9, 9)
    a, b, c, d = (
        index[:-1, :-1].ravel(),
        index[:-1, 1:].ravel(),
        index[1:, 1:].ravel(),
        index[1:, :-1].ravel(),
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.uint16)
    first = np.stack([x, 1 - y], 1).astype(np.float32)
    positions = np.stack([x, y, 0 * x], 1).astype(np.float32)
    normals = np.broadcast_to(np.float32([0, 0, 1]), positions.shape)
    pictures = [color, orm, *([] if normal is None else [normal])]
    parts = [positions, normals, first, second(first).astype(np.float32), faces]
    chunks = [np.ascontiguousarray(p).tobytes() for p in parts] + [encode_png(p) for p in pictures]
    views, binary = [], b""
    for chunk in chunks:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(chunk)})
        binary += chunk + b"\0" * (-len(chunk) % 4)
    pbr = {
        "baseColorTexture": {"index": 0, "texCoord": 1},
        "metallicRoughnessTexture": {"index": 1},
    }
    material = {
        "pbrMetallicRoughness": pbr,
        **({} if normal is None else {"normalTexture": {"index": 2, "texCoord": 1}}),
    }
    kinds = (
        (5126, "VEC3", 81),
        (5126, "VEC3", 81),
        (5126, "VEC2", 81),
        (5126, "VEC2", 81),
        (5123, "SCALAR", 384),
    )
    attributes = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2, "TEXCOORD_1": 3}
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 4, "material": 0}]}],
        "accessors": [
            {"bufferView": k, "componentType": t, "count": n, "type": kind}
            for k, (t, kind, n) in enumerate(kinds)
        ],
        "materials": [material],
        "textures": [{"source": k} for k in range(len(pictures))],
        "images": [{"bufferView": 5 + k, "mimeType": "image/png"} for k in range(len(pictures))],
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    write_glb(path, document, binary)
    return load(path)


def smooth(size: int, across: int) -> np.ndarray:
    """A picture that repeats itself, without edges."""
    at = (np.arange(size) + 0.5) / size * 2 * np.pi
    wave = 127.5 + 100 * np.sin(across * at)[None, :] * np.cos(at)[:, None]
    return np.repeat(np.rint(wave)[..., None], 3, axis=2).astype(np.uint8)


def read_at(texture, uvs: np.ndarray) -> np.ndarray:
    return bilinear(texture, np.asarray(uvs, np.float64))


@pytest.mark.parametrize("scale", [(1.0, 1.0), (2.0, 1.0), (0.5, 3.0)])
def test_textures_of_two_sets_of_coordinates_are_brought_into_one(
    tmp_path: Path, scale: tuple[float, float]
) -> None:
    color, orm = smooth(64, 2), smooth(64, 1)
    second = lambda uv: uv[:, ::-1] * scale + (0.25, 0.125)  # noqa: E731
    asset = two_sets(tmp_path / "x.glb", color, orm, None, second)
    mesh = asset.meshes[0]
    assert mesh.uvs is not None and mesh.uvs.shape[1] == 2
    first = np.stack([mesh.positions[:, 0], 1 - mesh.positions[:, 1]], axis=1)
    material = mesh.material
    # a face's middle, where the coordinates are the means of its corners'
    middle = lambda uv: np.asarray(uv)[mesh.faces].mean(axis=1)  # noqa: E731
    for texture, pixels, at in (
        (material.base_color_texture, color, second(first)),
        (material.orm_texture, orm, first),
    ):
        want = read_at(replace(texture, pixels=pixels, wrap=("repeat", "repeat")), middle(at))
        got = read_at(texture, middle(mesh.uvs))
        assert np.abs(got - want).max() < 6  # of 255: twice interpolated, and rounded
    assert [
        n for n in asset.notes if "resampled to one set" in n and "base color" in n and "orm" in n
    ]


def test_the_normal_map_turns_with_the_coordinates_it_is_drawn_into(tmp_path: Path) -> None:
    """All faces lie over each other in the second set, which cannot lead; there u runs up and v to
    the right."""
    color, orm = smooth(64, 1), smooth(64, 1)
    tilted = np.full((8, 8, 3), (230, 128, 200), np.uint8)  # towards the second set's u: up, +y

    def second(uv: np.ndarray) -> np.ndarray:
        return np.stack([np.round(8 * (1 - uv[:, 1])) % 2, np.round(8 * uv[:, 0]) % 2], axis=1)

    asset = two_sets(tmp_path / "x.glb", color, orm, tilted, second)
    mesh = asset.meshes[0]
    normal = mesh.material.normal_texture
    assert normal is not None
    n = read_at(normal, np.asarray(mesh.uvs)[mesh.faces].mean(axis=1)) / 255 * 2 - 1
    # the coordinates go up and down in turns: the normals lie along y, and none along x
    assert np.abs(n[:, 0]).max() < 0.03
    np.testing.assert_allclose(np.abs(n[:, 1]), 0.8, atol=0.03)
    assert {-1.0, 1.0} == set(np.sign(n[:, 1]))


def test_a_second_set_that_repeats_the_first_costs_nothing(tmp_path: Path) -> None:
    color, orm = smooth(16, 1), smooth(16, 2)
    asset = two_sets(tmp_path / "x.glb", color, orm, None, lambda uv: uv)
    material = asset.meshes[0].material
    assert material.base_color_texture is not None
    np.testing.assert_array_equal(material.base_color_texture.pixels, color)
    assert not [n for n in asset.notes if "resampled" in n]
