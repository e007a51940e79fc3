"""Cameras and lights, and how they are drawn. NumPy only, except for the upload to the device."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from appearance_opt.backend import to_device

if TYPE_CHECKING:
    import mitsuba as mi
    from numpy.typing import NDArray

RECORD = 16
"""Floats per view on the device: eye, forward, right, down, each xyz and one number of the light:
its position and its intensity."""

FIT, VALIDATION, VISIBILITY, START, MEASURED = range(5)
"""Streams of views, which share none: those that a fit draws, those by which it keeps its best
state, those that tell what of the reference is seen, those by which a start is chosen, and those of
reports and comparisons, which nothing was ever chosen by."""


@dataclass(frozen=True)
class Views:
    """B perspective cameras, each with one point light.

    ``eye``, ``forward``, ``right``, ``down``: (B, 3) float32. ``forward`` is a unit vector;
    ``right`` and ``down`` span the image plane at distance 1, scaled by the tangent of half the
    field of view: the ray through image coordinates (x, y) in [-1, 1]^2, y down, is forward + x
    right + y down. ``light``: (B, 3) position; ``intensity``: (B,) radiant intensity, the same for
    R, G and B. Images are square.
    """

    eye: NDArray[np.float32]
    forward: NDArray[np.float32]
    right: NDArray[np.float32]
    down: NDArray[np.float32]
    light: NDArray[np.float32]
    intensity: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.eye)

    def __getitem__(self, index: slice | NDArray | list[int]) -> Views:
        return Views(*(getattr(self, f)[index] for f in self.__dataclass_fields__))

    @staticmethod
    def concatenate(parts: list[Views]) -> Views:
        """Several batches as one."""
        return Views(
            *(np.concatenate([getattr(p, f) for p in parts]) for f in Views.__dataclass_fields__)
        )

    def records(self) -> mi.Float:
        """Upload: B records of ``RECORD`` floats."""
        packed = np.concatenate(
            [
                *(
                    np.concatenate([v, self.light[:, k : k + 1]], 1)
                    for k, v in enumerate((self.eye, self.forward, self.right))
                ),
                np.concatenate([self.down, self.intensity[:, None]], 1),
            ],
            axis=1,
        )
        return to_device(packed)


def look_at(
    eye: NDArray,
    target: NDArray,
    fov: float | NDArray,
    light: NDArray,
    intensity: NDArray | float,
    up: NDArray | None = None,
) -> Views:
    """Cameras at ``eye`` (B, 3) that look at ``target`` (B, 3) or (3,), with a field of view of
    ``fov`` degrees (full angle, width = height; one number or (B,)), lights at ``light`` (B, 3)."""
    eye = np.atleast_2d(np.asarray(eye, np.float64))
    forward = np.asarray(target, np.float64) - eye
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up = np.broadcast_to([0.0, 1.0, 0.0] if up is None else up, eye.shape)
    # a camera that looks along `up` takes the next axis instead
    vertical = np.abs(np.sum(forward * up, 1)) > 0.999 * np.linalg.norm(up, axis=1)
    up = np.where(vertical[:, None], np.roll(up, 1, axis=1), up)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    scale = np.tan(np.radians(np.broadcast_to(fov, len(eye))) / 2)[:, None]
    arrays = (
        eye,
        forward,
        right * scale,
        down * scale,
        light,
        np.broadcast_to(intensity, len(eye)),
    )
    return Views(*(np.ascontiguousarray(a, np.float32) for a in arrays))


class Sampler(Protocol):
    """Where views come from: a pure function of (seed, stream, iteration), so that any iteration
    can be replayed, and a resumed fit goes on with the same sequence.

    ``centre``, ``radius``: of a sphere around the object; ``hull`` (N, 3): its extreme points, if
    they are known; ``listed``: how many views there are, None where they are without number.
    """

    @property
    def centre(self) -> tuple[float, float, float]: ...
    @property
    def radius(self) -> float: ...
    @property
    def seed(self) -> int: ...
    @property
    def stream(self) -> int: ...
    @property
    def hull(self) -> NDArray | None: ...
    @property
    def listed(self) -> int | None: ...

    def held_out(self, stream: int) -> Sampler:
        """The same kind of views, others: those of another of the streams above."""
        ...

    def draw(self, iteration: int, count: int) -> Views:
        """``count`` views of this iteration."""
        ...


@dataclass(frozen=True)
class ViewSampler:
    """Random cameras on a sphere around the object, each with one random point light.

    Roll is random. Each view is framed by itself: the extreme points ``hull`` (N, 3) of the object,
    or its bounding sphere when they are not known, just fill the image. The light's direction is
    uniform within a cone around the direction to the camera (``light_spread`` degrees, 180 =
    anywhere), or it sits at the camera (``headlight``). Its intensity makes a white diffuse surface
    at the centre that faces it reflect ``exposure``.

    See ``Sampler``.
    """

    centre: tuple[float, float, float]
    radius: float
    seed: int = 0
    stream: int = FIT
    fov: float = 32.0
    hull: NDArray | None = None
    light: str = "point"
    light_spread: float = 75.0
    exposure: float = 0.85

    @property
    def listed(self) -> None:
        """They are without number."""
        return None

    def held_out(self, stream: int) -> ViewSampler:
        """The same distribution, other draws: another of the streams above."""
        return replace(self, stream=stream)

    def draw(self, iteration: int, count: int) -> Views:
        """``count`` views of this iteration."""
        rng = np.random.default_rng([self.seed, self.stream, iteration])
        direction = _unit(rng.normal(size=(count, 3)))
        spin = _unit(rng.normal(size=(count, 3)))
        centre = np.asarray(self.centre, np.float64)
        distance = MARGIN * self.radius / np.sin(np.radians(self.fov) / 2)
        toward_light = direction
        if self.light == "point":
            cosine = rng.uniform(np.cos(np.radians(self.light_spread)), 1.0, size=(count, 1))
            side = _unit(np.cross(direction, _unit(rng.normal(size=(count, 3)))))
            toward_light = direction * cosine + side * np.sqrt(np.maximum(0.0, 1 - cosine**2))
        lamp = distance if self.light == "headlight" else 4 * self.radius
        intensity = np.pi * self.exposure * lamp**2
        views = look_at(
            centre + direction * distance,
            centre,
            self.fov,
            centre + toward_light * lamp,
            intensity,
            spin,
        )
        return views if self.hull is None else frame(views, self.hull)


HELD_OUT = 8
"""Every so many views of a list, from the first one, are none that a fit sees."""


@dataclass(frozen=True)
class ListedViews:
    """A ``Sampler`` of a finite list of ``views``, those of pictures that were taken.

    Every ``HELD_OUT``-th view, from the first, is set aside: of these every other one judges the
    states of a fit (``VALIDATION``), the rest is for reports (``MEASURED``); a lone one does both.
    A fit sees the others in random order, each of them once before any is seen again. Draws begin
    anew where a list ends.
    """

    views: Views
    hull: NDArray
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 1.0
    seed: int = 0
    stream: int = FIT

    @property
    def listed(self) -> int:
        """See ``Sampler``."""
        return len(self.numbers())

    def numbers(self) -> NDArray[np.int64]:
        """Which views of the list belong to this stream."""
        every = np.arange(len(self.views))
        aside = every[::HELD_OUT]
        if self.stream == VALIDATION:
            return aside[::2]
        if self.stream == MEASURED:
            return aside[1::2] if len(aside) > 1 else aside
        return np.setdiff1d(every, aside)

    def held_out(self, stream: int) -> ListedViews:
        """See ``Sampler``."""
        return replace(self, stream=stream)

    def draw(self, iteration: int, count: int) -> Views:
        """See ``Sampler``."""
        numbers = self.numbers()
        rounds, places = np.divmod(iteration * count + np.arange(count), len(numbers))
        if self.stream in (VALIDATION, MEASURED):
            return self.views[numbers[places]]
        orders = {
            int(r): np.random.default_rng([self.seed, self.stream, int(r)]).permutation(numbers)
            for r in np.unique(rounds)
        }
        return self.views[[int(orders[int(r)][p]) for r, p in zip(rounds, places, strict=True)]]


MARGIN = 1.02
"""A framed view is this many times as wide as the object."""


def frame(views: Views, points: NDArray) -> Views:
    """The same eyes and lights, turned and zoomed so that ``points`` (N, 3) just fill each
    image."""
    scale = np.linalg.norm(views.right, axis=1, keepdims=True)
    v = points[None] - views.eye[:, None]
    depth = np.einsum("bnk,bk->bn", v, views.forward)
    x = np.einsum("bnk,bk->bn", v, views.right / scale) / depth
    y = np.einsum("bnk,bk->bn", v, views.down / scale) / depth
    middle_x, middle_y = ((a.min(axis=1) + a.max(axis=1)) / 2 for a in (x, y))
    target = (
        views.eye
        + views.forward
        + (views.right * middle_x[:, None] + views.down * middle_y[:, None]) / scale
    )
    turned = look_at(views.eye, target, 90.0, views.light, views.intensity, -views.down)
    depth = np.einsum("bnk,bk->bn", v, turned.forward)
    reach = [
        np.abs(np.einsum("bnk,bk->bn", v, a) / depth).max(axis=1)
        for a in (turned.right, turned.down)
    ]
    half = MARGIN * np.maximum(*reach)[:, None]
    arrays = (turned.right * half, turned.down * half)
    return replace(turned, right=arrays[0].astype(np.float32), down=arrays[1].astype(np.float32))


def views_around(points: NDArray, seed: int, light: str = "point") -> ViewSampler:
    """Views of an object of radius 1 around the origin, framed to its ``points`` (N, 3)."""
    return ViewSampler(
        (0.0, 0.0, 0.0), 1.0, seed, hull=support(np.asarray(points, np.float32)), light=light
    )


SUPPORT_POINTS = 1 << 18
"""Points of a cloud that are looked at in every direction. Of larger clouds these are taken evenly,
and the extreme ones along axes and diagonals, so that what sticks out is not cut off."""


def support(positions: NDArray, count: int = 256) -> NDArray[np.float64]:
    """Extreme points of a cloud in ``count`` directions: enough to frame it from any side."""
    if len(positions) > SUPPORT_POINTS:
        axes = (
            np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3).astype(positions.dtype)
        )
        far = np.unique([np.argmax(positions @ axis) for axis in axes])
        positions = np.concatenate(
            [positions[:: -(-len(positions) // SUPPORT_POINTS)], positions[far]]
        )
    k = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    directions = np.stack(
        [np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1
    ).astype(np.float32)
    best = np.concatenate([np.argmax(positions @ d.T, axis=0) for d in np.split(directions, 8)])
    return positions[np.unique(best)].astype(np.float64)


def _unit(v: NDArray) -> NDArray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12)
