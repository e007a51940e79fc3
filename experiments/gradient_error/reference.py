"""The truth: central finite differences of the loss of a heavily supersampled, box-filtered image.

Only pixels that a change can touch are rendered. All differences of one half share their sample
positions, random by pixel; the two halves have others, so that their disagreement bounds the
reference's own error. Cached by the hash of everything that made it, this file's source included.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from appearance_opt.latent import mesh_ops
from appearance_opt.render import brdf, lattice, material, rays, shading, surface, upload
from appearance_opt.render.drawn import Shown
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.shading import shade
from experiments.gradient_error.problems import BACKGROUND, Problem, smooth_fields

CACHE = Path("out/gradient_error/cache")
FIELDS = 12
VERTICES = 20
FIELD_SAMPLES, TARGET_SAMPLES = 128, 1024
"""At 128 squared pixels; at others so many that a row of pixels has as many: what a silhouette
sweeps over, and so the noise of a difference, grows with its length in pixels."""

VERTEX_SAMPLES = (256, 1024)
"""Least and most; in between as many as VERTEX_RAYS rays allow."""

VERTEX_RAYS = 1 << 17
CHUNK = 1 << 20


@dataclass(frozen=True)
class Truth:
    """``target`` (P, 3): the target image over the background. ``fields`` (N, V, 3) unit
    displacements and ``by_field`` (2, N): dLoss along them, by each half. ``vertices`` (K,) and
    ``by_vertex`` (2, K, 3)."""

    target: NDArray[np.float32]
    fields: NDArray[np.float32]
    by_field: NDArray[np.float64]
    vertices: NDArray[np.int64]
    by_vertex: NDArray[np.float64]


class Supersampler:
    """Box-filtered images of one problem for any positions, on any pixels."""

    def __init__(self, problem: Problem, positions: NDArray, colors: NDArray) -> None:
        self.problem = problem
        self.topology = problem.topology()
        self.colors = colors
        self.batch = Batch(problem.views.records(), Grid(1, problem.resolution))
        self.scene = upload.scene_of(positions, problem.faces)
        self.parameters = mi.traverse(self.scene)
        self.move(positions)

    def move(self, positions: NDArray) -> None:
        """Other positions (V, 3)."""
        flat = mi.Float(np.ascontiguousarray(positions, np.float32).ravel())
        self.parameters["mesh.vertex_positions"] = flat
        self.parameters.update()
        with dr.suspend_grad():
            surface = self.problem.surface(self.topology, flat, self.colors)
            dr.eval(surface.vertices, surface.colors)
        self.shown = Shown(surface, self.problem.maps)

    def image(self, pixels: NDArray, samples: int, half: int) -> NDArray[np.float64]:
        """Linear RGB over the background of the given pixels (P,), each the mean of ``samples``
        rays: (P, 3). ``half`` picks one of independent sets of sample positions."""
        per_pass = max(1, CHUNK // len(pixels))
        offsets = lattice.sub_pixel_offsets(samples)
        total = np.zeros((len(pixels), 4))
        for start in range(0, samples, per_pass):
            total += self._pass(pixels, offsets[start : start + per_pass], half)
        total /= samples
        return total[:, :3] + (1 - total[:, 3:]) * np.array(BACKGROUND)

    def _pass(self, pixels: NDArray, offsets: NDArray, half: int) -> NDArray[np.float64]:
        n, count = len(pixels), len(offsets)
        pixel, at = mi.UInt32(pixels.astype(np.uint32)), mi.Float(offsets.ravel())
        i = dr.arange(mi.UInt32, n * count)
        k = i // dr.opaque(mi.UInt32, count)
        j = 2 * (i - k * dr.opaque(mi.UInt32, count))
        index = dr.gather(mi.UInt32, pixel, k)
        row = index // dr.opaque(mi.UInt32, self.problem.resolution)
        column = index - row * dr.opaque(mi.UInt32, self.problem.resolution)
        # the pattern is rotated by a random amount in every pixel (Cranley and Patterson 1976)
        shift_x = mi.sample_tea_float32(index, dr.opaque(mi.UInt32, 2 * half))
        shift_y = mi.sample_tea_float32(index, dr.opaque(mi.UInt32, 2 * half + 1))
        dx, dy = dr.gather(mi.Float, at, j) + shift_x, dr.gather(mi.Float, at, j + 1) + shift_y
        x, y = mi.Float(column) + dx - dr.floor(dx), mi.Float(row) + dy - dr.floor(dy)
        hits = rays.trace(self.scene, self.batch, dr.zeros(mi.UInt32, n * count), x, y)
        dr.eval(hits, k)
        kept = dr.compress(hits.triangle != MISS)
        image = dr.zeros(mi.Float, 4 * n)
        if dr.width(kept):
            hits, k = hits.keep(kept), dr.gather(mi.UInt32, k, kept)
            with dr.suspend_grad():
                c = shade(self.shown, self.batch, hits, dr.opaque(mi.Float, 1 / 16))
            value = mi.ArrayXf([c.x, c.y, c.z, dr.full(mi.Float, 1, dr.width(kept))])
            dr.scatter_reduce(dr.ReduceOp.Add, image, value, k, mode=dr.ReduceMode.Local)
        return np.array(image).reshape(n, 4).astype(np.float64)


def tone(x: NDArray) -> NDArray:
    """The tone map of the log-sRGB loss, in double precision."""
    y = np.log1p(np.maximum(x, 0))
    return np.where(
        y <= 0.0031308, 12.92 * y, 1.055 * np.maximum(y, 0.0031308) ** (1 / 2.4) - 0.055
    )


def pixel_losses(loss: str, image: NDArray, target: NDArray) -> float:
    """Sum over pixels and channels of "log-srgb-l1" or "l2"."""
    if loss == "l2":
        return float(np.sum((image - target) ** 2))
    return float(np.sum(np.abs(tone(image) - tone(target))))


def truth(problem: Problem, loss: str, force: bool = False) -> Truth:
    """The reference of a problem, from the cache where its hash is there."""
    key = hashlib.sha256(_sources() + _fingerprint(problem) + loss.encode()).hexdigest()[:20]
    path = CACHE / f"{problem.name}_{problem.resolution}_{loss}_{key}.npz"
    if path.exists() and not force:
        with np.load(path) as data:
            return Truth(**{k: data[k] for k in data.files})
    result = _compute(problem, loss)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".partial.npz")
    np.savez_compressed(temporary, **vars(result))
    temporary.rename(path)
    return result


def _sources() -> bytes:
    """Source code of everything that the reference's images depend on."""
    modules = (rays, lattice, shading, surface, material, brdf, mesh_ops)
    return (
        b"".join(Path(str(m.__file__)).read_bytes() for m in modules) + Path(__file__).read_bytes()
    )


def _fingerprint(problem: Problem) -> bytes:
    parts = [
        repr(v).encode() if not isinstance(v, np.ndarray) else v.tobytes()
        for v in vars(problem).values()
    ]
    return b"".join(parts)


def _compute(problem: Problem, loss: str) -> Truth:
    everything = np.arange(problem.resolution**2)
    view = Supersampler(problem, problem.target_positions, problem.target_colors)
    target = view.image(everything, round(TARGET_SAMPLES * 128 / problem.resolution), 7)
    view = Supersampler(problem, problem.positions, problem.colors)
    step = problem.step * problem.pixel_size
    finer = round(0.1 / problem.step)
    field_samples = round(finer * FIELD_SAMPLES * 128 / problem.resolution)
    near = _near(view)
    scale = 1 / (3 * problem.resolution**2)
    start = problem.positions.astype(np.float64)

    def difference(change: NDArray, pixels: NDArray, samples: int) -> NDArray[np.float64]:
        values = np.zeros((2, 2))
        for s, sign in enumerate((1, -1)):
            view.move(start + sign * step * change)
            for half in range(2):
                values[half, s] = pixel_losses(
                    loss, view.image(pixels, samples, half), target[pixels]
                )
        return (values[:, 0] - values[:, 1]) / (2 * step) * scale

    fields = smooth_fields(problem.positions, FIELDS, 1).astype(np.float32)
    by_field = np.stack([difference(f, near, field_samples) for f in fields], axis=1)
    vertices = _vertices_to_test(problem, view)
    by_vertex = np.zeros((2, len(vertices), 3))
    reach = _reach(problem, vertices)
    for k, v in enumerate(vertices):
        for axis in range(3):
            change = np.zeros_like(start)
            change[v, axis] = 1
            samples = finer * int(np.clip(VERTEX_RAYS / max(len(reach[k]), 1), *VERTEX_SAMPLES))
            by_vertex[:, k, axis] = difference(change, reach[k], samples) if len(reach[k]) else 0
    return Truth(target.astype(np.float32), fields, by_field, vertices, by_vertex)


def _near(view: Supersampler) -> NDArray[np.int64]:
    """The pixels that see the object, and those up to three pixels away: no other changes with
    it."""
    n = view.problem.resolution
    rgb = view.image(np.arange(n * n), 16, 0)
    seen = np.abs(rgb - np.array(BACKGROUND)).max(1) > 1e-6
    return np.flatnonzero(maximum_filter(seen.reshape(n, n), 7))


def _vertices_to_test(problem: Problem, view: Supersampler) -> NDArray[np.int64]:
    """Up to ``VERTICES`` random vertices of triangles that the camera sees."""
    view.move(problem.positions)
    hits, _ = rays.trace_grid(view.scene, view.batch)
    triangle = np.array(hits.triangle)
    seen = np.unique(problem.faces[np.unique(triangle[triangle != MISS])])
    return np.sort(np.random.default_rng(3).permutation(seen)[:VERTICES])


def _reach(problem: Problem, vertices: NDArray) -> list[NDArray]:
    """Pixels that moving each vertex can change: the box around its two-ring (positions of the
    first ring, normals of the second), two pixels wider."""
    views = problem.views
    v = problem.positions - views.eye[0]
    depth = v @ views.forward[0]
    squared = np.sum(views.right[0] ** 2)
    half = problem.resolution / 2
    at = np.stack(
        [v @ a[0] / (depth * squared) * half + half for a in (views.right, views.down)], 1
    )
    out = []
    for vertex in vertices:
        ring = problem.faces[(problem.faces == vertex).any(1)]
        ring = problem.faces[np.isin(problem.faces, ring).any(1)].ravel()
        low, high = np.floor(at[ring].min(0)) - 2, np.ceil(at[ring].max(0)) + 2
        low, high = (np.clip(b, 0, problem.resolution).astype(int) for b in (low, high))
        rows, columns = np.arange(low[1], high[1]), np.arange(low[0], high[0])
        out.append((rows[:, None] * problem.resolution + columns).ravel())
    return out
