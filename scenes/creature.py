"""A four-legged creature with a skeleton and two clips: tubes along bones, with smooth weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset import Asset, Material, Mesh, Texture
from appearance_opt.asset.normals import vertex_normals
from appearance_opt.asset.rig import Channel, Clip, Joint, Rig, Skin
from appearance_opt.asset.types import linear_to_srgb
from appearance_opt.errors import InputError

LEAST = 600
"""Triangles of the smallest creature whose tubes are closed."""

RATE, LENGTH = 24.0, 24
"""Frames per second, and of a clip, which is a loop."""

SPINE = np.array(
    [(0, 0.62, -0.95), (0, 0.64, -0.55), (0, 0.62, -0.2), (0, 0.64, 0.15), (0, 0.72, 0.45),
     (0, 0.95, 0.68)]
)  # fmt: skip
"""Joints from the tail to the head, metres; the creature looks along +Z."""

HIPS = ((-0.2, 1), (0.2, 1), (-0.2, 3), (0.2, 3))
"""(x of a leg, its joint of the spine)."""


@dataclass(frozen=True)
class _Limb:
    """A chain of bones: ``points`` (N, 3), of which the last is an end and no joint; ``radii`` (N,)
    of its tube; ``parent``: joint of the spine it hangs on, -1 for the spine itself."""

    name: str
    points: NDArray[np.float64]
    radii: NDArray[np.float64]
    parent: int


def creature(triangles: int = 120_000, texture_size: int = 1024) -> Asset:
    """A striped, scaly quadruped of about 1.9 m, with eyes that hang on its head; clips "walk" and
    "look". Raises InputError for fewer than ``LEAST`` triangles."""
    if triangles < LEAST:
        raise InputError(f"scene 'creature' needs at least {LEAST} triangles, not {triangles}")
    limbs = _limbs()
    nodes: list[Joint] = []
    first: list[int] = []
    for limb in limbs:
        first.append(len(nodes))
        parent = -1 if limb.parent < 0 else limb.parent
        for k, point in enumerate(limb.points[:-1]):
            above = parent if k == 0 else len(nodes) - 1
            base = limbs[0].points[parent] if k == 0 and parent >= 0 else limb.points[max(k - 1, 0)]
            offset = point - base if (k or parent >= 0) else point
            nodes.append(Joint(f"{limb.name}{k}", above, tuple(offset.tolist())))
    places = np.concatenate([limb.points[:-1] for limb in limbs])
    inverse = np.tile(np.eye(4), (len(nodes), 1, 1))
    inverse[:, :3, 3] = -places
    skin = _hide(texture_size)
    share = triangles / (2.0 + 4 * 0.9)
    meshes = [
        _tube(limb, start, int(share * (2.0 if limb.parent < 0 else 0.9)), skin)
        for limb, start in zip(limbs, first, strict=True)
    ]
    meshes += [_eye(side, triangles) for side in (-1, 1)]
    rig = Rig(
        tuple(nodes),
        np.arange(len(nodes), dtype=np.int32),
        inverse,
        (_walk(limbs, first), _look(limbs, first)),
        RATE,
    )
    return Asset(tuple(meshes), "creature", rig=rig)


def _limbs() -> list[_Limb]:
    spine = np.concatenate([SPINE, [(0, 1.0, 0.98)]])
    out = [_Limb("spine", spine, np.array([0.03, 0.13, 0.21, 0.22, 0.17, 0.16, 0.09]), -1)]
    for number, (x, joint) in enumerate(HIPS):
        z, bend = SPINE[joint, 2], 0.08 if joint == 1 else -0.08
        points = np.array(
            [(x * 0.7, 0.6, z), (x, 0.34, z + bend), (x, 0.08, z - bend / 2), (x, 0.03, z + 0.12)]
        )
        out.append(_Limb(f"leg{number}_", points, np.array([0.11, 0.08, 0.06, 0.04]), joint))
    return out


def _tube(limb: _Limb, first: int, triangles: int, material: Material) -> Mesh:
    """A closed tube around a limb. Weights follow the place along it, blended around each joint."""
    around = max(int(np.sqrt(triangles / 4)), 6)
    along = max(triangles // (2 * around), 4)
    lengths = np.linalg.norm(np.diff(limb.points, axis=0), axis=1)
    knots = np.concatenate([[0], np.cumsum(lengths)])
    reach = knots[-1]
    s = np.linspace(0, 1, along + 1)
    at = s * reach
    centre = np.stack([np.interp(at, knots, limb.points[:, k]) for k in range(3)], axis=1)
    for _ in range(max(along // 12, 1)):  # no corners at joints
        centre[1:-1] = 0.25 * centre[:-2] + 0.5 * centre[1:-1] + 0.25 * centre[2:]
    radius = np.interp(at, knots, limb.radii) * np.sqrt(np.clip(1 - (2 * s - 1) ** 40, 0, 1))
    axis = np.gradient(centre, axis=0)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    side = np.cross(axis, [0.31, 0.21, 0.93] if abs(axis[:, 2]).mean() < 0.7 else [1.0, 0.1, 0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(axis, side)
    turn = np.linspace(0, 2 * np.pi, around + 1)
    bumps = 1 + 0.035 * np.sin(9 * turn)[None] * np.sin(14 * np.pi * s * reach)[:, None]
    r = radius[:, None] * bumps
    p = centre[:, None] + r[..., None] * (
        np.cos(turn)[None, :, None] * side[:, None] + np.sin(turn)[None, :, None] * up[:, None]
    )
    p[:, -1] = p[:, 0]  # the seam is closed
    positions = p.reshape(-1, 3)
    row, column = np.meshgrid(np.arange(along), np.arange(around), indexing="ij")
    a = (row * (around + 1) + column).ravel()
    b, c, d = a + 1, a + around + 1, a + around + 2
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    uvs = np.stack(np.broadcast_arrays(turn[None] / (2 * np.pi), s[:, None]), axis=-1)
    weights = _smooth_weights(at, knots)
    count = min(2, weights.shape[1])
    order = np.argsort(-weights, axis=1)[:, :count]
    kept = np.take_along_axis(weights, order, axis=1)
    kept /= kept.sum(axis=1, keepdims=True)
    p32 = positions.astype(np.float32)
    used, corners = np.unique(faces[_solid(positions, faces)], return_inverse=True)
    corners = corners.reshape(-1, 3).astype(np.int32)
    whole = Skin(
        np.repeat(first + order, around + 1, axis=0).astype(np.int32),
        np.repeat(kept, around + 1, axis=0).astype(np.float32),
    )
    return Mesh(
        positions=p32[used],
        faces=corners,
        normals=vertex_normals(p32[used], corners),
        uvs=uvs.reshape(-1, 2).astype(np.float32)[used],
        material=material,
        name=limb.name.rstrip("_"),
        skin=whole.take(used),
    )


def _smooth_weights(at: NDArray, knots: NDArray) -> NDArray[np.float64]:
    """(N, J) weights of the bones between knots, which blend over a third of the shorter bone."""
    out = np.zeros((len(at), len(knots) - 1))
    lengths = np.diff(knots)
    rise = np.ones((len(at), len(knots)))
    for j in range(1, len(knots) - 1):
        width = min(lengths[j - 1], lengths[j]) / 3
        t = np.clip((at - knots[j]) / (2 * width) + 0.5, 0, 1)
        rise[:, j] = t * t * (3 - 2 * t)
    rise[:, -1] = 0
    for j in range(len(knots) - 1):
        out[:, j] = rise[:, j] * (1 - rise[:, j + 1])
    return out / out.sum(axis=1, keepdims=True)


def _solid(positions: NDArray, faces: NDArray) -> NDArray[np.bool_]:
    a, b, c = (positions[faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12


def _eye(side: int, triangles: int) -> Mesh:
    """A ball that hangs on the head."""
    from scenes.analytic import sphere_mesh

    ball = sphere_mesh(max(triangles // 200, 32), Material("eye", (0.02, 0.02, 0.02), 0.15), 0.035)
    place = np.array([side * 0.11, 1.05, 0.82], np.float32)
    head = len(SPINE) - 1
    count = len(ball.positions)
    return Mesh(
        positions=ball.positions + place,
        faces=ball.faces,
        normals=ball.normals,
        uvs=ball.uvs,
        material=ball.material,
        name=f"eye{'lr'[side > 0]}",
        skin=Skin(np.full((count, 1), head, np.int32), np.ones((count, 1), np.float32)),
    )


def _hide(size: int) -> Material:
    """Stripes across, scales in the bumps."""
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / size
    wave = np.sin(38 * y + 1.5 * np.sin(2 * np.pi * x)) + 0.4 * np.sin(2 * np.pi * 3 * x)
    stripe = (np.clip(3 * wave, -1, 1) + 1)[..., None] / 2
    light, dark = np.array([0.55, 0.36, 0.12]), np.array([0.06, 0.1, 0.05])
    scales = 0.85 + 0.15 * np.sin(2 * np.pi * 24 * x) * np.sin(2 * np.pi * 40 * y)
    color = np.clip((stripe * light + (1 - stripe) * dark) * scales[..., None], 0, 1)
    pixels = (linear_to_srgb(color) * 255 + 0.5).astype(np.uint8)
    return Material("hide", roughness=0.55, base_color_texture=Texture(pixels, "srgb"))


def _swing(node: int, axis: int, angles: NDArray) -> Channel:
    """A node that turns about an axis by angles (T,) in degrees, one for each frame."""
    half = np.radians(angles) / 2
    values = np.zeros((len(angles), 4))
    values[:, axis], values[:, 3] = np.sin(half), np.cos(half)
    return Channel(node, "rotation", np.arange(len(angles)) / RATE, values)


def _walk(limbs: list[_Limb], first: list[int]) -> Clip:
    t = 2 * np.pi * np.arange(LENGTH + 1) / LENGTH
    channels = []
    for number, start in enumerate(first[1:]):
        phase = t + np.pi * (number in (1, 2))
        channels += [
            _swing(start, 0, 28 * np.sin(phase)),
            _swing(start + 1, 0, 24 + 24 * np.sin(phase + 1.2)),
            _swing(start + 2, 0, -14 - 18 * np.sin(phase + 1.6)),
        ]
    for joint in range(1, len(SPINE)):
        channels.append(_swing(first[0] + joint, 1, 7 * np.sin(t - 0.8 * joint)))
    bob = np.zeros((LENGTH + 1, 3))
    bob[:] = SPINE[0]
    bob[:, 1] += 0.02 * np.sin(2 * t)
    bob[:, 2] += 0.4 * np.arange(LENGTH + 1) / LENGTH
    channels.append(Channel(0, "translation", np.arange(LENGTH + 1) / RATE, bob))
    return Clip("walk", tuple(channels))


def _look(limbs: list[_Limb], first: list[int]) -> Clip:
    t = 2 * np.pi * np.arange(LENGTH + 1) / LENGTH
    head = len(SPINE) - 1
    channels = [
        _swing(head, 1, 50 * np.sin(t)),
        _swing(head - 1, 0, -20 + 20 * np.cos(t)),
        _swing(1, 1, 18 * np.sin(2 * t)),
        _swing(first[1], 0, 10 * np.sin(t)),
    ]
    return Clip("look", tuple(channels))
