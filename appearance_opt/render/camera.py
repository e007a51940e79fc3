"""Cameras and lights of samples, rays through the image, and points projected onto it."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from appearance_opt.views import RECORD


@dataclass
class Camera:
    """Camera and light of the view of each sample."""

    eye: mi.Point3f
    forward: mi.Vector3f
    right: mi.Vector3f
    down: mi.Vector3f
    light: mi.Point3f
    intensity: mi.Float


def camera_of(records: mi.Float, view: mi.UInt32) -> Camera:
    """Gather the camera and light of each sample's view (see ``Views.records``)."""
    r = dr.gather(mi.ArrayXf, records, view, shape=(RECORD, dr.width(view)))
    return Camera(
        mi.Point3f(r[0], r[1], r[2]),
        mi.Vector3f(r[4], r[5], r[6]),
        mi.Vector3f(r[8], r[9], r[10]),
        mi.Vector3f(r[12], r[13], r[14]),
        mi.Point3f(r[3], r[7], r[11]),
        r[15],
    )


def direction(camera: Camera, x: mi.Float, y: mi.Float, resolution: mi.Float) -> mi.Vector3f:
    """Return the direction of the ray through pixel position (x, y); its component along
    ``forward`` is 1."""
    scale = 2 / resolution
    return camera.forward + camera.right * dr.fma(x, scale, -1) + camera.down * dr.fma(y, scale, -1)


def project(
    camera: Camera, p: mi.Point3f, resolution: mi.Float
) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Return the pixel position (x, y) and depth along ``forward`` of world points. Differentiable
    in p."""
    v = p - camera.eye
    depth = dr.dot(v, camera.forward)
    half = 0.5 * resolution
    scale = half / (depth * dr.squared_norm(camera.right))
    return (
        dr.fma(dr.dot(v, camera.right), scale, half),
        dr.fma(dr.dot(v, camera.down), scale, half),
        depth,
    )
