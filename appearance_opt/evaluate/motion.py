"""What a report shows of two characters that move: a film, the worst frame, weights as colours."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.posing import bone_matrices, pose_positions
from appearance_opt.asset.types import Material
from appearance_opt.evaluate import pictures
from appearance_opt.evaluate.film import encode_film
from appearance_opt.evaluate.hero import hero_view
from appearance_opt.placement import Placement
from appearance_opt.reference.animated import AnimatedReference
from appearance_opt.stages.animation import anchored
from appearance_opt.views import support

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.rig import Rig
    from appearance_opt.asset.types import Asset, Mesh

MOST = 48
"""Frames of a film."""

SIZE, SAMPLES, SMALL = 256, 4, 96
"""Pixels across each picture of a film, rays of each; and pixels where its view is chosen."""

FRAMING_POINTS = 2000
"""Vertices of each frame that a film keeps within its picture."""

GOLDEN = 0.618034
"""Of the circle of hues, from one bone to the next: neighbours differ, and none comes twice."""


@dataclass
class Motion:
    """``clip``, and its ``film`` (animated WebP: original, result, difference) of so many frames
    per second; ``frames``: names of those whose error is known, ``errors``: their PSNR over covered
    pixels in dB by column; ``stills`` (H, W, 3) by name: the worst frame, weights as colours."""

    clip: str
    film: bytes
    rate: float
    frames: tuple[str, ...] = ()
    errors: dict[str, tuple[float, ...]] = field(default_factory=dict)
    stills: dict[str, NDArray[np.uint8]] = field(default_factory=dict)

    @property
    def worst(self) -> tuple[str, float]:
        """Name of the worst frame of the last column, and its PSNR."""
        last = list(self.errors.values())[-1]
        k = int(np.argmin(last))
        return self.frames[k], last[k]


def show_motion(
    original: Asset,
    result: Asset,
    clip: str,
    worst: float,
    frames: Sequence[str],
    errors: Mapping[str, Sequence[float]],
    size: int = SIZE,
) -> Motion:
    """Film both over a clip from one view that follows the original. ``worst``: seconds of the
    frame that is shown as a still; ``frames``, ``errors``: see ``Motion``. Raises InputError for a
    clip that one of the two does not have."""
    heavy, rig = anchored(original)
    light, own = anchored(result)
    chosen = rig.clip(clip)
    first, last = chosen.start * rig.rate, chosen.end * rig.rate
    numbers = np.arange(np.ceil(first - 1e-3), np.floor(last + 1e-3) + 1)
    step = max(-(-len(numbers) // MOST), 1)
    times = np.append(numbers[::step] / rig.rate, worst)
    moves = bone_matrices(rig, chosen, times)
    places, hull = _follow(heavy, moves)
    sides = [
        AnimatedReference(replace(heavy, rig=None), _placed(moves, places)),
        AnimatedReference(replace(light, rig=None), _moves(own, clip, times, places)),
    ]
    view = hero_view(hull, lambda v: sides[0].at(0).render(v, SMALL, SAMPLES))

    def triple(frame: int) -> NDArray[np.uint8]:
        a, b = (side.at(frame).render(view, size, SAMPLES)[0] for side in sides)
        shown = pictures.picture(a), pictures.picture(b), pictures.difference(a, b)
        return np.concatenate(shown, axis=1)

    film = [triple(k) for k in range(len(times) - 1)]
    still = len(times) - 1
    stills = {"worst frame": triple(still)}
    painted = []
    for asset, side in ((heavy, sides[0]), (light, sides[1])):
        meshes = (_painted(m, side.posed(still).meshes[k]) for k, m in enumerate(side.completed))
        shown = replace(asset, rig=None, nodes=(), meshes=tuple(meshes))
        image = type(sides[0].bind)(shown).render(view, 2 * size, SAMPLES)[0]
        painted.append(pictures.picture(image))
    stills["weights"] = np.concatenate(painted, axis=1)
    rate = rig.rate / step
    return Motion(
        clip,
        encode_film(film, rate),
        rate,
        tuple(frames),
        {name: tuple(values) for name, values in errors.items()},
        stills,
    )


def _moves(rig: Rig, clip: str, times: NDArray, places: Sequence[Placement]) -> NDArray[np.float64]:
    return _placed(bone_matrices(rig, rig.clip(clip), times), places)


def _placed(matrices: NDArray, places: Sequence[Placement]) -> NDArray[np.float64]:
    """(T, B, 4, 4) matrices to the world, to the local coordinates of each frame instead."""
    out = matrices.copy()
    for moved, place in zip(out, places, strict=True):
        moved[:, :3, 3] -= place.centre
        moved[:, :3] /= place.scale
    return out


def _follow(asset: Asset, matrices: NDArray) -> tuple[list[Placement], NDArray[np.float64]]:
    """(placements of one size along a straight line, at constant speed: the camera of a film moves
    as if on rails, and stands still for a walk on the spot; extreme points of all frames)."""
    step = max(sum(len(m.positions) for m in asset.meshes) // FRAMING_POINTS, 1)
    none = np.empty((0, 3), np.int32)
    few = [m.take(np.arange(0, len(m.positions), step), none) for m in asset.meshes]
    few = [m for m in few if len(m.positions)]
    points = [np.concatenate([pose_positions(m, at) for m in few]) for at in matrices]
    around = [Placement.around(p) for p in points]
    # the last frame is the still, which follows no other
    t = np.arange(len(points), dtype=np.float64)
    known = slice(None, max(len(t) - 1, 1))
    centres = np.array([p.centre for p in around])
    speed, at = np.zeros(3), centres[known].mean(axis=0)
    if len(t) > 2:
        speed, at = np.polyfit(t[known], centres[known], 1)
    line = at + t[:, None] * speed
    line[-1] = centres[-1]
    off = np.linalg.norm(centres - line, axis=1)
    scale = max(float(d) + p.scale for d, p in zip(off, around, strict=True))
    places = [Placement((float(x), float(y), float(z)), scale) for x, y, z in line]
    local = [place.to_local(p) for place, p in zip(places, points, strict=True)]
    return places, support(np.concatenate(local))


def _painted(mesh: Mesh, posed: Mesh) -> Mesh:
    """A posed mesh in the colours of the bones that move it, blended by their weights."""
    skin = mesh.skin
    assert skin is not None
    colors = bone_colors(int(skin.bones.max(initial=0)) + 1)
    mixed = np.einsum("vk,vkc->vc", skin.weights, colors[skin.bones])
    return replace(
        posed,
        material=Material(roughness=0.9),
        colors=mixed.astype(np.float32),
        uvs=None,
        tangents=None,
    )


def bone_colors(count: int) -> NDArray[np.float64]:
    """(count, 3) linear colours, of which neighbours differ."""
    hue = np.arange(count) * GOLDEN % 1
    wheel = np.abs((hue[:, None] * 6 + np.array([0, 4, 2])) % 6 - 3) - 1
    bright = np.where(np.arange(count) % 2, 0.9, 0.5)[:, None]
    return (0.08 + 0.92 * np.clip(wheel, 0, 1)) * bright
