"""Blender's route to a light mesh: decimate and unwrap. Runs in Blender's own Python, not in ours:

    BPY/bin/python experiments/quality/blender_simplify.py HIGH.glb TRIANGLES LOW.glb

The maps are baked afterwards by experiments/baking/blender_bake.py.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "baking"))

import bpy
from blender_bake import load


def main(high: str, triangles: int, out: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh = load(high)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    # the file's seams are no borders of the surface: without this the decimation tears it
    bpy.ops.mesh.remove_doubles(threshold=1e-6 * max(mesh.dimensions))
    bpy.ops.object.mode_set(mode="OBJECT")
    mesh.data.calc_loop_triangles()
    modifier = mesh.modifiers.new("decimate", "DECIMATE")
    modifier.use_collapse_triangulate = True
    modifier.ratio = triangles / len(mesh.data.loop_triangles)
    bpy.ops.object.modifier_apply(modifier=modifier.name)
    mesh.data.materials.clear()
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.uv.smart_project(angle_limit=math.radians(66), island_margin=0.004)
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.object.shade_smooth()
    bpy.ops.object.select_all(action="DESELECT")
    mesh.select_set(True)
    bpy.ops.export_scene.gltf(
        filepath=out, use_selection=True, export_normals=True, export_materials="NONE"
    )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3])
