"""Picture and tables of the curves."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import matplotlib
import numpy as np

IMAGES = Path("docs/images")
COLOURS = {
    "none": "#888888",
    "edges 1, 4 rays": "#e8a49b",
    "edges 1, 8 rays": "#d96a5b",
    "edges 4, 8 rays": "#a02a1c",
    "pairs": "#e08e0b",
    "pairs, 2 x 2": "#8a5a05",
}


def draw(path: Path, rows: list[dict[str, str]]) -> None:
    """Rows of ``path``, all of one length -> a table beside it; picture and CSV into docs/images if
    it lies where they come from. Ends the program with one line if there are none."""
    if not rows:
        sys.exit(f"no fit of that length in {path}: run the experiment first")
    path.with_suffix(".md").write_text(table(rows))
    kept = path.parent == Path("out/convergence")
    picture(rows, IMAGES / "convergence.png" if kept else path.with_suffix(".png"))
    if kept:
        with (IMAGES / "convergence.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


def table(rows: list[dict[str, str]]) -> str:
    """Held-out PSNR after a quarter, a half and all of the time, mean over the seeds."""
    lines = [
        "| case | estimator | steps | after a quarter of the time | half | all | seeds |",
        "|---|---|---|---|---|---|---|",
    ]
    for case, estimator in dict.fromkeys((r["case"], r["estimator"]) for r in rows):
        curves = _curves(rows, case, estimator)
        budget = float(next(r["budget"] for r in rows if r["case"] == case))
        at = [
            np.mean([np.interp(f * budget, t, p) for t, p, _ in curves]) for f in (0.25, 0.5, 1.0)
        ]
        steps = np.mean([s[-1] for _, _, s in curves])
        lines.append(
            f"| {case}, {budget:.0f} s | {estimator} | {steps:.0f} | {at[0]:.2f} dB | {at[1]:.2f} dB | "
            f"{at[2]:.2f} dB | {len(curves)} |"
        )
    return "\n".join(lines) + "\n"


def picture(rows: list[dict[str, str]], path: Path) -> None:
    """One panel per case: held-out PSNR against seconds."""
    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    cases = list(dict.fromkeys(r["case"] for r in rows))
    figure, axes = plt.subplots(1, len(cases), figsize=(4.2 * len(cases), 3.4), squeeze=False)
    for axis, case in zip(axes[0], cases, strict=True):
        for estimator in dict.fromkeys(r["estimator"] for r in rows if r["case"] == case):
            for k, (t, p, _) in enumerate(_curves(rows, case, estimator)):
                label = estimator if k == 0 else None
                axis.plot(
                    t,
                    p,
                    color=COLOURS[estimator],
                    label=label,
                    linewidth=1.2,
                    marker=".",
                    markersize=4,
                )
        axis.set_title(case, fontsize=9)
        axis.set_xlabel("seconds", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.25, linewidth=0.4)
    axes[0, 0].set_ylabel("held-out PSNR, dB", fontsize=8)
    axes[0, 0].legend(fontsize=6)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _curves(rows: list[dict[str, str]], case: str, estimator: str) -> list[tuple]:
    """(seconds, PSNR, steps) of each seed."""
    own = [r for r in rows if (r["case"], r["estimator"]) == (case, estimator)]
    out = []
    for seed in sorted({r["seed"] for r in own}):
        curve = [r for r in own if r["seed"] == seed]
        out.append(
            tuple(np.array([float(r[k]) for r in curve]) for k in ("seconds", "psnr", "step"))
        )
    return out
