"""Classical mouldings as reliefs over a band: ropes, beads, gadroons, flutes, petals, scales,
meander.

Each function takes what shapes it and returns an ornament, a function of a ``Patch``. In all of
them ``f`` runs over [-1, 1] across one repeat. Heights are in metres and vanish at the band's ends,
so that neighbouring bands meet.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from scenes.bands import Ornament, Patch, Relief, Substance
from scenes.noise import smoothstep
from scenes.stencil import Stencil, polyline, repeat_grid, stroke_distance


def rope(strands: int, turns: float, depth: float) -> Ornament:
    """Twisted cord: over the band's length every strand moves on by ``turns`` repeats."""

    def relief(patch: Patch) -> Relief:
        f = _across(patch, strands, turns)
        return Relief(
            (depth * (np.sqrt(1.02 - f * f) - 0.7) * _fade(patch, 0.12)).astype(np.float32)
        )

    return relief


def beads(count: int, fill: float = 0.47) -> Ornament:
    """A row of half balls of radius ``fill`` times the smaller of repeat and band."""

    def relief(patch: Patch) -> Relief:
        cell = patch.girth / count
        radius = fill * min(cell, patch.length)
        x, y = _across(patch, count) * cell / 2, (patch.t[:, None] - 0.5) * patch.length
        return Relief(
            (0.85 * np.sqrt(np.clip(radius**2 - x * x - y * y, 0, None))).astype(np.float32)
        )

    return relief


def gadroons(count: int, turns: float, depth: float) -> Ornament:
    """Convex lobes with rounded ends, twisted by ``turns`` repeats over the band."""

    def relief(patch: Patch) -> Relief:
        f = _across(patch, count, turns)
        g = _end(patch, patch.girth / (2 * count))
        return Relief((depth * np.sqrt(np.clip(1 - f * f - g * g, 0, 1))).astype(np.float32))

    return relief


def flutes(count: int, turns: float, depth: float, arris: float, edge: Substance) -> Ornament:
    """Concave (parabolic) channels with rounded ends; the ridges between (``arris`` of a repeat
    wide) are ``edge``."""

    def relief(patch: Patch) -> Relief:
        f = _across(patch, count, turns) / (1 - arris)
        g = _end(patch, patch.girth / (2 * count) * 1.2)
        inside = 1 - f * f - g * g
        ridge = smoothstep(0.16, 0.04, inside)
        return Relief(
            (-depth * np.clip(inside, 0, 1)).astype(np.float32),
            layers=((ridge.astype(np.float32), edge),),
        )

    return relief


def petals(count: int, depth: float, front: Substance, back: Substance, rim: Substance) -> Ornament:
    """A calyx: two ranks of pointed leaves, the back one taller and between the leaves in front."""

    def relief(patch: Patch) -> Relief:
        height = np.zeros((len(patch.t), len(patch.u)), np.float32)
        layers = []
        half = patch.girth / (2 * count)
        for shift, top, lift, body in ((0.5, 0.97, 0.35, back), (0.0, 0.74, 0.6, front)):
            f = _across(patch, count, shift=shift)
            width = np.sqrt(np.clip(1 - (patch.t[:, None] / top) ** 2.6, 0, 1)) ** 1.5
            inside = (width - np.abs(f)) * half  # about metres from the leaf's edge
            pillow = np.clip(inside / half, 0, 1)
            rib = np.exp(-((f * half / 0.0016) ** 2)) * smoothstep(0.0, 0.004, inside)
            leaf = (
                depth * (lift * smoothstep(0, 0.0026, inside) + 0.75 * np.sqrt(pillow))
                - 0.5 * depth * rib
            )
            root = smoothstep(0.0, 0.06, patch.t)[:, None]
            mask = smoothstep(-0.0002, 0.0003, inside)
            height = np.where(inside > 0, np.maximum(height * 0.4, leaf * root), height).astype(
                np.float32
            )
            layers += [(mask, rim), (smoothstep(0.0016, 0.0021, inside) * (1 - 0.9 * rib), body)]
        return Relief(height, layers=tuple((m.astype(np.float32), body) for m, body in layers))

    return relief


def tongues(count: int, depth: float, body: Substance, core: Substance, rim: Substance) -> Ornament:
    """Long round-ended leaves that radiate over a shoulder, rimmed, with a lighter core."""

    def relief(patch: Patch) -> Relief:
        half = patch.girth / (2 * count)
        f = _across(patch, count)
        g = np.clip(1 - patch.t[:, None] * patch.length / half, 0, 1)
        inside = (0.93 - np.sqrt(f * f + g * g)) * half
        height = depth * np.sqrt(np.clip(inside / half, 0, 1)) * _fade(patch, 0.03)
        wire = smoothstep(-0.0004, 0.0002, inside) * smoothstep(0.0018, 0.0012, inside)
        core_mask = smoothstep(0.0050, 0.0055, inside) * smoothstep(0.82, 0.80, patch.t)[:, None]
        core_wire = smoothstep(0.0038, 0.0042, inside) * smoothstep(0.84, 0.83, patch.t)[:, None]
        masks = (
            (smoothstep(0, 0.0004, inside), body),
            (core_wire, rim),
            (core_mask, core),
            (wire, rim),
        )
        micro = 0.0003 * np.maximum(wire, core_wire * (1 - core_mask))
        return Relief(
            height.astype(np.float32),
            micro.astype(np.float32),
            tuple((m.astype(np.float32), b) for m, b in masks),
        )

    return relief


def scales(
    count: int, ranks: int, depth: float, body: Substance, tip: Substance, rim: Substance
) -> Ornament:
    """Overlapping round scales, points down, ``ranks`` rows of them."""

    def relief(patch: Patch) -> Relief:
        y = patch.t[:, None] * (ranks + 0.35)
        height = np.zeros((len(patch.t), len(patch.u)), np.float32)
        masks = [np.zeros_like(height) for _ in range(3)]
        for rank in range(-1, ranks + 1):  # a rank lies over the one below it: painted later
            f = _across(patch, count, shift=0.5 * (rank % 2))
            below = np.clip(rank + 0.95 - y, 0, None)
            distance = np.sqrt((f * 0.98) ** 2 + (below * 0.95) ** 2)
            inside = 1 - distance
            owns = (inside > 0) & (y < rank + 1.6)
            slope = (
                depth * (0.25 + 0.75 * np.clip(below, 0, 1) ** 1.2) * smoothstep(0, 0.10, inside)
            )
            height = np.where(owns, slope + 0.0004 * rank / ranks, height)
            wire = smoothstep(0.0, 0.03, inside) * smoothstep(0.17, 0.12, inside)
            spot = smoothstep(0.30, 0.34, inside) * smoothstep(0.25, 0.5, below)
            for mask, value in zip(masks, (np.ones_like(distance), spot, wire), strict=True):
                mask[...] = np.where(owns, value, mask)
        fade = _fade(patch, 0.02)
        layers = tuple(
            (m.astype(np.float32), b) for m, b in zip(masks, (body, tip, rim), strict=True)
        )
        return Relief(
            (height * fade).astype(np.float32), (0.0002 * masks[2]).astype(np.float32), layers
        )

    return relief


def meander(count: int, depth: float, groove: Substance) -> Ornament:
    """The Greek key, engraved: a running line with square spirals."""

    def relief(patch: Patch) -> Relief:
        distance = _meander_stencil().sample(patch.u, patch.t, count) * (patch.girth / count)
        cut = smoothstep(0.0005, -0.0005, distance).astype(np.float32)
        return Relief(
            -depth * cut,
            layers=((smoothstep(0.0003, -0.0003, distance).astype(np.float32), groove),),
        )

    return relief


@cache
def _meander_stencil() -> Stencil:
    period, top = 5.0, 4.0
    x, y = repeat_grid(320, 1.0)
    key = [(0, 0), (0, top), (4, top), (4, 1.3), (1.35, 1.3), (1.35, 2.7), (2.7, 2.7)]
    lines = [[(-0.5, 0.0), (period - 0.5, 0.0)], [(a, b) for a, b in key]]
    scale = 1 / period
    curves = [
        polyline([((a - 2.0) * scale, (b - top / 2) * scale) for a, b in line]) for line in lines
    ]
    return Stencil(stroke_distance(x, y, curves, [np.full(len(c), 0.31 * scale) for c in curves]))


def _across(patch: Patch, count: int, turns: float = 0.0, shift: float = 0.0) -> NDArray:
    """f in [-1, 1] over each of ``count`` repeats, (H, W), or (1, W) when untwisted."""
    phase = patch.u[None] * count + shift
    if turns:
        phase = phase + turns * patch.t[:, None]
    return 2 * (phase % 1.0) - 1


def _fade(patch: Patch, share: float) -> NDArray:
    """0 at the band's ends, 1 further in than ``share`` of its length: (H, 1)."""
    return smoothstep(0.0, share, np.minimum(patch.t, 1 - patch.t))[:, None]


def _end(patch: Patch, reach: float) -> NDArray:
    """1 at the band's ends, 0 further in than ``reach`` metres: (H, 1)."""
    return np.clip(1 - np.minimum(patch.t, 1 - patch.t) * patch.length / reach, 0, 1)[:, None]
