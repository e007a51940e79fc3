"""The pictures of the README, from the demo's report.

make demo && python -m experiments.figures
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from appearance_opt.asset.images import encode_png, read

REPORT = Path("out/demo/relic_2pct.report")
TARGET = Path("docs/images")


def main() -> None:
    if not REPORT.is_dir():
        sys.exit(f"{REPORT} is not there: run 'make demo' first")
    TARGET.mkdir(parents=True, exist_ok=True)
    names = ("reference", "result", "wireframe")
    row = np.concatenate([read(REPORT / f"view0_{n}.png") for n in names], axis=1)
    (TARGET / "demo.png").write_bytes(encode_png(np.ascontiguousarray(row)))
    maps = ("base_colour", "roughness__metalness", "normal")
    small = [read(REPORT / f"map_{n}.png")[::3, ::3] for n in maps]
    (TARGET / "demo_maps.png").write_bytes(
        encode_png(np.ascontiguousarray(np.concatenate(small, axis=1)))
    )


if __name__ == "__main__":
    main()
