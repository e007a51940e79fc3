"""Pictures of what was measured."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np

from experiments.speed_vs_error.setups import DEFAULT
from experiments.speed_vs_error.tables import against_default, curve, levers_of, pareto, scenes_of

if TYPE_CHECKING:
    from experiments.speed_vs_error.results import CurveRow, JobRow

COLOURS = ("#c0392b", "#2c6fbb", "#5a9e6f", "#e08e0b", "#8e5ea2", "#17a2b8")
PRESET_COLOURS = {"draft": "#5a9e6f", "default": "#2c6fbb", "final": "#c0392b"}


def draw(curves: list[CurveRow], jobs: list[JobRow], folder: Path) -> list[Path]:
    """All pictures that the rows allow, into ``folder``."""
    matplotlib.use("agg")
    folder.mkdir(parents=True, exist_ok=True)
    out = []
    if any(r.lever == DEFAULT for r in curves):
        groups = levers_of(curves)
        names = list(groups)
        half = -(-len(names) // 2)
        for k, part in enumerate((names[:half], names[half:]), start=1):
            if part:
                out.append(folder / f"speed_vs_error_curves{k}.png")
                _curves(curves, {n: groups[n] for n in part}, out[-1])
        out.append(folder / "speed_vs_error_levers.png")
        _levers(curves, out[-1])
    if jobs:
        out.append(folder / "speed_vs_error_jobs.png")
        _jobs(jobs, out[-1])
    return out


def _curves(rows: list[CurveRow], groups: dict[str, list[str]], path: Path) -> None:
    """PSNR against seconds: a column per scene, a row per group of levers, the default in black."""
    import matplotlib.pyplot as plt

    scenes = scenes_of(rows)
    size = (3.3 * len(scenes), 2.5 * len(groups))
    figure, axes = plt.subplots(len(groups), len(scenes), figsize=size, squeeze=False)
    for line, (group, levers) in zip(axes, groups.items(), strict=True):
        for axis, scene in zip(line, scenes, strict=True):
            _panel(axis, rows, scene, [n for n in levers if n != DEFAULT])
        line[0].set_ylabel(f"{group}\nPSNR, covered (dB)", fontsize=8)
    for axis, scene in zip(axes[0], scenes, strict=True):
        axis.set_title(scene, fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("seconds of fitting", fontsize=8)
    _save(figure, path)


def _panel(axis, rows: list[CurveRow], scene: str, levers: list[str]) -> None:
    """One scene, one group. The time axis is logarithmic, and begins with the first look at the running fit."""
    values = []
    for lever, colour in zip((*levers, DEFAULT), (*COLOURS[: len(levers)], "black"), strict=True):
        own = [r for r in curve(rows, scene, lever) if r.seconds > 0]
        if not own:
            continue
        x, y = [r.seconds for r in own], [r.psnr_covered for r in own]
        values += y
        axis.plot(x, y, color=colour, label=lever, marker="o", markersize=2.5, linewidth=1.8 if lever == DEFAULT else 1)
    if values:
        # a lever that fails by many dB must not flatten all others
        low = max(min(values), np.percentile(values, 75) - 8.0)
        axis.set_ylim(low - 0.3, max(values) + 0.3)
        axis.set_xscale("log", base=2)
        axis.xaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        axis.legend(fontsize=6, loc="lower right")
    axis.grid(alpha=0.25, linewidth=0.4)
    axis.tick_params(labelsize=7)


def _levers(rows: list[CurveRow], path: Path) -> None:
    """dB and FLIP ratio against the default after equal time: a line per lever, a colour per scene."""
    import matplotlib.pyplot as plt

    scenes = scenes_of(rows)
    names = [n for levers in levers_of(rows).values() for n in levers if n != DEFAULT]
    figure, axes = plt.subplots(1, 2, figsize=(10.5, 0.28 * len(names) + 1.2), sharey=True)
    for scene, colour, shift in zip(scenes, COLOURS, np.linspace(-0.24, 0.24, max(len(scenes), 2)), strict=False):
        found = [(k, against_default(rows, scene, n)) for k, n in enumerate(names)]
        kept = [(k, *pair) for k, pair in found if pair is not None]
        if not kept:
            continue
        y, decibel, ratio = np.array(kept).T
        axes[0].scatter(np.maximum(decibel, -LARGEST), y + shift, s=14, color=colour, label=scene)
        axes[1].scatter(np.minimum(ratio, 2.0), y + shift, s=14, color=colour)
    axes[0].set_xlim(-LARGEST - 0.1, None)
    for axis, zero in zip(axes, (0.0, 1.0), strict=True):
        axis.axvline(zero, color="black", linewidth=0.8)
        axis.grid(alpha=0.25, linewidth=0.4)
        axis.tick_params(labelsize=8)
    axes[0].set_yticks(range(len(names)), names)
    axes[0].set_ylim(len(names) - 0.5, -0.5)
    axes[0].set_xlabel(f"dB above the default at equal time (cut at -{LARGEST:g})", fontsize=8)
    axes[1].set_xlabel("FLIP over the default's at equal time (cut at 2)", fontsize=8)
    axes[0].legend(fontsize=7, loc="lower left")
    _save(figure, path)


LARGEST = 2.0
"""Losses in dB beyond which points are drawn at the edge."""


def _jobs(rows: list[JobRow], path: Path) -> None:
    """PSNR and FLIP against wall time of whole jobs: a column per scene, the Pareto front as a line."""
    import matplotlib.pyplot as plt

    scenes = scenes_of(rows)
    figure, axes = plt.subplots(2, len(scenes), figsize=(4.6 * len(scenes), 6.4), squeeze=False, sharex="col")
    for column, scene in zip(axes.T, scenes, strict=True):
        own = sorted((r for r in rows if r.scene == scene), key=lambda r: r.seconds)
        front = pareto(own)
        for axis, name in zip(column, ("psnr_covered", "flip"), strict=True):
            best = [r for r in own if r.job in front]
            axis.plot([r.seconds for r in best], [getattr(r, name) for r in best], color="#bbbbbb", zorder=0)
            for r in own:
                preset = r.job == r.preset
                axis.scatter(
                    r.seconds, getattr(r, name), color=PRESET_COLOURS[r.preset], marker="*" if preset else "o",
                    s=130 if preset else 22,
                )  # fmt: skip
                axis.annotate(
                    r.job, (r.seconds, getattr(r, name)), fontsize=6, xytext=(4, -9), textcoords="offset points"
                )
            axis.set_xscale("log")
            axis.xaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
            axis.xaxis.set_minor_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
            axis.grid(alpha=0.25, which="both", linewidth=0.4)
            axis.tick_params(labelsize=7, which="both")
        column[0].set_title(scene, fontsize=9)
        column[1].set_xlabel("seconds from the command to its end", fontsize=8)
    axes[0, 0].set_ylabel("PSNR, covered (dB)", fontsize=8)
    axes[1, 0].set_ylabel("FLIP", fontsize=8)
    _save(figure, path)


def _save(figure, path: Path) -> None:
    import matplotlib.pyplot as plt

    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
