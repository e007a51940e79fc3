"""Blender's Cycles: each file imported as a user would do it, materials untouched.

    BLENDER_PYTHON blender_views.py VIEWS.json OUTDIR NAME=FILE ... [--res 192] [--spp 48] [--shadows]

A program for a Python that has ``bpy``. FILE is .glb, .gltf or .usd*. Writes OUTDIR/NAME_k.png
(RGBA, sRGB).
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import bpy  # type: ignore[import-not-found]
from mathutils import Matrix, Vector  # type: ignore[import-not-found]


def z_up(p: list[float]) -> Any:
    """glTF's axes to Blender's."""
    return Vector((p[0], -p[2], p[1]))


def prepare(options: argparse.Namespace) -> None:
    """Direct light alone, a box filter, nothing denoised."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    c = scene.cycles
    c.device, c.samples, c.use_denoising, c.use_adaptive_sampling = "CPU", options.spp, False, False
    c.max_bounces = c.diffuse_bounces = c.glossy_bounces = 0
    c.pixel_filter_type, c.filter_width = "BOX", 1.0
    c.sample_clamp_direct = c.sample_clamp_indirect = 0
    scene.render.resolution_x = scene.render.resolution_y = options.res
    scene.render.film_transparent = True
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGBA"
    scene.view_settings.view_transform = "Standard"
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[1].default_value = 0
    for material in bpy.data.materials:
        if options.no_bump_correction:
            owner = material if hasattr(material, "use_bump_map_correction") else material.cycles
            owner.use_bump_map_correction = False


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("views", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("files", nargs="+")
    parser.add_argument("--res", type=int, default=192)
    parser.add_argument("--spp", type=int, default=48)
    parser.add_argument("--shadows", action="store_true")
    parser.add_argument("--no-bump-correction", action="store_true")
    a = parser.parse_args()
    job = json.loads(a.views.read_text())
    for item in a.files:
        name, path = item.split("=", 1)
        bpy.ops.wm.read_factory_settings(use_empty=True)
        if path.endswith((".glb", ".gltf")):
            bpy.ops.import_scene.gltf(filepath=path)
        else:
            bpy.ops.wm.usd_import(filepath=path)
        for found in [o for o in bpy.data.objects if o.type in ("LIGHT", "CAMERA")]:
            bpy.data.objects.remove(found)
        prepare(a)
        scene = bpy.context.scene
        scene.camera = camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "POINT"))
        scene.collection.objects.link(camera)
        scene.collection.objects.link(lamp)
        lamp.data.shadow_soft_size = 0
        lamp.data.use_shadow = a.shadows
        for k, view in enumerate(job["views"]):
            o, f, u = (z_up(view[n]) for n in ("eye", "forward", "up"))
            r = f.cross(u)
            rows = [(r[i], u[i], -f[i], o[i]) for i in range(3)]
            camera.matrix_world = Matrix((*rows, (0, 0, 0, 1)))
            camera.data.sensor_fit, camera.data.angle = "HORIZONTAL", math.radians(view["fov"])
            camera.data.clip_start = job["radius"] * 1e-2
            camera.data.clip_end = job["radius"] * 100
            lamp.location = z_up(view["light"])
            lamp.data.energy = view["intensity"] * 4 * math.pi
            scene.render.filepath = str(a.out.resolve() / f"{name}_{k}.png")
            bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main()
