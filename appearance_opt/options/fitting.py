"""What a fit moves, how fast, and when it stops."""

from __future__ import annotations

from dataclasses import dataclass

from appearance_opt.options.option import Record, duration, names_for, option

FIT_PARTS = ("shape", "normal", "material")
LOSS_NAMES = ("log-srgb-l1", "log-srgb-l2", "l1", "l2", "smape", "relative-l2")

_AUTOMATIC = "by the start"


@dataclass(frozen=True)
class FittingOptions(Record):
    """``parts``: what moves. ``steps``, ``budget`` (seconds for the whole job, set-up and report
    included): when to stop, whichever comes first. ``*_rate``: learning rates, of positions in
    units of the local edge length; by default they follow from how good the start is.
    ``laplacian``: weight; ``relative``: it keeps the start's shape rather than a smooth one (None:
    where the start is a likeness)."""

    steps: int | None = option(
        None, "Stop after this many steps, instead of the preset's time.", panel="Fit", low=0
    )
    budget: float | None = option(
        None,
        "Wall-clock time for everything: 60s, 5m.",
        panel="Fit",
        above=0,
        expected="a positive time such as 60s",
        automatic="1000 steps",
        metavar="TIME",
        parse=duration,
    )
    parts: tuple[str, ...] = option(
        FIT_PARTS,
        "What moves.",
        panel="Fit",
        key="fit",
        choices=FIT_PARTS,
        parse=names_for("fit"),
    )
    loss: str = option("log-srgb-l1", "How images are compared.", panel="Fit", choices=LOSS_NAMES)
    laplacian: float = option(0.25, "Weight of the Laplacian; 0: off.", panel="Fit", low=0)
    relative: bool | None = option(
        None,
        "The Laplacian keeps that of the start, or goes to 0.",
        panel="Fit",
        flag="--relative/--absolute",
        automatic=_AUTOMATIC,
    )
    position_rate: float | None = option(
        None,
        "Learning rate of vertices, in units of the local edge length.",
        panel="Fit",
        low=0,
        high=1,
        automatic=_AUTOMATIC,
    )
    normal_rate: float | None = option(
        None, "Learning rate of the normal map.", panel="Fit", low=0, high=1, automatic=_AUTOMATIC
    )
    color_rate: float | None = option(
        None, "Learning rate of the base colour.", panel="Fit", low=0, high=1, automatic=_AUTOMATIC
    )
    material_rate: float | None = option(
        None,
        "Learning rate of roughness and metalness.",
        panel="Fit",
        low=0,
        high=1,
        automatic=_AUTOMATIC,
    )
