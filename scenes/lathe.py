"""Sheets to meshes: surfaces of revolution, tubes along plane curves, and small gems.

Every mesh is closed: the ends of a sheet shrink to a point, the seam repeats its vertices exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset import Material, Mesh
from appearance_opt.asset.normals import vertex_normals
from scenes.bands import Band, Sheet


@dataclass(frozen=True)
class Piece:
    """One band with the profile (N, 2) of (radius, height) in metres under it, listed upward."""

    profile: NDArray
    band: Band


@dataclass(frozen=True)
class Profile:
    """A profile by its arc length: ``s`` (N,) in [0, 1]; ``points`` and outward ``normals`` (N, 2)
    in the (radius, height) plane."""

    s: NDArray
    points: NDArray
    normals: NDArray

    def at(self, s: NDArray) -> tuple[NDArray, NDArray]:
        """Points and normals (M, 2) at arc lengths s."""
        return _interpolate(s, self.s, self.points), _interpolate(s, self.s, self.normals)


def line(*corners: tuple[float, float]) -> NDArray:
    """Straight pieces through (radius, height) corners."""
    return np.asarray(corners, np.float64)


def arc(
    start: tuple[float, float], end: tuple[float, float], bulge: float, count: int = 24
) -> NDArray:
    """Half an ellipse from start to end that stands ``bulge`` metres proud to the right of its way
    up."""
    a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
    angle = np.linspace(0, np.pi, count)[:, None]
    outward = np.array((b[1] - a[1], a[0] - b[0])) / np.linalg.norm(b - a)
    return (a + b) / 2 - (b - a) / 2 * np.cos(angle) + bulge * outward * np.sin(angle)


def curve(*points: tuple[float, ...], count: int = 80) -> NDArray:
    """Cubic spline through points of any dimension, at chord-length parameters."""
    from scipy.interpolate import CubicSpline

    p = np.asarray(points, np.float64)
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    return CubicSpline(chord, p)(np.linspace(0, chord[-1], count))


def profile_sheet(pieces: Sequence[Piece], seed: int, dents: tuple = ()) -> tuple[Profile, Sheet]:
    """Join pieces, each starting where the one before ends, and measure their bands."""
    points = [pieces[0].profile[:1]]
    counts = []
    for piece in pieces:
        first = 1 if np.allclose(piece.profile[0], points[-1][-1]) else 0
        points.append(piece.profile[first:])
        counts.append(len(piece.profile) - first)
    path = np.concatenate(points)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    ends = np.concatenate([[0], np.cumsum(counts)])
    edges = length[ends] / length[-1]
    girths = np.array(
        [2 * np.pi * np.mean(path[a : b + 1, 0]) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    )
    tangent = np.gradient(path, length, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normals = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    bands = tuple(piece.band for piece in pieces)
    sheet = Sheet(bands, edges, girths, np.diff(edges) * length[-1], seed, dents)
    return Profile(length / length[-1], path, normals), sheet


def turn(
    profile: Profile,
    sheet: Sheet,
    columns: int,
    material: Material,
    name: str,
    cross_section: Callable[[NDArray], NDArray] | None = None,
) -> Mesh:
    """Surface of revolution about +Y with the sheet's relief along the profile's normals.

    ``cross_section``: factor on the radius by angle (radians), 1 for a circle. u runs to the right
    seen from outside, from +Z."""
    u, s = np.arange(columns) / columns, sheet.rows()
    base, normal = profile.at(s)
    height = sheet.height(u, s)
    radius = base[:, :1] + height * normal[:, :1]
    radius = np.where(base[:, :1] > 0, np.maximum(radius, 1e-5), 0.0)
    if cross_section is not None:
        radius = radius * cross_section(2 * np.pi * u)
    y = base[:, 1:] + height * normal[:, 1:]
    angle = 2 * np.pi * u
    positions = np.stack([radius * np.sin(angle), y, radius * np.cos(angle)], axis=-1)
    return grid_mesh(positions, s, material, name)


def tube(
    path: NDArray,
    radius: Callable[[NDArray], NDArray],
    sheet: Sheet,
    columns: int,
    material: Material,
    name: str,
) -> Mesh:
    """Tube along a curve (N, 2) in the (x, y) plane; ``radius``: metres at s in [0, 1], 0 at both
    ends."""
    u, s = np.arange(columns) / columns, sheet.rows()
    arc_length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    knots = arc_length / arc_length[-1]
    tangent = np.gradient(path, arc_length, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    centre, along = _interpolate(s, knots, path), _interpolate(s, knots, tangent)
    side = np.stack([along[:, 1], -along[:, 0]], axis=1)
    bare = radius(s)[:, None]
    reach = np.where(
        bare > 0, np.maximum(bare + sheet.height(u, s) * np.minimum(bare / bare.max(), 1), 1e-5), 0
    )
    angle = 2 * np.pi * u
    offset = reach * np.cos(angle)
    positions = np.stack(
        [
            centre[:, :1] + offset * side[:, :1],
            centre[:, 1:] + offset * side[:, 1:],
            -reach * np.sin(angle),
        ],
        axis=-1,
    )
    return grid_mesh(positions, s, material, name)


def grid_mesh(positions: NDArray, s: NDArray, material: Material, name: str) -> Mesh:
    """Closed mesh of a (rows, columns, 3) grid, periodic along columns; u = column, v = 1 - s. A
    first or last row that is one point becomes a fan."""
    rows, columns = positions.shape[:2]
    points = np.concatenate([positions, positions[:, :1]], axis=1).astype(np.float32) + np.float32(
        0
    )
    j, i = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a = j * (columns + 1) + i
    b, c, d = a + 1, a + columns + 2, a + columns + 1
    lower, upper = np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)
    if np.ptp(points[0], axis=0).max() == 0:
        lower = lower[1:]
    if np.ptp(points[-1], axis=0).max() == 0:
        upper = upper[:-1]
    faces = np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)]).astype(np.int32)
    flat = points.reshape(-1, 3)
    uu, vv = np.meshgrid(np.arange(columns + 1) / columns, 1 - s)
    uvs = np.stack([uu, vv], axis=-1).reshape(-1, 2).astype(np.float32)
    used, faces = np.unique(
        faces, return_inverse=True
    )  # a fan leaves one vertex of its end row over
    flat, uvs, faces = flat[used], uvs[used], faces.reshape(-1, 3).astype(np.int32)
    return Mesh(flat, faces, vertex_normals(flat, faces), uvs, material=material, name=name)


def place(mesh: Mesh, centre: NDArray, up: NDArray) -> Mesh:
    """Rotate a mesh so that its +Y points along ``up``, and move its origin to ``centre``."""
    y = np.asarray(up, np.float64) / np.linalg.norm(up)
    x = np.cross((0.0, 1.0, 0.0) if abs(y[1]) < 0.9 else (0.0, 0.0, 1.0), y)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, y, np.cross(x, y)], axis=1)
    positions = (mesh.positions @ rotation.T + centre).astype(np.float32)
    return replace(
        mesh, positions=positions, normals=(mesh.normals @ rotation.T).astype(np.float32)
    )


def join(meshes: Sequence[Mesh], name: str) -> Mesh:
    """Several meshes of one material as one."""
    starts = np.cumsum([0, *(len(m.positions) for m in meshes[:-1])])
    return Mesh(
        np.concatenate([m.positions for m in meshes]),
        np.concatenate([m.faces + np.int32(k) for m, k in zip(meshes, starts, strict=True)]).astype(
            np.int32
        ),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.uvs for m in meshes]),
        material=meshes[0].material,
        name=name,
    )


def _interpolate(x: NDArray, knots: NDArray, values: NDArray) -> NDArray:
    return np.stack([np.interp(x, knots, values[:, c]) for c in range(values.shape[1])], axis=1)
