"""Single against double precision of each shading and mesh function, over its whole domain."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from appearance_opt.initial.sphere import sphere
from appearance_opt.latent import mesh_ops
from appearance_opt.optimize import losses
from appearance_opt.render import brdf, camera, surface
from appearance_opt.render.boundary import coverage
from experiments.accuracy.double import double_arrays, in_double

COUNT = 200_000


@dataclass(frozen=True)
class Line:
    """Errors of one function: of each value (vectors: by their length) relative to the exact one,
    or to 1e-4 of the largest where it is smaller than that, as a difference that cancels has no
    digits to keep."""

    function: str
    domain: str
    largest: float
    mean: float


def line(function: str, domain: str, single: Any, double: Any) -> Line:
    """Errors of matching results: arrays, or vectors."""
    a, b = (np.atleast_2d(np.array(x)).astype(np.float64) for x in (single, double))
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError(f"{function}: a value over {domain} is not finite")
    size = np.linalg.norm(b, axis=0)
    error = np.linalg.norm(a - b, axis=0) / np.maximum(size, 1e-4 * size.max())
    return Line(function, domain, float(error.max()), float(error.mean()))


class Precision:
    """The types and modules of one precision."""

    def __init__(self, double: bool) -> None:
        self.double = double
        arrays = double_arrays()
        self.float = arrays.Float64 if double else mi.Float
        self.three = arrays.Array3f64 if double else mi.Vector3f
        self.color = arrays.Array3f64 if double else mi.Color3f
        twin = in_double if double else (lambda m, **_: m)
        self.brdf, self.losses, self.mesh_ops, self.coverage = map(
            twin, (brdf, losses, mesh_ops, coverage)
        )
        self.camera = twin(camera)
        self.surface = twin(surface, direction=self.camera.direction)

    def vector(self, rows: NDArray) -> Any:
        """(N, 3) to a device vector."""
        dtype = np.float64 if self.double else np.float32
        return self.three(*(self.float(np.ascontiguousarray(rows[:, k], dtype)) for k in range(3)))

    def scalar(self, values: NDArray) -> Any:
        return self.float(np.ascontiguousarray(values, np.float64 if self.double else np.float32))


def directions(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Unit vectors of the upper hemisphere, a third of them within a degree of the horizon, some at
    the pole."""
    z = rng.random(count)
    z[: count // 3] = rng.random(count // 3) * 0.0175
    z[-100:] = 1.0
    angle = rng.uniform(0, 2 * np.pi, count)
    r = np.sqrt(1 - z**2)
    return rng.permutation(np.stack([r * np.cos(angle), r * np.sin(angle), z], 1)).astype(
        np.float32
    )


def lines() -> list[Line]:
    """All functions."""
    one, two = Precision(False), Precision(True)
    return [*reflection(one, two), *tone(one, two), *geometry(one, two), *screen(one, two)]


def reflection(one: Precision, two: Precision) -> list[Line]:
    """``brdf.reflect`` over hemispheres of light and viewer, for bands of roughness."""
    out = []
    for low, high in ((0.08, 0.08), (0.08, 0.3), (0.3, 1.0), (1.0, 1.0)):
        rng = np.random.default_rng(1)
        v, light = directions(rng, COUNT), directions(rng, COUNT)
        mirror = slice(0, COUNT // 5)  # exactly in mirror direction: the peak
        light[mirror] = v[mirror] * np.array([-1, -1, 1], np.float32)
        base, rest = (
            rng.random((COUNT, 3)).astype(np.float32),
            rng.random((COUNT, 3)).astype(np.float32),
        )
        roughness = (low + (high - low) * rest[:, 0]).astype(np.float32)
        metalness = np.where(rest[:, 1] < 0.2, 0, np.where(rest[:, 1] > 0.8, 1, rest[:, 1])).astype(
            np.float32
        )
        results = []
        for p in (one, two):
            color = p.color(*(p.scalar(base[:, k]) for k in range(3)))
            m = p.brdf.MaterialSample(color, p.scalar(roughness), p.scalar(metalness))
            n = p.vector(np.tile(np.array([0, 0, 1], np.float32), (COUNT, 1)))
            results.append(p.brdf.reflect(m, n, p.vector(v), p.vector(light)))
        out.append(
            line(
                "brdf.reflect",
                f"roughness {low} to {high}, all directions, mirror and grazing",
                *results,
            )
        )
    return out


def tone(one: Precision, two: Precision) -> list[Line]:
    """Tone map and losses from 0 to 1e6."""
    rng = np.random.default_rng(2)
    x = np.concatenate([[0.0, 0.0031308, 0.00313571, 1e6], 10 ** rng.uniform(-8, 6, COUNT)]).astype(
        np.float32
    )
    y = (x * (1 + 0.3 * rng.normal(size=len(x)).astype(np.float32))).clip(0).astype(np.float32)
    out = []
    pairs = [("losses.srgb", "srgb", False), ("losses.tone_map", "tone_map", False)]
    pairs += [(f"losses.{n.__name__}", n.__name__, True) for n in losses.LOSSES.values()]
    for label, name, binary in pairs:
        results = []
        for p in (one, two):
            a, b = p.color(p.scalar(x)), p.color(p.scalar(y))
            f = getattr(p.losses, name)
            results.append((f(a, b) if binary else f(a)).x)
        out.append(line(label, "0 to 1e6", *results))
    return out


def geometry(one: Precision, two: Precision) -> list[Line]:
    """Normals and tangent bases of a rough sphere, and of one squeezed to slivers."""
    mesh = sphere(4000, (0.1, 0.2, 0.3), 0.7, 64)
    rng = np.random.default_rng(3)
    rough = mesh.positions + rng.normal(scale=0.005, size=mesh.positions.shape)
    out = []
    for domain, scale in (
        ("rough sphere", (1, 1, 1)),
        ("the same, 1 : 1000 flat", (1, 1, 0.001)),
        ("scaled by 1e-3", (1e-3,) * 3),
    ):
        positions = (rough * np.array(scale)).astype(np.float32).ravel()
        corner = [mi.UInt32(np.ascontiguousarray(mesh.faces[:, k], np.uint32)) for k in range(3)]
        frame = [
            mi.UInt32(np.ascontiguousarray(mesh.frame_faces[:, k], np.uint32)) for k in range(3)
        ]
        normals, tangents = [], []
        for p in (one, two):
            c = p.mesh_ops.Corners(
                vertex=tuple(corner),
                normal=tuple(corner),
                frame=tuple(frame),
                normal_vertex=None,
                frame_normal=mi.UInt32(mesh.frame_vertex.astype(np.uint32)),
                uvs=p.scalar(mesh.uvs.ravel()),
                edge=None,
                local=None,
            )
            n = p.mesh_ops.vertex_normals(p.scalar(positions), c)
            normals.append(n)
            tangents.append(p.mesh_ops.vertex_tangents(p.scalar(positions), n, c))
        out += [
            line("mesh_ops.vertex_normals", domain, *normals),
            line("mesh_ops.vertex_tangents", domain, *tangents),
        ]
    return out


def screen(one: Precision, two: Precision) -> list[Line]:
    """Projection, hit points and covered area."""
    rng = np.random.default_rng(5)
    points = (rng.normal(size=(COUNT, 3)) * 0.6).astype(np.float32)
    eye = np.tile(np.array([1.5, 1.0, 3.2], np.float32), (COUNT, 1))
    forward = -eye / np.linalg.norm(eye, axis=1, keepdims=True)
    right = np.cross(forward, [0, 1, 0])
    right *= 0.287 / np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    angle, distance = rng.uniform(0, 2 * np.pi, COUNT), rng.uniform(-0.8, 0.8, COUNT)
    pixel, area = [], []
    for p in (one, two):
        seen_from = SimpleNamespace(
            eye=p.vector(eye),
            forward=p.vector(forward.astype(np.float32)),
            right=p.vector(right.astype(np.float32)),
            down=p.vector(down.astype(np.float32)),
        )
        pixel.append(p.camera.project(seen_from, p.vector(points), p.float(512))[0])
        n = p.scalar(np.cos(angle).astype(np.float32)), p.scalar(np.sin(angle).astype(np.float32))
        area.append(p.coverage.half_plane_area(*n, p.scalar(distance.astype(np.float32))))
    out = [line("camera.project", "points within the view, 512 pixels", *pixel)]
    out.append(line("coverage.half_plane_area", "all lines", *area))
    return out + [hits(one, two, limit) for limit in (0.2, 0.01, 1e-4)]


def hits(one: Precision, two: Precision, cosine: float) -> Line:
    """Barycentric coordinates of rays at triangles seen at one angle: the position is rebuilt from
    them."""
    rng = np.random.default_rng(6)
    count = COUNT // 4
    p0 = rng.normal(size=(count, 3)) * 0.3
    view = p0 - np.array([0.0, 0.0, 3.5])
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    side = np.cross(view, rng.normal(size=(count, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(view, side)
    lean = other * cosine + view * np.sqrt(1 - cosine**2)
    triangle = np.stack([p0, p0 + 0.05 * side, p0 + 0.05 * lean], 1).astype(np.float32)
    b1, b2 = rng.random((2, count)) * 0.5
    target = (
        triangle[:, 0] * (1 - b1 - b2)[:, None]
        + triangle[:, 1] * b1[:, None]
        + triangle[:, 2] * b2[:, None]
    )
    scale = 1 / np.tan(np.radians(16))
    d = target - np.array([0.0, 0.0, 3.5])
    x, y = ((1 + a / -d[:, 2] * scale) * 256 for a in (d[:, 0], -d[:, 1]))
    vertices = np.zeros((3 * count, 8), np.float32)
    vertices[:, :3] = triangle.reshape(-1, 3)
    vertices[:, 6] = 1
    faces = np.zeros((count, 4), np.uint32)
    faces[:, :3] = np.arange(3 * count).reshape(-1, 3)
    results = []
    for p in (one, two):
        ones = np.ones((count, 1), np.float32)
        half = np.float32(np.tan(np.radians(16)))
        axes = [
            np.array(a, np.float32) for a in ((0, 0, 3.5), (0, 0, -1), (half, 0, 0), (0, -half, 0))
        ]
        eye, forward, right, down = (p.vector(ones * a) for a in axes)
        camera = SimpleNamespace(eye=eye, forward=forward, right=right, down=down)
        s = SimpleNamespace(
            x=p.scalar(x.astype(np.float32)),
            y=p.scalar(y.astype(np.float32)),
            triangle=dr.arange(mi.UInt32, count),
        )
        shape = p.surface.Surface(mi.UInt32(faces.ravel()), p.scalar(vertices.ravel()))
        results.append(p.surface.interpolate(shape, camera, s, p.float(512), p.float(1.0)).position)
    return line(
        "surface.interpolate, position", f"triangles seen at a cosine of {cosine}", *results
    )
