"""The scenes of the gradient tables: one view each of a mesh, its target, and what lies behind.

Every case of visibility has a scene of its own. All are lit from the eye, because Mitsuba's
integrators trace shadows and ours does not: from there no visible point is in shadow. That is the
hard case, too: smooth objects are dark where their outline is, and the logarithmic loss is steep in
the dark.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.normals import weld
from appearance_opt.initial.sphere import sphere
from appearance_opt.latent.mesh import LatentMesh, LatentTopology
from appearance_opt.render.material import MaterialMaps
from appearance_opt.render.surface import Surface
from appearance_opt.views import Views, look_at

FOV = 32.0
DISTANCE = 3.7
"""A unit sphere about the origin just fills the image."""

BACKGROUND = (0.35, 0.42, 0.5)
ASSETS = Path(__file__).resolve().parents[3] / "shared" / "assets"


@dataclass(frozen=True)
class Problem:
    """``positions`` (V, 3), ``faces`` (F, 3) welded, ``colors`` (V, 3) linear; ``target_positions``
    and ``target_colors`` the same mesh as it should look; one view of ``resolution`` squared
    pixels. ``step``: largest displacement of a finite difference, in pixels."""

    name: str
    positions: NDArray[np.float32]
    faces: NDArray[np.int32]
    colors: NDArray[np.float32]
    target_positions: NDArray[np.float32]
    target_colors: NDArray[np.float32]
    resolution: int
    eye: tuple[float, float, float]
    roughness: float = 0.6
    metalness: float = 0.0
    step: float = 1 / 30

    @property
    def views(self) -> Views:
        eye = np.array([self.eye], np.float64)
        return look_at(eye, (0.0, 0.0, 0.0), FOV, eye, np.pi * 0.85 * np.sum(eye**2))

    @property
    def pixel_size(self) -> float:
        """World units per pixel at the origin."""
        return 2 * np.tan(np.radians(FOV) / 2) * float(np.linalg.norm(self.eye)) / self.resolution

    @property
    def maps(self) -> MaterialMaps:
        white = {"red": 1.0, "green": 1.0, "blue": 1.0}
        return MaterialMaps((), {**white, "roughness": self.roughness, "metalness": self.metalness})

    @property
    def mesh(self) -> LatentMesh:
        """Without texture coordinates."""
        vertices = np.arange(len(self.positions), dtype=np.int32)
        uvs = np.zeros((len(vertices), 2), np.float32)
        return LatentMesh(self.positions, self.faces, vertices, self.faces, uvs)

    def topology(self) -> LatentTopology:
        return LatentTopology(self.mesh, tangents=False)

    def surface(self, topology: LatentTopology, positions: mi.Float, colors: NDArray) -> Surface:
        """Surface with vertex colours (no texture: Mitsuba splits a mesh at its UV seams)."""
        padded = np.zeros((len(colors), 4), np.float32)
        padded[:, :3] = colors
        return replace(
            topology.surface(positions), frames=None, corners=None, colors=mi.Float(padded.ravel())
        )


def smooth_fields(
    positions: NDArray, count: int, seed: int, highest: float = 5.0
) -> NDArray[np.float64]:
    """(count, V, 3) smooth deformation fields: each a random plane wave in a random direction, at
    most ``highest`` radians per unit, of largest displacement 1."""
    rng = np.random.default_rng(seed)
    fields = []
    for _ in range(count):
        k = rng.normal(size=3)
        k *= rng.uniform(0.5, highest) / np.linalg.norm(k)
        axis = rng.normal(size=3)
        wave = np.sin(positions.astype(np.float64) @ k + rng.uniform(0, 2 * np.pi))
        field = wave[:, None] * axis
        fields.append(field / np.linalg.norm(field, axis=1).max())
    return np.stack(fields)


def problem_names() -> list[str]:
    return list(_SHAPES)


def make_problem(name: str, resolution: int = 128) -> Problem:
    """The scene of that name."""
    positions, faces, eye = _SHAPES[name]()
    positions = np.asarray(positions, np.float64)
    colors = 0.45 + 0.35 * np.sin(
        positions @ np.array([[3.1, 1.3, 0.4], [0.7, 2.9, 1.7], [1.9, 0.3, 3.3]]).T
    )
    wave = smooth_fields(positions, 1, 99, 3.0)[0]
    target = positions + 0.04 * wave
    shade = 0.9 + 0.1 * np.sin(positions @ np.array([1.7, 2.3, 0.9]))
    f32 = np.float32
    return Problem(
        name,
        positions.astype(f32),
        np.asarray(faces, np.int32),
        colors.astype(f32),
        target.astype(f32),
        (colors * shade[:, None]).astype(f32),
        resolution,
        tuple(DISTANCE * np.asarray(eye) / np.linalg.norm(eye)),
        # faces seen at grazing angles turn away within a tenth of a pixel: too far for a difference
        step=1 / 40 if name == "grazing" else 1 / 30,
    )


Shape = tuple[NDArray, NDArray, tuple[float, float, float]]


def _triangle() -> Shape:
    return (
        np.array([[-0.7, -0.6, 0.0], [0.8, -0.45, 0.2], [0.05, 0.75, -0.1]]),
        np.array([[0, 1, 2]]),
        (0, 0, 1),
    )


def _ball() -> Shape:
    mesh = sphere(768, (0.0, 0.0, 0.0), 0.8, 16)
    return mesh.positions, mesh.faces, (0.3, 0.2, 1)


def _grid(n: int, place: Callable[[NDArray, NDArray], NDArray]) -> tuple[NDArray, NDArray]:
    u, v = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1))
    j, i = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    a = j * (n + 1) + i
    b, c, d = a + 1, a + n + 2, a + n + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return place(u.ravel(), v.ravel()), faces


def _interior() -> Shape:
    """A wavy sheet larger than the image: no outline anywhere."""
    p, f = _grid(
        24, lambda u, v: np.stack([1.6 * u, 1.6 * v, 0.15 * np.sin(3 * u + 1) * np.cos(4 * v)], 1)
    )
    return p, f, (0, 0, 1)


def _occlusion() -> Shape:
    """A small ball before a large one: both outlines are seen, one against the other."""
    big, small = sphere(768, (0.0, 0.0, 0.0), 0.75, 16), sphere(300, (0.25, 0.15, 1.1), 0.3, 16)
    p = np.concatenate([big.positions, small.positions])
    return p, np.concatenate([big.faces, small.faces + len(big.positions)]), (0, 0, 1)


def _grazing() -> Shape:
    """A sheet seen at 4 degrees, with gentle waves."""
    p, f = _grid(16, lambda u, v: np.stack([0.8 * u, 0.02 * np.sin(4 * u + 2 * v), -0.8 * v], 1))
    return p, f, (0.1, 0.08, 1)


def _bowl() -> Shape:
    """An open half sphere: rim, outside and inside are seen at once."""

    def place(u: NDArray, v: NDArray) -> NDArray:
        r = np.maximum(np.abs(u), np.abs(v))
        angle = np.arctan2(v, u)
        polar = r * 0.55 * np.pi
        return 0.8 * np.stack(
            [np.sin(polar) * np.cos(angle), -np.cos(polar) + 0.3, np.sin(polar) * np.sin(angle)], 1
        )

    p, f = _grid(18, place)
    return p, f[:, ::-1], (0.2, 0.7, 1)


def _torus() -> Shape:
    """A ring seen from the side: its front lies before its back."""
    rows, columns = 18, 40
    u, v = np.meshgrid(np.arange(columns) / columns * 2 * np.pi, np.arange(rows) / rows * 2 * np.pi)
    r = 0.62 + 0.24 * np.cos(v)
    p = np.stack([r * np.sin(u), 0.24 * np.sin(v), r * np.cos(u)], -1).reshape(-1, 3)
    j, i = (a.ravel() for a in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    a, b = j * columns + i, j * columns + (i + 1) % columns
    c, d = (j + 1) % rows * columns + (i + 1) % columns, (j + 1) % rows * columns + i
    return p, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), (0.3, 0.45, 1)


def _intersecting() -> Shape:
    """Two balls that run into each other: along their meeting curve no edge of the mesh moves."""
    one, two = sphere(768, (-0.3, 0.0, 0.0), 0.55, 16), sphere(768, (0.35, 0.1, 0.1), 0.5, 16)
    p = np.concatenate([one.positions, two.positions])
    return p, np.concatenate([one.faces, two.faces + len(one.positions)]), (0.1, 0.2, 1)


def _border() -> Shape:
    """A ball that leaves the image on two sides."""
    mesh = sphere(768, (0.55, -0.6, 0.0), 0.8, 16)
    return mesh.positions, mesh.faces, (0, 0, 1)


def _spot(subdivisions: int) -> Shape:
    """The cow, each triangle split in four ``subdivisions`` times."""
    from appearance_opt.asset import load
    from appearance_opt.initial.decimate import decimate

    mesh = load(next(iter(sorted((ASSETS / "spot").glob("*.obj"))))).meshes[0]
    first, place = weld(mesh.positions)
    p, f = mesh.positions[first].astype(np.float64), place[mesh.faces].astype(np.int64)
    p = (p - (p.min(0) + p.max(0)) / 2) / (np.linalg.norm(p.max(0) - p.min(0)) / 2)
    if subdivisions < 0:
        p, f = decimate(p, f, 1400, None)
    for _ in range(subdivisions):
        p, f = split(p, f)
    return p, f, (0.8, 0.3, -1)


def split(p: NDArray, f: NDArray) -> tuple[NDArray, NDArray]:
    """Each triangle in four, at the middles of its edges."""
    pairs = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
    unique, place = np.unique(pairs, axis=0, return_inverse=True)
    m = place.reshape(3, -1) + len(p)
    middle = (p[unique[:, 0]] + p[unique[:, 1]]) / 2
    a, b, c = f.T
    parts = [(a, m[0], m[2]), (m[0], b, m[1]), (m[2], m[1], c), (m[0], m[1], m[2])]
    return np.concatenate([p, middle]), np.concatenate([np.stack(t, 1) for t in parts])


_SHAPES: dict[str, Callable[[], Shape]] = {
    "triangle": _triangle,
    "ball": _ball,
    "interior": _interior,
    "occlusion": _occlusion,
    "grazing": _grazing,
    "bowl": _bowl,
    "torus": _torus,
    "intersecting": _intersecting,
    "border": _border,
    "spot-1k": lambda: _spot(-1),
    "spot-6k": lambda: _spot(0),
    "spot-94k": lambda: _spot(2),
}
