"""Whether a CPU and a GPU compute the same images and gradients.

    python -m experiments.devices --device cpu --write FILE.npz      # on one machine
    python -m experiments.devices --device cuda --compare FILE.npz   # on the other, or on the same

Prints a Markdown table for docs/accuracy.md: the PSNR between the two devices' reference images,
and relative L2 error and cosine of every gradient of one step, on the scene of
``experiments.bench``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from appearance_opt import backend

VIEWS, RESOLUTION, TRIANGLES, REFERENCE, MAPS = 4, 256, 3000, 100_000, 512


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", required=True, choices=("cpu", "cuda"))
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--write", type=Path)
    what.add_argument("--compare", type=Path)
    a = parser.parse_args()
    backend.select(a.device)
    mine = arrays()
    if a.write:
        a.write.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(a.write, **mine)
        return
    with np.load(a.compare) as other:
        print(table({name: (other[name], value) for name, value in mine.items()}))


def arrays() -> dict[str, NDArray[np.float32]]:
    """Reference images, loss and gradients, by what they are called in the table."""
    from appearance_opt.optimize.losses import LOSSES
    from appearance_opt.optimize.step import Gradients, StepInputs
    from appearance_opt.reference.pool import Targets
    from appearance_opt.render.boundary.camera_rays import CameraRays
    from appearance_opt.render.boundary.pairs import Pairs
    from appearance_opt.render.pixels import Grid
    from appearance_opt.render.quality import Quality
    from experiments.bench.scene import set_up

    source, model, sampler = set_up(TRIANGLES, REFERENCE, MAPS)
    grid, views = Grid(VIEWS, RESOLUTION), sampler.draw(0, VIEWS)
    out = {"reference image": source.render(views, RESOLUTION, 16)}
    target = Targets(backend.to_device(out["reference image"]))
    inputs = StepInputs(views, target, np.full((VIEWS, 3), 0.3, np.float32), 0.0, 1.0, 0)
    for visibility, estimator in (("edges", CameraRays()), ("pairs", Pairs())):
        quality = Quality(visibility=estimator)
        loss, gradients = Gradients(model, grid, quality, LOSSES["log-srgb-l1"])(inputs)
        out[f"loss ({visibility})"] = np.array(loss)
        out |= {f"gradient of {name} ({visibility})": np.array(g) for name, g in gradients.items()}
    return out


def table(pairs: dict[str, tuple[NDArray, NDArray]]) -> str:
    """Markdown rows of (first device, second device)."""
    lines = ["| what | PSNR | relative L2 error | cosine |", "|---|---|---|---|"]
    for name, (first, second) in pairs.items():
        a, b = (x.astype(np.float64).ravel() for x in (first, second))
        error = np.linalg.norm(a - b) / np.linalg.norm(a)
        cosine = a @ b / (np.linalg.norm(a) * np.linalg.norm(b))
        # linear values; whatever is whiter than white counts as white
        shown = (
            -10 * np.log10(max(np.mean((a.clip(0, 1) - b.clip(0, 1)) ** 2), 1e-20))
            if "image" in name
            else None
        )
        psnr = "" if shown is None else f"{shown:.1f} dB"
        lines.append(f"| {name} | {psnr} | {error:.1e} | {cosine:.6f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
