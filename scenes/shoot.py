"""Take pictures of a Mitsuba scene or an asset, and write them as a folder that
`appearance-opt convert images FOLDER/transforms.json` reads.

    python -m scenes.shoot vase.xml shots --views 100 --resolution 400
    python -m scenes.shoot chair.glb shots --light headlight
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt import backend
from appearance_opt.asset import load
from appearance_opt.asset.images import encode_exr, encode_png
from appearance_opt.asset.types import linear_to_srgb
from appearance_opt.errors import AppearanceError
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.reference.scene import SceneReference
from appearance_opt.reference.subject import Subject, corners_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.reference.base import Reference
    from appearance_opt.views import Views

BATCH = 4


def shoot(
    reference: Reference,
    folder: Path,
    count: int = 100,
    resolution: int = 400,
    light: str = "static",
    exr: bool = False,
    seed: int = 0,
) -> Views:
    """Write ``count`` pictures of a reference, from all around, framed to its bounds, with a
    transforms.json. ``light``: "static" (of the scene), "headlight" or "point". PNG ends at a
    radiance of 1, EXR does not. Returns the views in its coordinates."""
    kind = "point" if light == "static" else light
    subject = Subject.of_reference(reference, seed, kind)
    local = replace(subject.sampler, hull=None).draw(0, count)
    views = subject.placement.views_to_world(local)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    frames = []
    for first in range(0, count, BATCH):
        some = views[first : first + BATCH]
        for k, image in enumerate(reference.render(some, resolution, 16)):
            name = f"images/{first + k:04d}.{'exr' if exr else 'png'}"
            (folder / name).write_bytes(encode_exr(image) if exr else straight_png(image))
            frames.append(frame_of(some, k, name, light))
    bounds = corners_of(reference.bounds)
    table = {
        "up": "y",
        "w": resolution,
        "h": resolution,
        "bounds": [bounds.min(axis=0).tolist(), bounds.max(axis=0).tolist()],
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(table, indent=1))
    return views


def frame_of(views: Views, k: int, name: str, light: str) -> dict[str, Any]:
    """An entry of ``frames``: OpenGL's camera looks along -z, y up."""
    right, down, forward = (
        getattr(views, n)[k].astype(np.float64) for n in ("right", "down", "forward")
    )
    half = np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right / half, -down / half, -forward, views.eye[k]], axis=1)
    out: dict[str, Any] = {
        "file_path": name,
        "camera_angle_x": float(2 * np.arctan(half)),
        "transform_matrix": pose.tolist(),
    }
    if light != "static":
        out["light"] = {"type": light, "intensity": float(views.intensity[k])}
        if light == "point":
            out["light"]["position"] = views.light[k].tolist()
    return out


def straight_png(image: NDArray[np.float32]) -> bytes:
    """sRGB with straight alpha of linear premultiplied values (H, W, 4)."""
    alpha = np.clip(image[..., 3:], 0, 1)
    color = linear_to_srgb(np.clip(image[..., :3] / np.maximum(alpha, 1e-6), 0, 1))
    return encode_png((np.concatenate([color, alpha], -1) * 255 + 0.5).astype(np.uint8))


def main(arguments: list[str]) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", help="a Mitsuba scene (.xml), or an asset (.glb .usd .obj ...)")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--resolution", type=int, default=400)
    parser.add_argument("--light", choices=("static", "headlight", "point"))
    parser.add_argument("--shape", help="id of the only shape of a scene that is shown")
    parser.add_argument("--samples", type=int, default=64, help="paths per pixel of a scene")
    parser.add_argument("--exr", action="store_true", help="radiance above 1 is kept")
    given = parser.parse_args(arguments)
    backend.select()
    light = given.light
    if given.source.endswith(".xml"):
        light = light or "static"
        kind = "scene" if light == "static" else "point"
        reference: Any = SceneReference(given.source, given.shape, kind, given.samples)
    else:
        if light == "static":
            parser.error("an asset has no light of its own: take headlight or point")
        light = light or "point"
        reference = MeshReference(load(given.source))
    shoot(reference, given.folder, given.views, given.resolution, light, given.exr)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except AppearanceError as error:
        sys.exit(f"error: {error}")
