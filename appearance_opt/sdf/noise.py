"""Noise for materials and for rough surfaces.

Gradient noise: Perlin 1985 with the quintic fade of Perlin 2002, gradients from an integer hash
(pcg3d of Jarzynski and Olano 2020). A surface that noise is added to changes by more than 1 per unit
of length: add little, or let steps be shortened.
"""

from __future__ import annotations

from itertools import product

import drjit as dr
import mitsuba as mi


def noise(p: mi.Point3f, seed: int = 0) -> mi.Float:
    """Smooth noise in about [-1, 1], with details of about one unit of length."""
    cell = dr.floor(dr.detach(mi.Point3f(p)))
    inside = p - cell
    corner = mi.Vector3u(mi.Vector3i(cell))
    fade = [x * x * x * (x * (x * 6 - 15) + 10) for x in inside]
    total = mi.Float(0)
    for at in product((0, 1), repeat=3):
        weight = mi.Float(1)
        for f, bit in zip(fade, at, strict=True):
            weight *= f if bit else 1 - f
        slope = _gradient(corner + mi.Vector3u(*at), seed)
        total += weight * dr.dot(slope, mi.Vector3f(inside) - mi.Vector3f(*at))
    return total


def fractal_noise(p: mi.Point3f, octaves: int = 4, seed: int = 0, gain: float = 0.5) -> mi.Float:
    """A sum of noise, each octave twice as fine and ``gain`` times as strong as the one before."""
    total, strength = mi.Float(0), 1.0
    for octave in range(octaves):
        total += strength * noise(p * float(1 << octave), seed + octave)
        strength *= gain
    return total


def _gradient(corner: mi.Vector3u, seed: int) -> mi.Vector3f:
    """A vector in [-1, 1]^3 for each corner of the lattice."""
    factor, increment = mi.UInt32(1664525), mi.UInt32(1013904223)
    x, y, z = (c * factor + increment for c in (corner.x, corner.y, corner.z ^ mi.UInt32(seed)))
    x += y * z
    y += z * x
    z += x * y
    x, y, z = (v ^ (v >> 16) for v in (x, y, z))
    x += y * z
    y += z * x
    z += x * y
    return mi.Vector3f(*(mi.Float(v >> 8) * (2 / 0xFFFFFF) - 1 for v in (x, y, z)))
