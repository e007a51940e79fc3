"""Time of one step, by size and by stage, on an embedded scene.

    python -m experiments.bench [--quick] [--device cuda]

Prints Markdown tables for docs/performance.md and writes out/bench.json. Medians and ranges over
steps after warm-up; compare ratios within one run, not times between machines.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from appearance_opt import backend
from experiments.bench.projective import projective

OUT = Path("out")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="fewer sizes and repetitions")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--case", help="run one case in this process and print its JSON")
    a = parser.parse_args()
    found = backend.select(a.device)
    if a.case:
        print(json.dumps(run_case(**json.loads(a.case))))
        return
    threads = f"{found.threads} threads, LLVM {found.llvm}" if found.llvm else "CUDA"
    print(f"{platform.processor() or platform.machine()}, {threads}\n")
    rows = {name: in_process(case, a.device) for name, case in cases(a.quick).items()}
    print(table(rows))
    print(growth(rows))
    if not a.quick:
        rows["direct_projective"] = projective()
        peer, ours = rows["direct_projective"]["milliseconds"], rows["256"]["milliseconds"]
        print(
            f"\ndirect_projective, 16 spp, vertex gradient alone, 4 x 256^2: {peer:.0f} ms, {peer / ours:.0f} x a step"
        )
    OUT.mkdir(exist_ok=True)
    (OUT / "bench.json").write_text(json.dumps(rows, indent=1))


def cases(quick: bool) -> dict[str, dict]:
    """Sizes to time: resolution of 4 views, triangles of latent and reference, map size, and where
    the reference's images come from: they are "kept", rendered "live" in every step with one ray
    per pixel, or rendered as a fit does it (in every ``--reuse``-th step, finely at outlines). The
    object fills the views; with "room" they are that much wider and higher, so that it covers as
    much of them as a long or branched one does."""
    base = {"resolution": 256, "latent": 3000, "reference": 100_000, "maps": 512, "images": "kept"}
    live, in_fit = {**base, "images": "live"}, {**base, "images": "as in a fit"}
    out = {
        "256": base,
        "256, live reference": live,
        "256, as in a fit": in_fit,
        "128": {**base, "resolution": 128},
    }
    out["512, 1024 maps"] = {**base, "resolution": 512, "maps": 1024}
    for how, case in (("live reference", live), ("as in a fit", in_fit)):
        out[f"256, {how}, a third covered"] = {**case, "room": 1.5}
    if quick:
        return out
    out["512"] = {**base, "resolution": 512}
    out["1024"] = {**base, "resolution": 1024}
    out["50k latent"] = {**base, "latent": 50_000}
    for how, case in (("live", live), ("as in a fit", in_fit)):
        out[f"10k reference, {how}"] = {**case, "reference": 10_000}
        out[f"1M reference, {how}"] = {**case, "reference": 1_000_000}
    return out


def in_process(case: dict, device: str) -> dict:
    """Each case in a process of its own: its peak memory is its own."""
    command = [
        sys.executable,
        "-m",
        "experiments.bench",
        "--device",
        device,
        "--case",
        json.dumps(case),
    ]
    return json.loads(
        subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1]
    )


def run_case(
    resolution: int,
    latent: int,
    reference: int,
    maps: int,
    images: str,
    room: float = 1.0,
    steps: int = 24,
) -> dict:
    """Median and range in ms of a whole step, the sum of its kernels, kernels compiled, peak
    memory."""
    from appearance_opt.optimize import adam
    from appearance_opt.optimize.losses import LOSSES
    from appearance_opt.optimize.plan import LOSS_EVERY
    from appearance_opt.optimize.step import Gradients, StepInputs, first_non_finite, step
    from appearance_opt.options.views import ViewOptions
    from appearance_opt.reference.pool import ReferencePool, Targets
    from appearance_opt.render.pixels import Batch, Grid
    from appearance_opt.render.quality import Quality
    from appearance_opt.stages.fitting import POOL_SAMPLES, point_width
    from experiments.bench.scene import set_up

    source, model, sampler = set_up(latent, reference, maps, room)
    grid = Grid(4, resolution)
    mesh = model.topology.mesh
    moments = {n: adam.moments_of(p) for n, p in model.parameters.items()}
    width = point_width(resolution, maps)
    gradients = Gradients(
        model,
        grid,
        Quality(point_width=width),
        LOSSES["log-srgb-l1"],
        model.laplacians(relative=True),
    )
    views = [sampler.draw(k, 4) for k in range(8)]
    kept = [Targets(source.render_device(Batch(v.records(), grid), 1)) for v in views]
    pool = ReferencePool(source, sampler, 8, 4, resolution, POOL_SAMPLES, width, ViewOptions.reuse)
    at_once = ViewOptions.reuse if images == "as in a fit" else 1

    def one(k: int) -> None:
        v, target = views[k % 8], kept[k % 8]
        if images == "as in a fit":
            v, target = pool.draw(k)
        if images == "live":
            target = Targets(source.render_device(Batch(v.records(), grid), 1))
        background = np.full((4, 3), 0.3, np.float32)
        inputs = StepInputs(v, target, background, 0.01, 1.0, k, want_loss=k % LOSS_EVERY == 0)
        done = step(gradients, moments, inputs, first_non_finite)
        model.restore(done.values)
        moments.update(done.moments)

    return {
        **timings(one, steps, at_once),
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "triangles": len(mesh.faces),
    }


def timings(one: Callable[[int], None], steps: int, at_once: int) -> dict:
    """Wall-clock time of ``steps`` calls after warm-up, then kernel times and compilations of eight
    more. Times are per call and in ms; ``at_once``: calls that are timed together, for they
    differ."""
    import drjit as dr

    for k in range(10):
        one(k)
    walls, kernels, compiled = [], [], 0
    for k in range(0, steps, at_once):
        dr.sync_thread()
        began = time.perf_counter()
        for i in range(at_once):
            one(10 + k + i)
        dr.sync_thread()
        walls.append(1e3 * (time.perf_counter() - began) / at_once)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for k in range(0, 8, at_once):
            dr.kernel_history_clear()
            for i in range(at_once):
                one(10 + steps + k + i)
            dr.sync_thread()
            history = dr.kernel_history()
            kernels.append(sum(h.get("execution_time", 0.0) for h in history) / at_once)
            compiled += sum(h["type"] == dr.KernelType.JIT and not h["cache_hit"] for h in history)
    return {
        "milliseconds": float(np.median(walls)),
        "range": [float(min(walls)), float(max(walls))],
        "kernels": float(np.median(kernels)),
        "compiled": int(compiled),
    }


def table(rows: dict) -> str:
    """Markdown table of all cases."""
    lines = [
        "| case (4 views) | ms per step, median (range) | kernels | wall / kernels | compiled | peak GiB |",
        "|---|---|---|---|---|---|",
    ]
    for name, r in rows.items():
        low, high = r["range"]
        lines.append(
            f"| {name} | {r['milliseconds']:.1f} ({low:.1f} to {high:.1f}) | {r['kernels']:.1f} | "
            f"{r['milliseconds'] / r['kernels']:.2f} | {r['compiled']} | {r['peak_gib']:.2f} |"
        )
    return "\n".join(lines)


def growth(rows: dict) -> str:
    """Ratios that the sizes of a job decide."""
    t = {name: r["milliseconds"] for name, r in rows.items()}
    out = []
    if "1024" in t:
        exponent = np.polyfit(
            np.log([128**2, 256**2, 512**2, 1024**2]),
            np.log([t[k] for k in ("128", "256", "512", "1024")]),
            1,
        )[0]
        out.append(f"exponent of time in pixels, 128^2 to 1024^2: {exponent:.2f}")
        out.append(f"50k latent over 3k: {t['50k latent'] / t['256']:.2f}")
        for how in ("live", "as in a fit"):
            out.append(
                f"1M reference over 10k, {how}: {t[f'1M reference, {how}'] / t[f'10k reference, {how}']:.2f}"
            )
    return "\n" + "\n".join(out)


if __name__ == "__main__":
    main()
