"""Where two surfaces run into each other: a boundary without an edge.

On one side of the curve in which two sheets meet the one hides the other, on the other side the
other the one. In the image, the reciprocal depth of a triangle's plane is an affine function of the
position; where those of the two sheets are equal, the curve crosses. From the differences before
and behind the crossing follows its place, and from its derivative the motion of the curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from appearance_opt.render import rays, silhouette
from appearance_opt.render.math import clamp
from appearance_opt.render.rays import Samples
from appearance_opt.render.silhouette import EdgeList
from appearance_opt.render.silhouette_walk import Neighbours

FLATTEST = 2e-5
"""Sheets whose reciprocal depths differ less, before and behind a crossing together and relative to
themselves, do not meet: this is the rounding of one sheet at the seam of two triangles, or a
contact too flat to have a place."""


@dataclass
class Intersections:
    """M places where one sheet passes through another between two samples, ``inside`` and
    ``outside``.

    ``horizontal``: are they beside each other? ``position``: of the crossing, from the inside
    sample in units of their distance; ``area``: that is swept when it moves by one unit, in pixels;
    ``pixel``: index of the pixel that changes.
    """

    inside: Samples
    outside: Samples
    horizontal: mi.Bool
    position: mi.Float
    area: mi.Float
    pixel: mi.UInt32


def find(
    edges: EdgeList,
    vertices: mi.Float,
    records: mi.Float,
    pairs: Neighbours,
    resolution: mi.Float,
) -> Intersections | None:
    """The crossings between samples whose sheets go on under each other. None without any. ``area``
    and ``pixel`` are left to the caller."""
    front, back = pairs.front, pairs.back
    camera = rays.camera_of(records, front.view)
    first, last = _differences(edges, vertices, camera, front, back, resolution)
    one, other = (_slope(edges, vertices, camera, s.triangle) for s in (front, back))
    dx, dy = dr.abs(one[0] - other[0]), dr.abs(one[1] - other[1])
    ours = dr.select(pairs.horizontal, dx >= dy, dy > dx)
    inverse_depth = dr.abs(
        _inverse_depth(edges, vertices, camera, front.triangle, front, resolution)
    )
    steep = first - last > FLATTEST * inverse_depth
    kept = dr.compress(ours & steep & (first > 0) & (last < 0))
    if dr.width(kept) == 0:
        return None
    p = pairs.keep(kept)
    position = clamp(dr.gather(mi.Float, first / (first - last), kept), 0, 1)
    return Intersections(p.front, p.back, p.horizontal, position, mi.Float(1), mi.UInt32(0))


def motion(
    edges: EdgeList,
    vertices: mi.Float,
    records: mi.Float,
    found: Intersections,
    resolution: mi.Float,
) -> mi.Float:
    """Position of each crossing in units of the samples' distance, differentiable in
    ``vertices``."""
    camera = rays.camera_of(records, found.inside.view)
    first, last = _differences(edges, vertices, camera, found.inside, found.outside, resolution)
    return first / (first - last)


def _differences(
    edges: EdgeList,
    vertices: mi.Float,
    camera: rays.Camera,
    front: Samples,
    back: Samples,
    resolution: mi.Float,
) -> tuple[mi.Float, mi.Float]:
    """Reciprocal depth of the front samples' triangles less that of the back samples', at the front
    samples and at the back samples. The planes that are seen stand for their sheets: hidden
    triangles can be edge-on."""
    first, last = (
        _inverse_depth(edges, vertices, camera, front.triangle, at, resolution)
        - _inverse_depth(edges, vertices, camera, back.triangle, at, resolution)
        for at in (front, back)
    )
    return first, last


def _inverse_depth(
    edges: EdgeList,
    vertices: mi.Float,
    camera: rays.Camera,
    triangle: mi.UInt32,
    at: Samples,
    resolution: mi.Float,
) -> mi.Float:
    """Reciprocal depth of the planes of triangles at samples."""
    return dr.dot(
        _plane(edges, vertices, camera, triangle), rays.direction(camera, at.x, at.y, resolution)
    )


def _slope(
    edges: EdgeList, vertices: mi.Float, camera: rays.Camera, triangle: mi.UInt32
) -> tuple[mi.Float, mi.Float]:
    """Change of the reciprocal depth across the image, to the right and down, but for a common
    factor."""
    n = _plane(edges, vertices, camera, triangle)
    return dr.dot(n, camera.right), dr.dot(n, camera.down)


def _plane(
    edges: EdgeList, vertices: mi.Float, camera: rays.Camera, triangle: mi.UInt32
) -> mi.Vector3f:
    """The vector whose product with a ray's direction is the reciprocal depth of the triangle's
    plane along it."""
    face = dr.gather(mi.ArrayXu, edges.around, triangle, shape=(12, dr.width(triangle)))
    a, b, c = (silhouette.position(vertices, face[k]) for k in range(3))
    n = dr.cross(b - a, c - a)
    height = dr.dot(n, a - camera.eye)
    return n / dr.select(dr.abs(height) > 1e-30, height, 1e-30)
