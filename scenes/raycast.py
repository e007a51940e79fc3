"""A renderer in forty lines of NumPy, for `appearance-opt convert command 'python
scenes/raycast.py' --triangles 1000 --out balls.glb`: three matt balls under a lamp.

The protocol is told in docs/black_boxes.md."""

import json
import sys
from pathlib import Path

import numpy as np

BALLS = np.array([[-0.6, 0, 0, 0.6], [0.5, 0.2, 0.1, 0.5], [0, 0.7, -0.2, 0.35]])  # x, y, z, radius
COLORS = np.array([[0.8, 0.2, 0.1], [0.1, 0.5, 0.8], [0.9, 0.8, 0.2]])
FINE = 3  # squared rays in every pixel


def render(view: dict, resolution: int) -> np.ndarray:
    """(resolution, resolution, 4) float32: linear, premultiplied by coverage, rows downward."""
    at = (np.arange(FINE * resolution) + 0.5) / (FINE * resolution) * 2 - 1
    eye, forward, right, down, light = (
        np.array(view[k]) for k in ("eye", "forward", "right", "down", "light")
    )
    ray = forward + at[None, :, None] * right + at[:, None, None] * down
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    nearest, image = np.full(ray.shape[:2], np.inf), np.zeros((*ray.shape[:2], 4))
    for (*centre, radius), color in zip(BALLS, COLORS, strict=True):
        o = eye - centre
        b = ray @ o
        under = b * b - o @ o + radius**2
        t = -b - np.sqrt(np.maximum(under, 0))
        first = (under > 0) & (t < nearest)
        nearest[first] = t[first]
        normal = (o + ray * t[..., None]) / radius
        way = light - eye - ray * t[..., None]
        lit = np.maximum(np.sum(normal * way, -1), 0) / np.linalg.norm(way, axis=-1) ** 3
        rgba = np.append(color / np.pi * view["intensity"], 1)
        image[first] = (rgba * np.append(lit[..., None].repeat(3, 2), lit[..., None] * 0 + 1, 2))[
            first
        ]
    return image.reshape(resolution, FINE, resolution, FINE, 4).mean((1, 3)).astype("<f4")


folder = Path(json.loads(sys.stdin.readline())["folder"])
corners = np.stack([BALLS[:, :3] - BALLS[:, 3:], BALLS[:, :3] + BALLS[:, 3:]])
bounds = [corners[0].min(0).tolist(), corners[1].max(0).tolist()]
print(json.dumps({"bounds": bounds, "light": "point"}), flush=True)
for line in sys.stdin:
    request = json.loads(line)
    for asked in request["views"]:
        name = f"{asked['id']}.raw"
        render(asked, request["resolution"]).tofile(folder / name)
        print(json.dumps({"id": asked["id"], "file": name}), flush=True)
