"""Memory and time of a job on a very large asset (docs/performance.md).

    python -m experiments.bench.memory [--triangles 5000000] [--texels 8192] [--budget 19s]

Makes a bumpy sphere with four maps (base colour, ORM, normal, emission), simplifies it to 3,000
triangles in a process of its own, and prints the peak of that process and how long it took. Needs
nothing, but 2 GiB of disk.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from appearance_opt.asset import save
from appearance_opt.asset.types import Material, Texture
from experiments.common import OUT
from scenes.build import build

TRIANGLES = 3000


def write_asset(path: Path, triangles: int, texels: int) -> None:
    """The asset, if it is not there yet."""
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    asset = build("bumpy_sphere", triangles=triangles, texture_size=None)
    y, x = np.mgrid[0:texels, 0:texels].astype(np.float32) / texels

    def image(red: np.ndarray, green: np.ndarray, blue: float) -> np.ndarray:
        return (np.stack([red, green, np.full_like(x, blue)], axis=-1) * 255).astype(np.uint8)

    color = image(0.5 + 0.4 * np.sin(40 * x), 0.5 + 0.4 * np.cos(30 * y), 0.5)
    orm = image(np.ones_like(x), 0.5 + 0.3 * np.sin(20 * (x + y)), 0.05)
    normal = image(0.5 + 0.1 * np.sin(200 * x), 0.5 + 0.1 * np.cos(200 * y), 0.98)
    material = Material(
        "large",
        metalness=1.0,
        base_color_texture=Texture(color, "srgb"),
        orm_texture=Texture(orm),
        normal_texture=Texture(normal),
        emission=(0.1, 0.1, 0.1),
        emission_texture=Texture(color, "srgb"),
    )
    save(replace(asset, meshes=(replace(asset.meshes[0], material=material),)), path)


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--triangles", type=int, default=5_000_000)
    parser.add_argument("--texels", type=int, default=8192, help="per side of each map")
    parser.add_argument("--budget", help="a time budget, instead of three steps")
    options = parser.parse_args()
    folder = OUT / "memory"
    source = folder / f"{options.triangles}_{options.texels}.glb"
    write_asset(source, options.triangles, options.texels)
    effort = ["--budget", options.budget] if options.budget else ["--steps", "3"]
    command = [
        sys.executable,
        "-m",
        "appearance_opt",
        "simplify",
        str(source),
        "--triangles",
        str(TRIANGLES),
    ]
    began = time.perf_counter()
    subprocess.run([*command, *effort, "--out", str(folder / "light.glb")], check=True)
    seconds = time.perf_counter() - began
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(
        f"{options.triangles:,} triangles, four maps of {options.texels}^2: peak {peak:.1f} GiB, {seconds:.0f} s"
    )


if __name__ == "__main__":
    main()
