"""Time per step and peak memory by tessellation level, each in a fresh process.

    python -m experiments.displacement.growth [CASE ...]

A CASE is base triangles and level, as 1000:3. A sphere with all maps fitted (512^2), 4 views of 256
x 256, no reference: what the latent costs by itself. One step is forward, loss, backward with the
Laplacian, and the BVH. CPU time is that of all threads together.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time

import numpy as np

CASES = ("1000:0", "1000:1", "1000:2", "1000:3", "1000:4", "4000:4")
SIZE = 512


def measure(triangles: int, level: int) -> str:
    """One row of the table."""
    from appearance_opt import backend

    backend.select("cpu")
    import drjit as dr
    import mitsuba as mi

    from appearance_opt.initial.sphere import sphere
    from appearance_opt.latent.build import latent_of
    from appearance_opt.latent.parameter import Rates
    from appearance_opt.optimize.losses import LOSSES
    from appearance_opt.optimize.step import Gradients, StepInputs
    from appearance_opt.reference.pool import Targets
    from appearance_opt.render.pixels import Grid
    from appearance_opt.render.quality import Quality
    from appearance_opt.views import ViewSampler

    flat = np.zeros((SIZE, SIZE), np.float32)
    maps = {
        "red": flat + 0.5,
        "green": flat + 0.5,
        "blue": flat + 0.5,
        "roughness": flat + 0.5,
        "metalness": flat,
    }
    maps |= {"normal_x": flat, "normal_y": flat, "normal_z": flat + 1, "displacement": flat}
    parts = frozenset({"shape", "material", "normal", "displacement"})
    model = latent_of(sphere(triangles, (0.0, 0.0, 0.0), 1.0, SIZE), maps, parts, Rates(), (level,))
    grid = Grid(4, 256)
    gradients = Gradients(model, grid, Quality(), LOSSES["log-srgb-l1"], model.laplacians(True))
    views = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=1).draw(0, 4)
    reference = Targets(mi.Float(np.full(grid.pixels * 4, 0.3, np.float32)))
    inputs = StepInputs(views, reference, np.zeros((4, 3), np.float32), 1.0, 1.0, 3)
    times = []
    for _ in range(6):
        began = time.process_time()
        dr.eval(gradients(inputs))
        model.update_scene()
        dr.sync_thread()
        times.append(time.process_time() - began)
    drawn, peak = (
        len(model.topology.mesh.faces),
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    )
    return f"| {triangles} | {level} | {drawn:,} | {1000 * float(np.median(times[2:])):.0f} | {peak:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", nargs="*", default=list(CASES), metavar="CASE")
    parser.add_argument("--here", action="store_true", help="measure the only case in this process")
    a = parser.parse_args()
    if a.here:
        print(measure(*(int(n) for n in a.cases[0].split(":"))))
        return
    print(
        "| base triangles | level | drawn | CPU ms per step | peak GiB |\n|---|---|---|---|---|",
        flush=True,
    )
    for case in a.cases:
        subprocess.run(
            [sys.executable, "-m", "experiments.displacement.growth", "--here", case], check=True
        )


if __name__ == "__main__":
    main()
