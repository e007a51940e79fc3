"""What glTF's nodes and the lack of normals make of a mesh: flat shading, skins, instances,
reflections, extensions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from appearance_opt.asset import images, load, save
from appearance_opt.asset.normals import unit, vertex_normals
from appearance_opt.asset.tangents import split_and_tangents
from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.errors import InputError
from appearance_opt.initial.decimate import decimate
from tests.test_asset_gltf import triangle_document, write_glb

TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
CODES = {"float32": 5126, "uint8": 5121, "uint16": 5123, "uint32": 5125, "int16": 5122}


def document(
    attributes: dict[str, np.ndarray],
    faces: np.ndarray | None = None,
    more: tuple[np.ndarray, ...] = (),
    **top: object,
) -> tuple[dict, bytes]:
    """One primitive. Accessors: its attributes in their order, ``more``, its faces. ``top``: other
    top-level keys."""
    arrays = [
        *attributes.values(),
        *more,
        *([] if faces is None else [faces.reshape(-1, 1).astype(np.uint32)]),
    ]
    views, accessors, binary = [], [], b""
    for k, a in enumerate(arrays):
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": a.nbytes})
        accessors.append(
            {
                "bufferView": k,
                "componentType": CODES[str(a.dtype)],
                "count": len(a),
                "type": TYPES[a.shape[1]],
            }
        )
        binary += a.tobytes() + b"\0" * (-a.nbytes % 4)
    primitive: dict = {"attributes": {n: k for k, n in enumerate(attributes)}}
    if faces is not None:
        primitive["indices"] = len(arrays) - 1
    given, _ = triangle_document(
        meshes=[{"primitives": [primitive]}],
        accessors=accessors,
        bufferViews=views,
        buffers=[{"byteLength": len(binary)}],
        **top,
    )
    return given, binary


def ball(subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions)
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)


def test_a_mesh_without_normals_is_flat(tmp_path: Path) -> None:
    positions, faces = ball(1)
    uvs = positions[:, :2].copy()
    write_glb(tmp_path / "x.glb", *document({"POSITION": positions, "TEXCOORD_0": uvs}, faces))
    asset = load(tmp_path / "x.glb")
    mesh = asset.meshes[0]
    np.testing.assert_array_equal(mesh.positions[mesh.faces], positions[faces])
    np.testing.assert_array_equal(mesh.uvs[mesh.faces], uvs[faces])
    p = positions[faces].astype(np.float64)
    own = unit(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]))
    np.testing.assert_allclose(
        mesh.normals[mesh.faces], np.repeat(own[:, None], 3, axis=1), atol=1e-6
    )
    assert any("flat" in n for n in asset.notes)


def test_corners_of_one_plane_go_on_sharing_their_vertices(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    write_glb(
        tmp_path / "x.glb", *document({"POSITION": box.vertices.astype(np.float32)}, box.faces)
    )
    mesh = load(tmp_path / "x.glb").meshes[0]
    assert len(mesh.faces) == 12
    assert len(np.unique(np.concatenate([mesh.positions, mesh.normals], axis=1), axis=0)) == 24


def test_normals_of_the_file_stay(tmp_path: Path) -> None:
    positions, faces = ball(1)
    write_glb(tmp_path / "x.glb", *document({"POSITION": positions, "NORMAL": positions}, faces))
    asset = load(tmp_path / "x.glb")
    assert len(asset.meshes[0].positions) == len(positions)
    assert not asset.notes


def test_tangents_without_normals_are_ignored(tmp_path: Path) -> None:
    positions, faces = ball(1)
    tangents = np.tile(np.float32([1, 0, 0, 1]), (len(positions), 1))
    write_glb(tmp_path / "x.glb", *document({"POSITION": positions, "TANGENT": tangents}, faces))
    assert load(tmp_path / "x.glb").meshes[0].tangents is None


def test_flat_triangles_stay_connected_in_decimation(tmp_path: Path) -> None:
    positions, faces = ball(3)
    write_glb(tmp_path / "x.glb", *document({"POSITION": positions}, faces))
    mesh = load(tmp_path / "x.glb").meshes[0]
    assert len(mesh.positions) == 3 * len(faces)
    p, f = decimate(mesh.positions, mesh.faces, 100)
    expected, same = decimate(positions, faces, 100)
    assert 90 < len(f) <= 100
    assert trimesh.Trimesh(p, f, process=False).is_watertight
    assert len(f) == len(same)
    assert (
        np.abs(np.linalg.norm(p, axis=1) - 1).max()
        < np.abs(np.linalg.norm(expected, axis=1) - 1).max() + 0.02
    )


def test_a_mesh_to_bake_onto_keeps_its_vertices_and_coordinates(tmp_path: Path) -> None:
    """To the last bit, whatever transform its old material has; a texture that would need it is
    noted."""
    positions, faces = ball(1)
    uvs = np.random.default_rng(0).random((len(positions), 2)).astype(np.float32)
    (tmp_path / "t.png").write_bytes(images.encode_png(np.zeros((2, 2, 3), np.uint8)))
    tiled = {"index": 0, "extensions": {"KHR_texture_transform": {"scale": [4, 4]}}}
    top = {
        "materials": [{"name": "old", "pbrMetallicRoughness": {"baseColorTexture": tiled}}],
        "textures": [{"source": 0}],
        "images": [{"uri": "t.png"}],
        "extensionsUsed": ["KHR_texture_transform"],
    }
    given, binary = document({"POSITION": positions, "TEXCOORD_0": uvs}, faces, **top)
    given["meshes"][0]["primitives"][0]["material"] = 0
    write_glb(tmp_path / "x.glb", given, binary)
    asset = load(tmp_path / "x.glb", keep_layout=True)
    mesh = asset.meshes[0]
    np.testing.assert_array_equal(mesh.positions, positions)
    np.testing.assert_array_equal(mesh.faces, faces)
    np.testing.assert_array_equal(mesh.uvs, uvs)
    assert mesh.normals is None
    assert any(
        "material 'old'" in n and "base color" in n and "not applied" in n for n in asset.notes
    )
    np.testing.assert_allclose(load(tmp_path / "x.glb").meshes[0].uvs.max(), 4 * uvs.max())


SHIFT = np.array(
    [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [5, 0, 0, 1]], np.float32
)  # columns, as glTF stores them


def skinned(tmp_path: Path, weights: np.ndarray, joints: list[dict], inverse: np.ndarray) -> Mesh:
    """A triangle bound to two joints, its own node far away."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    attributes = {
        "POSITION": positions,
        "NORMAL": np.tile(np.float32([0, 0, 1]), (3, 1)),
        "TANGENT": np.tile(np.float32([1, 0, 0, 1]), (3, 1)),
        "JOINTS_0": np.tile(np.uint8([0, 1, 0, 0]), (3, 1)),
        "WEIGHTS_0": weights.astype(np.float32),
    }
    top = {
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [
            {"mesh": 0, "skin": 0, "translation": [100, 0, 0]},
            {"children": [2, 3], "scale": [2, 2, 2]},
            *joints,
        ],
        "skins": [{"joints": [2, 3], "inverseBindMatrices": 5}],
    }
    write_glb(tmp_path / "x.glb", *document(attributes, None, (inverse.reshape(2, 16),), **top))
    asset = load(tmp_path / "x.glb")
    assert "skins: the pose at rest is kept; `appearance-opt animate` keeps skins" in asset.notes
    return asset.meshes[0]


def test_skinned_meshes_are_where_their_joints_are(tmp_path: Path) -> None:
    """By hand: joints at 2 (1, 0, 0) and 2 (0, 0, 3); the second one's inverse bind matrix moves by
    (5, 0, 0)."""
    weights = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0.5, 0.5, 0, 0]])
    joints = [{"translation": [1, 0, 0]}, {"translation": [0, 0, 3]}]
    mesh = skinned(tmp_path, weights, joints, np.stack([np.eye(4, dtype=np.float32), SHIFT]))
    first, second = ([2, 0, 0], [2 * 5 + 2 * 1, 0, 6])
    third = (np.array([2, 2, 0]) + np.array([10, 2, 6])) / 2
    np.testing.assert_allclose(mesh.positions[mesh.faces[0]], [first, second, third], atol=1e-6)
    np.testing.assert_allclose(mesh.normals, np.tile([0, 0, 1], (3, 1)), atol=1e-6)


def test_skins_turn_normals_and_tangents(tmp_path: Path) -> None:
    turn = {
        "rotation": [0, np.sqrt(0.5), 0, np.sqrt(0.5)]
    }  # a quarter around y: z becomes x, x becomes -z
    weights = np.tile([0.25, 0.25, 0, 0], (3, 1))  # not normalised
    mesh = skinned(tmp_path, weights, [turn, turn], np.stack([np.eye(4, dtype=np.float32)] * 2))
    np.testing.assert_allclose(mesh.positions[:, 2].min(), -2, atol=1e-6)
    np.testing.assert_allclose(mesh.normals, np.tile([1, 0, 0], (3, 1)), atol=1e-6)
    np.testing.assert_allclose(mesh.tangents, np.tile([0, 0, -1, 1], (3, 1)), atol=1e-6)


def test_a_joint_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="structure is broken"):
        skinned(tmp_path, np.eye(3, 4), [{}], np.stack([SHIFT] * 2))


@pytest.mark.parametrize(
    "scale", [(-2.0, 1.0, 1.0), (1.0, 1.0, -1.0), (-1.0, -1.0, 1.0), (1.0, 1.0, 1.0)]
)
def test_tangents_of_mirrored_nodes_are_those_of_the_mirrored_mesh(
    tmp_path: Path, scale: tuple
) -> None:
    """Against our own MikkTSpace on what was loaded."""
    positions, faces = ball(2)
    uvs = np.stack(
        [np.arctan2(positions[:, 0], 3 + positions[:, 2]), positions[:, 1]], axis=1
    ).astype(np.float32)
    normals = vertex_normals(positions, faces)
    index, new, tangents = split_and_tangents(positions, normals, uvs, faces)
    given = {
        "POSITION": positions[index], "NORMAL": normals[index], "TANGENT": tangents, "TEXCOORD_0": uvs[index],
    }  # fmt: skip
    nodes = [{"mesh": 0, "scale": list(scale)}]
    write_glb(tmp_path / "x.glb", *document(given, new, nodes=nodes))
    mesh = load(tmp_path / "x.glb").meshes[0]
    again, _, expected = split_and_tangents(mesh.positions, mesh.normals, mesh.uvs, mesh.faces)
    np.testing.assert_array_equal(mesh.tangents[again, 3], expected[:, 3])
    # a scale that is not the same in all directions does not commute with the angles that weight
    # tangents
    cosine = np.sum(mesh.tangents[again, :3] * expected[:, :3], axis=1)
    assert np.quantile(cosine, 0.02) > (0.9999 if len({abs(s) for s in scale}) == 1 else 0.98)


def test_instances(tmp_path: Path) -> None:
    """EXT_mesh_gpu_instancing: the node's transform after the instance's."""
    translation = np.array([[1, 0, 0], [0, 5, 0]], np.float32)
    rotation = np.array(
        [[0, 0, 0, 1], [0, 0, 1, 0]], np.float32
    )  # the second one by half a turn around z
    scale = np.array([[1, 1, 1], [3, 3, 3]], np.float32)
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    attributes = {"TRANSLATION": 1, "ROTATION": 2, "SCALE": 3}
    instancing = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    nodes = [{"mesh": 0, "translation": [0, 0, 7], "extensions": instancing}]
    given, binary = document(
        {"POSITION": positions}, None, (translation, rotation, scale), nodes=nodes,
        extensionsUsed=list(instancing), extensionsRequired=list(instancing),
    )  # fmt: skip
    write_glb(tmp_path / "x.glb", given, binary)
    asset = load(tmp_path / "x.glb")
    (mesh,) = asset.meshes  # one holds all places
    first, second = mesh.positions[mesh.faces]
    np.testing.assert_allclose(first, [[1, 0, 7], [2, 0, 7], [1, 1, 7]], atol=1e-6)
    np.testing.assert_allclose(second, [[0, 5, 7], [-3, 5, 7], [0, 2, 7]], atol=1e-6)
    assert not any("EXT_mesh_gpu_instancing" in n for n in asset.notes)
    given["accessors"][2]["count"] = 1
    write_glb(tmp_path / "x.glb", given, binary)
    with pytest.raises(InputError, match="differ in length"):
        load(tmp_path / "x.glb")


def test_extensions_that_a_file_requires(tmp_path: Path) -> None:
    for name, fine in (
        ("KHR_materials_clearcoat", True),
        ("KHR_animation_pointer", True),
        ("ACME_voxels", False),
    ):
        write_glb(
            tmp_path / "x.glb", *triangle_document(extensionsUsed=[name], extensionsRequired=[name])
        )
        if fine:
            assert f"extension {name} ignored" in load(tmp_path / "x.glb").notes
        else:
            with pytest.raises(InputError, match=r"x\.glb: requires the extension 'ACME_voxels'"):
                load(tmp_path / "x.glb")


def test_morph_targets_are_noted(tmp_path: Path) -> None:
    given, binary = triangle_document()
    given["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 0}]
    write_glb(tmp_path / "x.glb", given, binary)
    assert any("morph targets" in note for note in load(tmp_path / "x.glb").notes)


def test_what_was_written_without_normals_is_read_flat(tmp_path: Path) -> None:
    positions, faces = ball(1)
    texture = Texture(np.full((2, 2, 3), 9, np.uint8), "srgb")
    mesh = Mesh(
        positions, faces, uvs=positions[:, :2].copy(), material=Material(base_color_texture=texture)
    )
    save(Asset((replace(mesh, name="m"),)), tmp_path / "x.glb")
    assert len(load(tmp_path / "x.glb").meshes[0].positions) == 3 * len(faces)
