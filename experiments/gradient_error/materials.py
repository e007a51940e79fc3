"""Gradients of texels, channel by channel, against finite differences of supersampled images.

    python -m experiments.gradient_error.materials

Two scenes: a ball whose maps are magnified, and one whose maps are minified (4 to 8 texels per
pixel: its gradients pass through the mip pyramid). A direction is a smooth wave over all texels of
a channel.
"""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from appearance_opt import backend
from appearance_opt.initial.sphere import sphere
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.texels import TEXELS, TexelCodec, Texels
from appearance_opt.optimize.losses import LOSSES
from appearance_opt.optimize.step import Gradients, StepInputs
from appearance_opt.reference.pool import Targets
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.boundary.edges import Edges
from appearance_opt.render.images import render_image
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.quality import Quality
from appearance_opt.views import ViewSampler
from experiments.gradient_error.metrics import error_of
from experiments.gradient_error.problems import BACKGROUND
from experiments.gradient_error.reference import pixel_losses

CHANNELS = ("red", "roughness", "metalness", "normal_x", "normal_y")
FIELDS, SAMPLES, STEP = 10, 64, 2e-3
SCENES = {
    "magnified, 64² texels on 128² pixels": (64, 128),
    "minified, 512² texels on 64² pixels": (512, 64),
}
SETTINGS = {
    "1 sample": Quality(visibility=CameraRays(samples=4)),
    "4 samples": Quality(4, visibility=CameraRays((Edges(4.0),))),
    "16 samples": Quality(16, visibility=CameraRays((Edges(8.0),), 16)),
}


def main() -> None:
    backend.select("cpu")
    lines = [
        "| scene | channel | samples per pixel | error | cosine | bias |",
        "|---|---|---|---|---|---|",
    ]
    for scene, (size, resolution) in SCENES.items():
        for line in measure(scene, size, resolution):
            print(line, flush=True)
            lines.append(line)
    out = Path("out/gradient_error/materials.md")
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text("\n".join(lines) + "\n")


def wavy_maps(size: int) -> dict[str, NDArray[np.float32]]:
    """Smooth maps that vary by about a fifth, a few waves across."""
    v, u = np.meshgrid(*[(np.arange(size) + 0.5) / size * 2 * np.pi] * 2, indexing="ij")
    middle = {"red": 0.5, "green": 0.4, "blue": 0.3, "roughness": 0.45, "metalness": 0.4}
    maps = {
        k: m + 0.15 * np.sin((2 + i) * u + i) * np.cos(3 * v - i)
        for i, (k, m) in enumerate(middle.items())
    }
    maps["normal_x"] = 0.2 * np.sin(4 * u) * np.cos(2 * v)
    maps["normal_y"] = 0.2 * np.cos(3 * u + 1) * np.sin(4 * v)
    maps["normal_z"] = np.sqrt(1 - maps["normal_x"] ** 2 - maps["normal_y"] ** 2)
    return {k: m.astype(np.float32) for k, m in maps.items()}


def smooth_texel_fields(codec: TexelCodec, channel: str, count: int) -> NDArray[np.float32]:
    """(count, all stored values): plane waves over the texels of one channel."""
    rng = np.random.default_rng(7)
    v, u = np.meshgrid(*[(np.arange(codec.size) + 0.5) / codec.size] * 2, indexing="ij")
    out = np.zeros((count, codec.size, codec.size, codec.packed), np.float32)
    for k in range(count):
        a, b = rng.uniform(-4, 4, 2)
        out[k, ..., codec.channels.index(channel)] = np.sin(
            2 * np.pi * (a * u + b * v + rng.random())
        )
    return out.reshape(count, -1)


def measure(scene: str, size: int, resolution: int) -> list[str]:
    """Table lines of one scene."""
    mesh = sphere(768, (0.0, 0.0, 0.0), 0.85, size)
    maps = wavy_maps(size)
    model = latent_of(mesh, {**maps}, frozenset(("normal", "material")), Rates())
    texels = model.fitted(Texels)
    assert texels is not None
    codec = texels.codec
    grid, views = (
        Grid(1, resolution),
        ViewSampler((0.0, 0.0, 0.0), 1.0, seed=2, light_spread=40.0).draw(0, 1),
    )
    batch = Batch(views.records(), grid)
    parameter = model.parameters[TEXELS]
    start = np.array(parameter.value)
    behind = np.array(BACKGROUND)

    def image(stored: NDArray) -> NDArray[np.float64]:
        parameter.value = mi.Float(stored)
        with dr.suspend_grad():
            flat = render_image(model.drawn(), batch, SAMPLES, SAMPLES**-0.5)
        pixels = np.array(flat).reshape(-1, 4).astype(np.float64)
        return pixels[:, :3] + (1 - pixels[:, 3:]) * behind

    brighter = start.reshape(-1, codec.packed) * np.float32(0.9)
    target = image(brighter.ravel())
    rgba = np.ones((len(target), 4), np.float32)
    rgba[:, :3] = target
    inputs = StepInputs(
        views, Targets(mi.Float(rgba.ravel())), behind[None].astype(np.float32), 0.0, 0.0, 0
    )
    lines = []
    for channel in CHANNELS:
        fields = smooth_texel_fields(codec, channel, FIELDS)
        truth = np.zeros(FIELDS)
        for k, field in enumerate(fields):
            values = [
                pixel_losses("log-srgb-l1", image(start + s * STEP * field), target)
                for s in (1, -1)
            ]
            truth[k] = (values[0] - values[1]) / (2 * STEP) / (3 * grid.pixels)
        parameter.value = mi.Float(start)
        for name, quality in SETTINGS.items():
            _, grads = Gradients(model, grid, quality, LOSSES["log-srgb-l1"], freeze=False)(inputs)
            e = error_of((np.array(grads[TEXELS]).astype(np.float64) @ fields.T)[None], truth)
            lines.append(
                f"| {scene} | {channel} | {name} | {e.relative:.4f} | {e.cosine:.5f} | {100 * e.bias:+.2f} % |"
            )
    return lines


if __name__ == "__main__":
    main()
