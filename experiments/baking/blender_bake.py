"""Blender's "selected to active" bake of one pair of meshes. Runs in Blender's own Python, not in
ours:

    BPY/bin/python experiments/baking/blender_bake.py HIGH.glb LOW.glb OUT_FOLDER SIZE EXTRUSION SAMPLES

where BPY is a virtual environment with the package ``bpy`` (see experiments/baking/__main__.py).
Writes normal.npy, base_color.npy, roughness.npy and metalness.npy ((SIZE, SIZE, 3) uint16, row 0 on
top, linear but the colour, which is sRGB) and seconds.json into OUT_FOLDER. LOW keeps the normals
and texture coordinates of its file.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import bpy


def load(path: str) -> bpy.types.Object:
    """All meshes of a GLB as one object."""
    bpy.ops.object.select_all(action="DESELECT")
    bpy.ops.import_scene.gltf(filepath=path)
    meshes = [o for o in bpy.context.selected_objects if o.type == "MESH"]
    for o in bpy.context.selected_objects:
        o.select_set(o in meshes)
    bpy.context.view_layer.objects.active = meshes[0]
    if len(meshes) > 1:
        bpy.ops.object.join()
    joined = bpy.context.view_layer.objects.active
    bpy.ops.object.parent_clear(type="CLEAR_KEEP_TRANSFORM")
    bpy.ops.object.transform_apply(location=True, rotation=True, scale=True)
    return joined


def emit(materials: list[bpy.types.Material], socket: str) -> None:
    """Send an input of every principled shader to the output as emission: what has no pass of its
    own is baked so."""
    for material in materials:
        tree = material.node_tree
        shader = next((n for n in tree.nodes if n.type == "BSDF_PRINCIPLED"), None)
        output = next(n for n in tree.nodes if n.type == "OUTPUT_MATERIAL")
        emission = tree.nodes.new("ShaderNodeEmission")
        source = shader.inputs[socket]
        if source.is_linked:
            tree.links.new(source.links[0].from_socket, emission.inputs["Color"])
        else:
            value = source.default_value
            emission.inputs["Color"].default_value = (
                tuple(value) if socket == "Base Color" else (value,) * 3 + (1,)
            )
        tree.links.new(emission.outputs[0], output.inputs["Surface"])


def target_image(low: bpy.types.Object, name: str, size: int) -> bpy.types.Image:
    """An image that LOW's only material is baked to."""
    image = bpy.data.images.new(name, size, size, float_buffer=True, is_data=name != "base_color")
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    material.node_tree.nodes.active = node
    low.data.materials.clear()
    low.data.materials.append(material)
    for polygon in low.data.polygons:
        polygon.material_index = 0
    return image


def write(image: bpy.types.Image, path: Path, srgb: bool) -> None:
    """(size, size, 3) uint16, without any view transform."""
    import numpy as np

    size = image.size[0]
    pixels = np.empty(size * size * 4, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(size, size, 4)[::-1, :, :3]
    if srgb:
        pixels = np.where(
            pixels <= 0.0031308,
            pixels * 12.92,
            1.055 * np.maximum(pixels, 1e-9) ** (1 / 2.4) - 0.055,
        )
    np.save(path, (np.clip(pixels, 0, 1) * 65535 + 0.5).astype(np.uint16))


def main(
    high_path: str, low_path: str, out: str, size: int, extrusion: float, samples: int
) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    bake = scene.render.bake
    bake.use_selected_to_active = True
    bake.cage_extrusion = extrusion
    bake.max_ray_distance = 2 * extrusion
    bake.margin = 8
    high, low = load(high_path), load(low_path)
    bpy.ops.object.select_all(action="DESELECT")
    high.select_set(True)
    low.select_set(True)
    bpy.context.view_layer.objects.active = low
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    seconds = {}
    materials = [m for m in high.data.materials if m is not None]
    for name, socket in (
        ("normal", ""),
        ("base_color", "Base Color"),
        ("roughness", "Roughness"),
        ("metalness", "Metallic"),
    ):
        image = target_image(low, name, size)
        if socket:
            emit(materials, socket)
        begin = time.perf_counter()
        bpy.ops.object.bake(type="EMIT" if socket else "NORMAL", normal_space="TANGENT")
        seconds[name] = time.perf_counter() - begin
        write(image, folder / f"{name}.npy", name == "base_color")
    (folder / "seconds.json").write_text(json.dumps(seconds))


if __name__ == "__main__":
    a = sys.argv[1:]
    main(a[0], a[1], a[2], int(a[3]), float(a[4]), int(a[5]))
