"""The belly of the relic: enamel in gold wires. One repeat: a medallion with a rosette, and
scrolls."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from scenes.bands import Ornament, Patch, Relief, Substance
from scenes.noise import smoothstep
from scenes.stencil import Stencil, leaf, repeat_grid, ring, spiral, stroke_distance

ASPECT = 1.1
"""Height of the drawn repeat over its width; the band should have about this shape."""

_ANGLES = np.linspace(0, 2 * np.pi, 1200)


def cloisonne(
    count: int,
    wire: Substance,
    field: Substance,
    leaves: Substance,
    petal: Substance,
    heart: Substance,
) -> Ornament:
    """``count`` repeats around. ``field``: inside the medallion; ``petal`` and ``heart``: its
    rosette."""

    def relief(patch: Patch) -> Relief:
        cell = patch.girth / count
        wires, foliage, medallion, rosette, core = (
            stencil.sample(patch.u, patch.t, count) * cell for stencil in _stencils()
        )
        wire_mask = smoothstep(0.0004, -0.0004, wires)
        layers = (
            (_inside(medallion), field),
            (_inside(foliage), leaves),
            (_inside(rosette), petal),
            (_inside(core), heart),
            (wire_mask.astype(np.float32), wire),
        )
        # enamel sags between its wires, the medallion is a shallow boss
        sag = 0.00025 * smoothstep(0.0, 0.004, wires)
        edge = smoothstep(0.0, 0.03, np.minimum(patch.t, 1 - patch.t))[:, None]
        boss = 0.0055 * np.sqrt(np.clip(-medallion / (0.30 * cell), 0, 1)) * edge
        petal_lift = 0.0016 * np.sqrt(np.clip(-rosette / 0.010, 0, 1))
        leaf_lift = 0.0012 * np.sqrt(np.clip(-foliage / 0.004, 0, 1)) * edge
        height = boss + petal_lift + leaf_lift
        return Relief(
            height.astype(np.float32), (0.0003 * wire_mask - sag).astype(np.float32), layers
        )

    return relief


def _inside(distance: NDArray) -> NDArray[np.float32]:
    return smoothstep(0.0003, -0.0003, distance).astype(np.float32)


def _medallion_radius(angle: NDArray) -> NDArray:
    """A quatrefoil: four circles of radius 0.20 centred 0.165 up, down, left and right."""
    off = (angle + np.pi / 4) % (np.pi / 2) - np.pi / 4
    return 0.165 * np.cos(off) + np.sqrt(0.20**2 - (0.165 * np.sin(off)) ** 2)


def _rosette_radius(angle: NDArray) -> NDArray:
    return 0.080 + 0.150 * np.abs(np.cos(4 * angle)) ** 0.55


def _scrolls() -> tuple[list[NDArray], list[NDArray], list[tuple[NDArray, NDArray]]]:
    """Curves, half widths and leaves: a scroll in every corner that springs from the stem along the
    border, and palmettes between the medallions."""
    curves, widths, leaves = [], [], []
    for sx in (-1, 1):
        for sy in (-1, 1):
            centre = np.array((0.350 * sx, 0.412 * sy))
            curl = spiral(tuple(centre), 0.108, 1.75, sy * np.pi / 2, sx * sy)
            disc = ring(np.full(40, 0.014), np.linspace(0, 2 * np.pi, 40), tuple(curl[-1]))
            curves += [curl, disc]
            widths += [np.linspace(0.0110, 0.0065, len(curl)), np.full(40, 0.014)]
            for angle, length in ((0.25, 0.105), (-0.45, 0.095), (-1.25, 0.10), (-2.1, 0.115)):
                direction = np.array((-sx * np.cos(angle), sy * np.sin(angle)))
                base = centre + 0.120 * direction
                leaves.append(leaf(tuple(base), tuple(base + length * direction), 0.023))
            for angle, length in ((0.55, 0.12), (1.05, 0.15)):
                direction = np.array((-sx * np.cos(angle), sy * np.sin(angle)))
                base = np.array((0.5 * sx, 0.015 * sy)) + 0.045 * direction
                leaves.append(leaf(tuple(base), tuple(base + length * direction), 0.024))
    for sy in (-1, 1):
        stem = np.linspace(0, 1, 200)
        curves.append(np.stack([stem - 0.5, np.full(200, 0.522 * sy)], axis=1))
        widths.append(np.full(200, 0.0065))
        leaves.append(leaf((0.5, 0.05 * sy), (0.5, 0.24 * sy), 0.027))
    eye = ring(np.full(60, 0.026), np.linspace(0, 2 * np.pi, 60), (0.5, 0.0))
    return [*curves, eye], [*widths, np.full(60, 0.006)], leaves


@cache
def _stencils() -> tuple[Stencil, ...]:
    """Wires, foliage, medallion, rosette and its core."""
    x, y = repeat_grid(400, ASPECT)
    curves, widths, leaves = _scrolls()
    leaf_points, leaf_widths = [p for p, _ in leaves], [w for _, w in leaves]
    foliage = stroke_distance(x, y, leaf_points, leaf_widths)
    outlines = [
        (ring(_medallion_radius(_ANGLES), _ANGLES), 0.0105),
        (ring(0.87 * _medallion_radius(_ANGLES), _ANGLES), 0.0055),
        (ring(_rosette_radius(_ANGLES), _ANGLES), 0.0065),
        (ring(np.full_like(_ANGLES, 0.074), _ANGLES), 0.0065),
    ]
    curves += [c for c, _ in outlines]
    widths += [np.full(len(c), w) for c, w in outlines]
    wires = np.minimum(stroke_distance(x, y, curves, widths), np.abs(foliage) - 0.0055)
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    medallion = (radius - _medallion_radius(angle)).astype(np.float32)
    rosette = (0.6 * (radius - _rosette_radius(angle))).astype(np.float32)
    core = (radius - 0.074).astype(np.float32)
    return tuple(
        Stencil(np.ascontiguousarray(d)) for d in (wires, foliage, medallion, rosette, core)
    )
