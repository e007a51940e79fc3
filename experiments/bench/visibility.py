"""Primary visibility: rays through a BVH against triangles drawn onto pixels, by size of mesh and
image.

    python -m experiments.bench.visibility

Both in turns in one process; the rays' BVH is there already. "differ": pixels in which they see
another triangle.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt import backend
from appearance_opt.render import raster, rays, upload
from appearance_opt.render.freezing import Frozen
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.surface import Surface
from appearance_opt.views import ViewSampler
from scenes.analytic import bumpy_sphere

REPEATS, VIEWS = 15, 4
TRIANGLES, RESOLUTIONS = (3_000, 30_000, 100_000, 300_000, 1_000_000), (256, 512)


def main() -> None:
    backend.select("cpu")
    print(
        "| triangles | pixels | rays (ms) | drawn (ms) | ratio | differ |\n|---|---|---|---|---|---|"
    )
    for triangles in TRIANGLES:
        mesh = bumpy_sphere(triangles).meshes[0]
        scene = upload.scene_of(mesh.positions, mesh.faces)
        surface = Surface(upload.index_packets(mesh.faces), upload.packets(8, mesh.positions))
        for resolution in RESOLUTIONS:
            traced, drawn, differ = compared(scene, surface, Grid(VIEWS, resolution))
            times = f"{traced:.1f} | {drawn:.1f} | {drawn / traced:.2f}"
            print(
                f"| {len(mesh.faces)} | {VIEWS} x {resolution}² | {times} | {differ:.0e} |",
                flush=True,
            )


def compared(scene: mi.Scene, surface: Surface, grid: Grid) -> tuple[float, float, float]:
    """(median ms by rays, median ms drawn, part of the pixels in which they differ)."""
    run, half = Frozen(surface), dr.opaque(mi.Float, 0.5)
    sampler = ViewSampler((0.0, 0.0, 0.0), 1.0)
    views = [Batch(sampler.draw(k, VIEWS).records(), grid) for k in range(REPEATS)]

    def by_rays(k: int) -> mi.UInt32:
        return run(rays.trace_grid, scene, views[k], half, half)[0].triangle

    def by_drawing(k: int) -> mi.UInt32:
        return run(raster.draw_grid, surface, views[k], half, half)[0].triangle

    both: list[tuple[Callable[[int], mi.UInt32], list[float]]] = [(by_rays, []), (by_drawing, [])]
    differ = []
    for k in range(REPEATS):
        seen = []
        for work, times in both:
            dr.sync_thread()
            began = time.perf_counter()
            triangle = work(k)
            dr.eval(triangle)
            dr.sync_thread()
            times.append(1e3 * (time.perf_counter() - began))
            seen.append(np.array(triangle))
        differ.append(np.mean(seen[0] != seen[1]))
    return (*(float(np.median(times[3:])) for _, times in both), float(np.mean(differ)))


if __name__ == "__main__":
    main()
