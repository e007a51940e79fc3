"""The pictures of the README, from the demo's report, and with Chromium one of the report itself.

make demo && python -m experiments.figures
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
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
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        print("no Chromium on the path: docs/images/report.png stays as it is")
        return
    # WebGL by the processor; time runs on until the 3D view is there
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "report.png"
        options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--window-size=1120,1290"]
        options += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        options += ["--virtual-time-budget=20000", f"--screenshot={shot}"]
        page = (REPORT / "report.html").resolve().as_uri()
        subprocess.run([browser, *options, page], check=True, capture_output=True)
        (TARGET / "report.png").write_bytes(encode_png(read(shot)[..., :3]))


if __name__ == "__main__":
    main()
