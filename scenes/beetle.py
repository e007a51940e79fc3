"""A horned beetle as a distance field: a smooth body, legs as thin as a hundredth of it, sharp edges
of its shields, spikes and a horn. ``appearance-opt convert sdf scenes/beetle.py:scene``."""

from __future__ import annotations

import mitsuba as mi

from appearance_opt import sdf

SHELL, BELLY, BONE, EYE = (
    (0.02, 0.16, 0.13),
    (0.28, 0.09, 0.03),
    (0.75, 0.66, 0.45),
    (0.9, 0.5, 0.05),
)

LEGS = (  # knee, foot, z of the hip
    ((0.66, 0.42, 0.42), (0.95, -0.34, 0.62), 0.25),
    ((0.72, 0.46, -0.05), (1.02, -0.34, -0.05), -0.02),
    ((0.64, 0.42, -0.52), (0.92, -0.34, -0.82), -0.3),
)


def body(p: mi.Point3f) -> mi.Float:
    """Abdomen, thorax and head, with a waist between them."""
    abdomen = sdf.ellipsoid(sdf.translate(p, (0, 0.08, -0.38)), (0.44, 0.33, 0.58))
    thorax = sdf.ellipsoid(sdf.translate(p, (0, 0.1, 0.24)), (0.36, 0.3, 0.28))
    head = sdf.sphere(sdf.translate(p, (0, 0.06, 0.58)), 0.19)
    return sdf.smooth_union(sdf.smooth_union(abdomen, thorax, 0.06), head, 0.08)


def shields(p: mi.Point3f) -> mi.Float:
    """Two wing cases: a shell around the abdomen, cut off by planes with a gap between them."""
    q = sdf.mirror(p)
    shell = sdf.onion(sdf.ellipsoid(sdf.translate(p, (0, 0.1, -0.38)), (0.5, 0.39, 0.64)), 0.03)
    shell = sdf.intersection(shell, 0.02 - q.x, -sdf.plane(p, (0, 1, 0), 0.06))
    return sdf.intersection(shell, sdf.plane(p, (0, 0.3, 0.954), -0.02))


def horn(p: mi.Point3f) -> mi.Float:
    """A bent horn that ends in a point, and three spikes on either side of the thorax."""
    q = sdf.mirror(p)
    lower = sdf.capsule(p, (0, 0.16, 0.66), (0, 0.42, 0.98), 0.07, 0.045)
    upper = sdf.capsule(p, (0, 0.42, 0.98), (0, 0.78, 0.98), 0.045, 0.006)
    spikes = [
        sdf.cone(sdf.rotate(sdf.translate(q, (0.2, 0.4, z)), (0, 0, 1), -28.0), 0.055, 0.002, 0.12)
        for z in (0.12, 0.26, 0.4)
    ]
    return sdf.union(sdf.smooth_union(lower, upper, 0.04), *spikes)


def legs(p: mi.Point3f) -> mi.Float:
    """Three pairs of thin legs with claws, and a pair of feelers."""
    q = sdf.mirror(p)
    parts = []
    for knee, foot, hip in LEGS:
        parts.append(sdf.capsule(q, (0.2, 0.02, hip), knee, 0.05, 0.026))
        parts.append(sdf.capsule(q, knee, foot, 0.026, 0.012))
    parts.append(sdf.capsule(q, (0.08, 0.14, 0.72), (0.42, 0.34, 1.0), 0.018, 0.01))
    parts.append(sdf.sphere(sdf.translate(q, (0.42, 0.34, 1.0)), 0.035))
    return sdf.union(*parts)


def eyes(p: mi.Point3f) -> mi.Float:
    """A pair of balls."""
    return sdf.sphere(sdf.translate(sdf.mirror(p), (0.14, 0.12, 0.66)), 0.06)


def distance(p: mi.Point3f) -> mi.Float:
    """All of it."""
    return sdf.union(sdf.smooth_union(body(p), legs(p), 0.03), shields(p), horn(p), eyes(p))


def material(p: mi.Point3f) -> sdf.Material:
    """Shining wing cases with bands, a rough belly with stripes, pale horn, gold eyes."""
    grain = sdf.fractal_noise(p * 9, 3)
    bands = sdf.step(0.0, sdf.noise(p * mi.Vector3f(2, 2, 7)) + 0.3 * grain, 0.08)
    color = sdf.mix(BELLY, (0.5, 0.22, 0.06), sdf.step(0.1, grain, 0.3))
    rough, metal = mi.Float(0.65), mi.Float(0)
    parts = (
        (shields(p), sdf.mix(SHELL, (0.55, 0.4, 0.06), bands), 0.28, 0.6),
        (horn(p), sdf.mix(BONE, (0.35, 0.22, 0.12), sdf.step(0.0, grain, 0.5)), 0.4, 0.0),
        (eyes(p), EYE, 0.15, 0.0),
    )
    skin = sdf.union(body(p), legs(p))
    for part, paint, roughness, metalness in parts:
        there = sdf.step(0.0, skin - part, 0.01)
        color = sdf.mix(color, paint, there)
        rough, metal = sdf.mix(rough, roughness, there), sdf.mix(metal, metalness, there)
        skin = sdf.union(skin, part)
    return sdf.Material(color, rough, metal)


scene = sdf.Shape(distance, ((-1.1, -0.4, -1.15), (1.1, 0.85, 1.1)), material)
