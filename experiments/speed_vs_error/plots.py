"""Pictures of what was measured."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np

from experiments.speed_vs_error.setups import DEFAULT, SEED
from experiments.speed_vs_error.tables import against_default, curve, levers_of, pareto, scenes_of

if TYPE_CHECKING:
    from experiments.speed_vs_error.results import CurveRow, JobRow

COLOURS = ("#c0392b", "#2c6fbb", "#5a9e6f", "#e08e0b", "#8e5ea2", "#17a2b8")
PRESET_COLOURS = {"draft": "#5a9e6f", "default": "#2c6fbb", "final": "#c0392b"}


def draw_levers(curves: list[CurveRow], folder: Path) -> dict[str, Path]:
    """Pictures of the levers in ``folder``: title -> file."""
    matplotlib.use("agg")
    groups = levers_of(curves)
    out = {"Levers against the default after equal time": folder / "speed_vs_error_levers.png"}
    _levers(curves, *out.values())
    names = list(groups)
    half = -(-len(names) // 2)
    for number, part in enumerate((names[:half], names[half:]), start=1):
        path = folder / f"speed_vs_error_curves{number}.png"
        if part:
            out[f"PSNR against seconds of fitting: {', '.join(part)}"] = path
            _curves(curves, {n: groups[n] for n in part}, path)
    return out


def draw_jobs(jobs: list[JobRow], folder: Path) -> dict[str, Path]:
    """Picture of the whole jobs in ``folder``: title -> file."""
    matplotlib.use("agg")
    path = folder / "speed_vs_error_jobs.png"
    _jobs(jobs, path)
    return {"PSNR and FLIP of whole jobs against wall-clock time": path}


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
    """One scene, one group. The time axis is logarithmic, and begins with the first
    look at the running fit; the default's start is dotted."""
    values = []
    for lever, colour in zip((*levers, DEFAULT), (*COLOURS[: len(levers)], "black"), strict=True):
        own = [r for r in curve(rows, scene, lever) if r.seconds > 0]
        if not own:
            continue
        x, y = [r.seconds for r in own], [r.psnr_covered for r in own]
        values += y
        axis.plot(
            x,
            y,
            color=colour,
            label=lever,
            marker="o",
            markersize=2.5,
            linewidth=1.8 if lever == DEFAULT else 1,
        )
    if values:
        for first in curve(rows, scene, DEFAULT)[:1]:
            axis.axhline(
                first.psnr_covered, color="black", linewidth=0.8, linestyle=":", label="start"
            )
        # a lever that fails by many dB must not flatten all others
        low = max(min(values), np.percentile(values, 75) - 8.0)
        axis.set_ylim(low - 0.3, max(values) + 0.3)
        _seconds_axis(axis)
        axis.legend(fontsize=6, loc="best")
    axis.grid(alpha=0.25, linewidth=0.4)


def _levers(rows: list[CurveRow], path: Path) -> None:
    """dB and FLIP ratio against the default after equal time: a line per lever, a colour per
    scene."""
    import matplotlib.pyplot as plt

    scenes = scenes_of(rows)
    names = [n for levers in levers_of(rows).values() for n in levers if n != DEFAULT]
    figure, axes = plt.subplots(1, 2, figsize=(10.5, 0.28 * len(names) + 1.2), sharey=True)
    for scene, colour, shift in zip(
        scenes, COLOURS, np.linspace(-0.24, 0.24, max(len(scenes), 2)), strict=False
    ):
        found = [(k, against_default(rows, scene, n)) for k, n in enumerate(names)]
        kept = [(k, *pair) for k, pair in found if pair is not None]
        if not kept:
            continue
        y, decibel, ratio = np.array(kept).T
        axes[0].scatter(np.maximum(decibel, -LARGEST), y + shift, s=14, color=colour, label=scene)
        axes[1].scatter(np.minimum(ratio, 2.0), y + shift, s=14, color=colour)
    axes[0].set_xlim(-LARGEST - 0.1, None)
    chance = [abs(f[0]) for f in (against_default(rows, s, SEED) for s in scenes) if f is not None]
    if chance:
        axes[0].axvspan(
            -float(np.median(chance)), float(np.median(chance)), color="#eeeeee", zorder=0
        )
    for axis, zero in zip(axes, (0.0, 1.0), strict=True):
        axis.axvline(zero, color="black", linewidth=0.8)
        axis.grid(alpha=0.25, linewidth=0.4)
        axis.tick_params(labelsize=8)
    axes[0].set_yticks(range(len(names)), names)
    axes[0].set_ylim(len(names) - 0.5, -0.5)
    axes[0].set_xlabel(f"dB above the default at equal time (cut at -{LARGEST:g})", fontsize=8)
    axes[1].set_xlabel("FLIP over the default's at equal time (cut at 2)", fontsize=8)
    figure.legend(fontsize=7, loc="outside upper center", ncols=len(scenes))
    _save(figure, path)


LARGEST = 2.0
"""Losses in dB beyond which points are drawn at the edge."""


def _jobs(rows: list[JobRow], path: Path) -> None:
    """PSNR and FLIP against wall time of whole jobs: a column per scene, a line per preset, a star
    at its own budget; the Pareto front in grey."""
    import matplotlib.pyplot as plt

    scenes = scenes_of(rows)
    figure, axes = plt.subplots(
        2, len(scenes), figsize=(4.6 * len(scenes), 6.4), squeeze=False, sharex="col"
    )
    for column, scene in zip(axes.T, scenes, strict=True):
        own = sorted((r for r in rows if r.scene == scene), key=lambda r: r.seconds)
        front = pareto(own)
        for axis, name in zip(column, ("psnr_covered", "flip"), strict=True):
            best = [r for r in own if r.job in front]
            x, y = [r.seconds for r in best], [getattr(r, name) for r in best]
            axis.plot(x, y, color="#dddddd", linewidth=6, zorder=0, label="Pareto front (PSNR)")
            for preset, colour in PRESET_COLOURS.items():
                line = [r for r in own if r.preset == preset]
                x, y = [r.seconds for r in line], [getattr(r, name) for r in line]
                axis.plot(x, y, color=colour, marker="o", markersize=4, linewidth=1, label=preset)
                star = [r for r in line if r.job == preset]
                axis.scatter(
                    [r.seconds for r in star],
                    [getattr(r, name) for r in star],
                    s=150,
                    marker="*",
                    color=colour,
                )
            _seconds_axis(axis)
            axis.grid(alpha=0.25, linewidth=0.4)
        column[0].set_title(scene, fontsize=9)
        column[0].legend(fontsize=7, loc="lower right")
        column[1].set_xlabel(
            "seconds from the command to its end (star: the preset's own budget)", fontsize=7
        )
    axes[0, 0].set_ylabel("PSNR, covered (dB)", fontsize=8)
    axes[1, 0].set_ylabel("FLIP", fontsize=8)
    _save(figure, path)


def _seconds_axis(axis) -> None:
    """Logarithmic, with round numbers."""
    from matplotlib import ticker

    axis.set_xscale("log")
    axis.xaxis.set_major_locator(ticker.FixedLocator([0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500]))
    axis.xaxis.set_minor_locator(ticker.NullLocator())
    axis.xaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
    axis.tick_params(labelsize=7)


def _save(figure, path: Path) -> None:
    import matplotlib.pyplot as plt

    figure.set_layout_engine("constrained")
    figure.savefig(path, dpi=110)
    plt.close(figure)
