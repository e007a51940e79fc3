"""Mitsuba in a process of its own, for `appearance-opt convert command 'python
scenes/mitsuba_program.py SCENE.xml' --triangles 3000 --out out.glb`: the scene in its own light.

It uses nothing but Mitsuba and NumPy; docs/black_boxes.md tells the protocol."""

import json
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb" if len(sys.argv) > 2 and sys.argv[2] == "scalar" else "llvm_ad_rgb")


def sensor(view: dict, resolution: int) -> mi.Sensor:
    """The camera of a view, whose images have coverage in their alpha channel."""
    half = float(np.linalg.norm(view["right"]))
    target = [e + f for e, f in zip(view["eye"], view["forward"], strict=True)]
    up = [-d for d in view["down"]]
    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "pixel_format": "rgba"}
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(half))),
            "to_world": mi.ScalarTransform4f().look_at(origin=view["eye"], target=target, up=up),
            "near_clip": 1e-3,
            "film": {**film, "component_format": "float32", "rfilter": {"type": "box"}},
        }
    )


folder = Path(json.loads(sys.stdin.readline())["folder"])
scene = mi.load_file(sys.argv[1])
box = scene.bbox()
bounds = [np.ravel(box.min).tolist(), np.ravel(box.max).tolist()]
# lights are not to be seen: their radiance is no part of the object
integrator = mi.load_dict({"type": "path", "max_depth": 6, "hide_emitters": True})
print(json.dumps({"bounds": bounds, "light": "static"}), flush=True)
for line in sys.stdin:
    request = json.loads(line)
    for view in request["views"]:
        camera, name = sensor(view, request["resolution"]), f"{view['id']}.raw"
        image = mi.render(
            scene, sensor=camera, integrator=integrator, spp=max(64, request["samples"])
        )
        np.clip(np.array(image, "<f4"), 0, [10, 10, 10, 1]).astype("<f4").tofile(folder / name)
        print(json.dumps({"id": view["id"], "file": name}), flush=True)
