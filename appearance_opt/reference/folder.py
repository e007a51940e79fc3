"""A folder of pictures as a reference: ``transforms.json`` in the manner of NeRF, and its images.

docs/black_boxes.md tells what the file may hold.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset import images
from appearance_opt.asset.paths import read_text, resolve
from appearance_opt.asset.types import srgb_to_linear
from appearance_opt.errors import InputError, ReferenceRenderError
from appearance_opt.views import HELD_OUT, MARGIN, Views, look_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

LEAST = 4
"""Images that are needed at least, of which one is set aside."""

SAME = 1e-4
"""Distance of two places that are the same, in units of the farthest camera's distance."""

FINEST = 8
"""Squared samples in a pixel of a view at most, where an image is finer than that."""

VISIBLE = 1 / 255
"""Least coverage that counts as something."""

DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")


@dataclass(frozen=True)
class Camera:
    """Where a picture was taken. ``to_world`` (3, 3): columns right, down, forward, unit vectors;
    ``eye`` (3,); ``focal``, ``middle`` (2,): focal lengths and principal point in pixels, x right
    and y down from the upper left corner; ``size``: width and height."""

    to_world: NDArray[np.float64]
    eye: NDArray[np.float64]
    focal: NDArray[np.float64]
    middle: NDArray[np.float64]
    size: tuple[int, int]

    def toward(self, pixel: NDArray) -> NDArray[np.float64]:
        """Directions (..., 3) in the world of pixel positions (..., 2)."""
        flat = (np.asarray(pixel, np.float64) - self.middle) / self.focal
        return np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1) @ self.to_world.T

    def project(self, toward: NDArray) -> NDArray[np.float64]:
        """Pixel positions (..., 2) of directions in the world; NaN behind the camera."""
        local = toward @ self.to_world
        depth = np.where(local[..., 2:] > 1e-9, local[..., 2:], np.nan)
        return local[..., :2] / depth * self.focal + self.middle


@dataclass(frozen=True)
class Frame:
    """One picture: its files, camera, and light (``place``, ``intensity``), None if it stands
    still. ``name`` is what messages call it."""

    name: str
    image: Path
    mask: Path | None
    camera: Camera
    light: tuple[NDArray[np.float64], float] | None


class FolderReference:
    """Pictures with cameras (see ``Reference``), in the coordinates of their file, y up.

    ``views``: one for each image: its eye, turned and zoomed so that what its mask shows fills a
    square; where that is cut off by the border of the image, the largest square inside. Any view
    from the eye of an image can be drawn, for another direction and field of view is another
    perspective of the same picture. ``static_light``: no light is known, what images show is baked.
    ``bounds``: of the file, or None: ``reference.silhouettes`` finds them from the masks. Raises
    InputError naming the frame.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        table = _read_table(self.path)
        turn = _turn_up(table, self.path)
        self.bounds = _bounds(table, turn, self.path)
        listed = table.get("frames")
        if not isinstance(listed, list) or len(listed) < LEAST:
            count = len(listed) if isinstance(listed, list) else 0
            raise InputError(
                f"{path}: frames: a fit needs at least {LEAST} images (every {HELD_OUT}th is set "
                f"aside), not {count}"
            )
        self.frames = [_frame(table, row, k, turn, self.path) for k, row in enumerate(listed)]
        known = [frame.light is not None for frame in self.frames]
        if any(known) and not all(known):
            raise InputError(
                f"{path}: frame {known.index(False)} has no light, and others have one; give all of "
                "them one, or none"
            )
        self.static_light = not all(known)
        self.clipped: list[bool] = []
        self.views = Views.concatenate([self._framed(frame) for frame in self.frames])

    @property
    def files(self) -> tuple[Path, ...]:
        """All that it is read from."""
        masks = (frame.mask for frame in self.frames if frame.mask is not None)
        return (self.path, *(frame.image for frame in self.frames), *masks)

    def _framed(self, frame: Frame) -> Views:
        """The view of a picture."""
        pixels, camera = self._pixels(frame), frame.camera
        covered = pixels[..., 3] > VISIBLE
        if not covered.any():
            raise InputError(f"{self.path}: {frame.name}: its mask is empty: nothing is shown")
        (y0, y1), (x0, x1) = ((a.min(), a.max() + 1.0) for a in np.nonzero(covered))
        width, height = camera.size
        clipped = bool(x0 == 0 or y0 == 0 or x1 == width or y1 == height)
        self.clipped.append(clipped)
        target = camera.eye + camera.toward(np.array([(x0 + x1) / 2, (y0 + y1) / 2]))
        up = -camera.to_world[:, 1]
        place, intensity = (camera.eye, 1.0) if frame.light is None else frame.light
        view = look_at(camera.eye, target, 90.0, place[None], intensity, up[None])
        corners = camera.toward(np.array([[x0, y0], [x1, y0], [x0, y1], [x1, y1]]))
        axes = np.stack([view.right[0], view.down[0], view.forward[0]]).astype(np.float64)
        local = corners @ axes.T
        half = MARGIN * np.abs(local[:, :2] / local[:, 2:]).max()
        if clipped:
            half = _largest_inside(camera, axes, half)
        return look_at(
            camera.eye,
            target,
            np.degrees(2 * np.arctan(half)),
            place[None],
            intensity,
            up[None],
        )

    def _pixels(self, frame: Frame) -> NDArray[np.float32]:
        """(H, W, 4) linear, premultiplied. Raises InputError if file and camera do not match."""
        name = f"{self.path}: {frame.name}"
        pixels = images.read(frame.image)
        height, width = pixels.shape[:2]
        if (width, height) != frame.camera.size:
            w, h = frame.camera.size
            raise InputError(f"{name}: the image is {width} x {height}, its camera {w} x {h}")
        if min(width, height) < 2:
            raise InputError(f"{name}: the image is {width} x {height}, which shows nothing")
        channels = pixels.shape[2]
        if frame.mask is None and channels not in (2, 4):
            raise InputError(
                f"{name}: the image has no alpha, and there is no mask_path: what of it is the "
                "object?"
            )
        values, is_float = _unit(pixels), pixels.dtype.kind == "f"
        color = values[..., :3] if channels >= 3 else values[..., :1].repeat(3, axis=2)
        color = color if is_float else srgb_to_linear(color)
        alpha = values[..., -1] if channels in (2, 4) else np.ones((height, width), np.float32)
        if not is_float:  # of an EXR, colours are premultiplied
            color = color * alpha[..., None]
        if frame.mask is not None:
            mask = _unit(images.read(frame.mask))[..., 0]
            if mask.shape != alpha.shape:
                raise InputError(
                    f"{name}: its mask is {mask.shape[1]} x {mask.shape[0]}, the image "
                    f"{width} x {height}"
                )
            color, alpha = color * mask[..., None], alpha * mask
        out = np.concatenate([color, alpha[..., None]], axis=-1).astype(np.float32)
        if not np.isfinite(out).all() or out.min() < 0:
            raise InputError(f"{name}: has pixels that are NaN, infinite or negative")
        return out

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]:
        """See ``Reference``. Raises ReferenceRenderError for a view from where no picture was
        taken."""
        out = np.empty((len(views), resolution, resolution, 4), np.float32)
        for k in range(len(views)):
            frame = self.frames[self._find(views[k : k + 1])]
            out[k] = resample(self._pixels(frame), frame.camera, views[k : k + 1], resolution)
        return out

    def _find(self, view: Views) -> int:
        """Number of the picture that was taken from where a view is, the one that looks its way
        most."""
        own, reach = self.views, float(np.abs(self.views.eye).max()) + 1e-12
        off = np.linalg.norm(own.eye - view.eye, axis=1)
        if not self.static_light:
            off = np.maximum(off, np.linalg.norm(own.light - view.light, axis=1))
        near = off <= SAME * reach
        if not near.any():
            raise ReferenceRenderError(
                f"{self.path}: there is no picture from {view.eye[0].round(4).tolist()}"
            )
        return int(np.argmax(np.where(near, own.forward @ view.forward[0], -2)))


def resample(
    pixels: NDArray[np.float32], camera: Camera, view: Views, resolution: int
) -> NDArray[np.float32]:
    """(resolution, resolution, 4): a picture (H, W, 4) in the perspective of a ``view`` from the
    same eye, averaged over pixels; black and uncovered beyond its borders."""
    height, width = pixels.shape[:2]
    forward, right, down = (a[0].astype(np.float64) for a in (view.forward, view.right, view.down))
    scale = 2 * np.linalg.norm(right) * camera.focal.max() / resolution
    fine = int(np.clip(math.ceil(scale), 1, FINEST))
    at = (np.arange(fine * resolution) + 0.5) / (fine * resolution) * 2 - 1
    toward = forward + at[None, :, None] * right + at[:, None, None] * down
    place = np.nan_to_num(camera.project(toward), nan=-1.0)
    inside = np.all((place >= 0) & (place <= [width, height]), axis=-1, keepdims=True)
    x, y = (np.clip(place[..., k] - 0.5, 0, n - 1) for k, n in ((0, width), (1, height)))
    x0, y0 = (np.minimum(a.astype(np.int64), n - 2) for a, n in ((x, width), (y, height)))
    fx, fy = ((a - b)[..., None].astype(np.float32) for a, b in ((x, x0), (y, y0)))
    upper = pixels[y0, x0] * (1 - fx) + pixels[y0, x0 + 1] * fx
    lower = pixels[y0 + 1, x0] * (1 - fx) + pixels[y0 + 1, x0 + 1] * fx
    out = (upper * (1 - fy) + lower * fy) * inside
    return out.reshape(resolution, fine, resolution, fine, 4).mean(axis=(1, 3))


def _largest_inside(camera: Camera, axes: NDArray, half: float) -> float:
    """Half the width of the largest square view, at most ``half``, all of which a picture shows."""
    signs = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]], np.float64)
    size = np.array(camera.size)
    low, high = 0.0, half
    for _ in range(24):
        middle = (low + high) / 2
        at = camera.project(np.concatenate([middle * signs, np.ones((4, 1))], axis=1) @ axes)
        low, high = (middle, high) if ((at >= 0) & (at <= size)).all() else (low, middle)
    return low


def _unit(pixels: NDArray) -> NDArray[np.float32]:
    """Stored values as floats; of integers, from 0 to 1."""
    if pixels.dtype.kind == "u":
        return (pixels / np.float32(np.iinfo(pixels.dtype).max)).astype(np.float32)
    return pixels.astype(np.float32)


def _read_table(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    try:
        table = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON: {error}") from error
    if not isinstance(table, dict):
        raise InputError(f"{path}: must be a JSON object with frames")
    return table


def _turn_up(table: dict[str, Any], path: Path) -> NDArray[np.float64]:
    """(3, 3) from the file's coordinates to ours, in which y is up."""
    up = table.get("up", "z")
    if up not in ("y", "z"):
        raise InputError(f"{path}: up: must be y or z, not {up!r}")
    return np.eye(3) if up == "y" else np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def _bounds(table: dict[str, Any], turn: NDArray, path: Path) -> NDArray[np.float64] | None:
    if "bounds" not in table:
        return None
    box = _numbers(table["bounds"], (2, 3), f"{path}: bounds") @ turn.T
    box = np.stack([box.min(axis=0), box.max(axis=0)])
    if not (box[0] < box[1]).all():
        raise InputError(f"{path}: bounds: the box is empty")
    return box


def _frame(table: dict[str, Any], row: Any, k: int, turn: NDArray, path: Path) -> Frame:
    what = f"{path}: frame {k}"
    if not isinstance(row, dict) or not isinstance(row.get("file_path"), str):
        raise InputError(f"{what}: needs a file_path")
    name = f"frame {k} ({row['file_path']})"
    image = _find_image(row["file_path"], path)
    mask = row.get("mask_path")
    found = None if mask is None else _find_image(str(mask), path)
    pose = _numbers(row.get("transform_matrix"), (4, 4), f"{what}: transform_matrix")
    axes = pose[:3, :3] / np.maximum(np.linalg.norm(pose[:3, :3], axis=0), 1e-12)
    if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-3 or np.linalg.det(axes) < 0:
        raise InputError(f"{what}: transform_matrix: is no rotation with a place")
    eye = turn @ pose[:3, 3]
    # OpenGL's cameras look along -z, y up; ours along z, y down
    to_world = turn @ (axes * np.array([1.0, -1.0, -1.0]))
    camera = _camera({**table, **row}, to_world, eye, image, what)
    return Frame(name, image, found, camera, _light({**table, **row}, eye, turn, what))


def _find_image(name: str, path: Path) -> Path:
    """A file beside ``path``; NeRF's own data leaves out .png."""
    if Path(name).is_absolute():
        raise InputError(f"{path}: refers to '{name}'; files are named relative to it")
    return resolve(name if Path(name).suffix else f"{name}.png", path)


def _camera(
    values: dict[str, Any], to_world: NDArray, eye: NDArray, image: Path, what: str
) -> Camera:
    for key in DISTORTIONS:
        if values.get(key):
            raise InputError(f"{what}: {key}: lenses that distort are not read; undistort first")
    if "w" in values and "h" in values:
        width, height = (_number(values[k], f"{what}: {k}") for k in ("w", "h"))
    else:
        height, width = images.read(image).shape[:2]
    if "fl_x" in values:
        fx = _number(values["fl_x"], f"{what}: fl_x")
    elif "camera_angle_x" in values:
        angle = _number(values["camera_angle_x"], f"{what}: camera_angle_x")
        if not angle < math.pi:
            raise InputError(f"{what}: camera_angle_x: {angle} is no angle below pi (radians)")
        fx = width / 2 / math.tan(angle / 2)
    else:
        raise InputError(f"{what}: needs camera_angle_x, or fl_x")
    fy = _number(values["fl_y"], f"{what}: fl_y") if "fl_y" in values else fx
    middle = [
        _number(values[key], f"{what}: {key}", -math.inf) if key in values else n / 2
        for key, n in (("cx", width), ("cy", height))
    ]
    size = (int(width), int(height))
    return Camera(to_world, eye, np.array([fx, fy]), np.array(middle), size)


def _light(
    values: dict[str, Any], eye: NDArray, turn: NDArray, what: str
) -> tuple[NDArray[np.float64], float] | None:
    light = values.get("light")
    if light is None or light == "static":
        return None
    if not isinstance(light, dict) or light.get("type") not in ("point", "headlight"):
        raise InputError(
            f"{what}: light: must be static, or an object of type point or headlight with an "
            "intensity"
        )
    intensity = _number(light.get("intensity"), f"{what}: light: intensity")
    if light["type"] == "headlight":
        return eye, intensity
    return turn @ _numbers(light.get("position"), (3,), f"{what}: light: position"), intensity


def _number(value: Any, what: str, above: float = 0.0) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{what}: must be a number, not {value!r}")
    if not (math.isfinite(value) and value > above):
        raise InputError(f"{what}: must be finite{' and positive' if above == 0 else ''}: {value}")
    return float(value)


def _numbers(value: Any, shape: tuple[int, ...], what: str) -> NDArray[np.float64]:
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"{what}: must be {' x '.join(map(str, shape))} finite numbers")
    return array
