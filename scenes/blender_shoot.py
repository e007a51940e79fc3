"""Take pictures of what a .blend file shows, and write them as a folder that
`appearance-opt convert images FOLDER/transforms.json` reads. Blender runs it:

    blender -b vase.blend -P scenes/blender_shoot.py -- shots 100 400

(folder, number of pictures, pixels per side). The light is that of the file and stands still; the
world is left out of the pictures (transparent film), but shines. With the bpy package:
`python scenes/blender_shoot.py vase.blend shots 100 400`."""

import json
import math
import os
import sys

import bpy
from mathutils import Vector

FIELD_OF_VIEW = math.radians(32)


def corners():
    """Corners of the boxes of all visible meshes, in the world."""
    for thing in bpy.context.scene.objects:
        if thing.type == "MESH" and not thing.hide_render:
            yield from (thing.matrix_world @ Vector(corner) for corner in thing.bound_box)


def directions(count):
    """Unit vectors that are spread evenly (a Fibonacci lattice)."""
    for k in range(count):
        z = 1 - (2 * k + 1) / count
        turn = math.pi * (1 + 5**0.5) * k
        yield Vector((math.cos(turn), math.sin(turn), 0)) * math.sqrt(1 - z * z) + Vector((0, 0, z))


def shoot(folder, count, resolution):
    """Write the pictures and their transforms.json (z is up, as in Blender)."""
    scene, points = bpy.context.scene, list(corners())
    if not points:
        sys.exit("error: the file shows no meshes")
    low, high = (Vector(f(p[k] for p in points) for k in range(3)) for f in (min, max))
    centre, radius = (low + high) / 2, (high - low).length / 2
    data = bpy.data.cameras.new("shoot")
    data.angle, data.clip_end = FIELD_OF_VIEW, 100 * radius
    camera = bpy.data.objects.new("shoot", data)
    scene.collection.objects.link(camera)
    scene.camera = camera
    render = scene.render
    render.resolution_x = render.resolution_y = resolution
    render.resolution_percentage, render.film_transparent = 100, True
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGBA"
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    frames = []
    for k, way in enumerate(directions(count)):
        camera.location = centre + way * (1.05 * radius / math.sin(FIELD_OF_VIEW / 2))
        camera.rotation_mode = "QUATERNION"
        camera.rotation_quaternion = (-way).to_track_quat("-Z", "Y")
        bpy.context.view_layer.update()
        name = f"images/{k:04d}.png"
        render.filepath = os.path.join(os.path.abspath(folder), name)  # noqa: PTH100, PTH118
        bpy.ops.render.render(write_still=True)
        pose = [list(row) for row in camera.matrix_world]
        frames.append({"file_path": name, "transform_matrix": pose})
    table = {
        "up": "z",
        "light": "static",
        "w": resolution,
        "h": resolution,
        "camera_angle_x": data.angle,
        "bounds": [list(low), list(high)],
        "frames": frames,
    }
    with open(os.path.join(folder, "transforms.json"), "w") as file:  # noqa: PTH118
        json.dump(table, file, indent=1)


if __name__ == "__main__":
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    if words and words[0].endswith(".blend"):
        bpy.ops.wm.open_mainfile(filepath=words.pop(0))
    if not 1 <= len(words) <= 3:
        sys.exit(__doc__)
    shoot(words[0], *(int(w) for w in (*words[1:], *("100", "400")[len(words) - 1 :])))
