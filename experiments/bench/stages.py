"""Where the time of a step goes: every stage alone, the device idle before and after it.

    python -m experiments.bench.stages

The stages add up to more than a step: a step overlaps Python with the kernels of the stage before.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt import backend
from appearance_opt.latent.positions import POSITIONS
from appearance_opt.latent.texels import TEXELS, Texels
from appearance_opt.optimize import adam
from appearance_opt.optimize.losses import LOSSES, Target, compared_pixels, covered_loss, image_loss
from appearance_opt.render import gradient
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.drawn import Shown
from appearance_opt.render.freezing import Frozen
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.quality import Quality
from appearance_opt.stages.fitting import point_width
from experiments.bench.scene import set_up

if TYPE_CHECKING:
    from appearance_opt.latent.latent import Decoded

REPEATS = 15


def main() -> None:
    backend.select("cpu")
    print("| stage | 4 x 256^2, 512^2 maps (ms) | 4 x 512^2, 1024^2 maps (ms) |\n|---|---|---|")
    small, large = stages(256, 512), stages(512, 1024)
    for name, value in small.items():
        print(f"| {name} | {value:.1f} | {large[name]:.1f} |")


class Stopwatch:
    """Median ``milliseconds`` of named stages."""

    def __init__(self) -> None:
        self.milliseconds: dict[str, float] = {}

    def timed(self, name: str, work: Callable[[], object]) -> object:
        """Time ``work`` several times, the device idle before and after; returns its last
        result."""
        times = []
        for _ in range(REPEATS):
            dr.sync_thread()
            began = time.perf_counter()
            result = work()
            dr.eval(result)
            dr.sync_thread()
            times.append(1e3 * (time.perf_counter() - began))
        self.milliseconds[name] = float(np.median(times[3:]))
        return result


def stages(resolution: int, maps: int) -> dict[str, float]:
    """Median milliseconds of each stage."""
    source, model, sampler = set_up(3000, 100_000, maps)
    grid, quality = (
        Grid(4, resolution),
        Quality(point_width=point_width(resolution, maps), defer=gradient.DEFERRED),
    )
    batch = Batch(sampler.draw(0, 4).records(), grid)
    reference = source.render_device(batch, 1)
    stopwatch = Stopwatch()
    timed = stopwatch.timed

    timed("reference image, rendered live, 1 sample", lambda: source.render_device(batch, 1))

    def rebuild() -> None:
        # a new array: Mitsuba skips parameters that are the same as before
        model.parameters[POSITIONS].value = model.vertices() + dr.opaque(mi.Float, 0.0)
        model.update_scene()

    timed("BVH of the latent", rebuild)
    texels = model.fitted(Texels)
    assert texels is not None
    timed("texels to mip pyramid", lambda: texels.now().pyramid.texels)
    positions = mi.Float(model.vertices())
    dr.enable_grad(positions)
    timed("normals and tangent bases", lambda: model.surface(positions).vertices)
    decoded = model.decode(model.values())
    drawn = model.drawn(decoded, model.surface(positions))
    loss, target = LOSSES["log-srgb-l1"], Target.of(reference, np.full((4, 3), 0.3))
    run = Frozen(model.fixed(), grid)

    def forward(quality: Quality) -> gradient.RenderedBatch:
        return gradient.render(drawn, batch, quality, 0, run)

    timed(
        "visibility alone",
        lambda: forward(Quality(defer=gradient.DEFERRED, visibility=CameraRays(()))).image,
    )
    timed("visibility, silhouettes, averaged pixels", lambda: forward(quality).image)
    rendered = forward(quality)

    def averaged() -> tuple:
        pixels = compared_pixels(rendered.image, target, rendered.complete())
        return run(image_loss, loss, target, rendered.image, pixels, grid.pixels)

    timed("loss of averaged pixels", averaged)
    _, by_image = averaged()

    def backward() -> tuple:
        return run(pulled_back, rendered, decoded, by_image)

    def pulled_back(
        rendered: gradient.RenderedBatch,
        decoded: Decoded,
        by_image: mi.Float,
    ) -> tuple:
        tracked = model.track(decoded)
        surface = model.surface(model.vertices(tracked))
        moving = Shown(surface, model.maps(tracked), drawn.edges)
        terms = gradient.surrogate(rendered, moving, by_image)
        direct = gradient.direct(
            rendered, moving, lambda c, pixel: covered_loss(loss, target, c, pixel)
        )
        gradient.backward([*terms, direct])
        return dr.grad(tracked[POSITIONS]), dr.grad(tracked[TEXELS].pyramid.texels)

    grads = timed("shading, loss and gradients of all other pixels", backward)
    parameter = model.parameters[TEXELS]
    timed("pyramid gradient to texels", lambda: texels.codec.pull_back(grads[1], parameter.value))
    down = texels.codec.pull_back(grads[1], parameter.value)
    moments = {n: adam.moments_of(p) for n, p in model.parameters.items()}
    timed("Adam, texels", lambda: adam.update(parameter, down, moments[TEXELS], 1.0)[0])
    timed(
        "Adam, positions",
        lambda: adam.update(model.parameters[POSITIONS], grads[0], moments[POSITIONS], 1.0)[0],
    )
    return stopwatch.milliseconds


if __name__ == "__main__":
    main()
