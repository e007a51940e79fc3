"""Sheets made of bands: what a band's ornament is, and how a sheet becomes relief and textures.

A sheet is a (u, s) rectangle: u around, periodic; s along, from 0 to 1, split into bands. Its
relief displaces the mesh; the same ornaments, sampled per texel, give base colour, roughness,
metalness and the normal map. What the mesh resolves is in ``Relief.height``; what it does not is in
``Relief.micro``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset import Material, Texture
from scenes.noise import cellular_noise, fractal_noise, smoothstep


@dataclass(frozen=True)
class Substance:
    """``color``: sRGB in [0, 1]; ``tint``: the sRGB colour it drifts to with low-frequency noise;
    ``veins``: marble veins of that colour; ``crackle``: darkness of fine cracks."""

    color: tuple[float, float, float]
    roughness: float
    metalness: float = 0.0
    tint: tuple[float, float, float] | None = None
    veins: tuple[float, float, float] | None = None
    crackle: float = 0.0


@dataclass(frozen=True)
class Relief:
    """``height``: (len(t), len(u)) metres along the normal; ``micro``: the same, for the normal map
    only; ``layers``: masks (len(t), len(u)) in [0, 1] with what they are made of, painted in
    order."""

    height: NDArray[np.float32]
    micro: NDArray[np.float32] | float = 0.0
    layers: tuple[tuple[NDArray[np.float32], Substance], ...] = ()


@dataclass(frozen=True)
class Patch:
    """The grid on which an ornament is evaluated: ``u`` (W,) around, ``t`` (H,) in [0, 1] along the
    band, which is ``girth`` metres around and ``length`` metres long."""

    u: NDArray
    t: NDArray
    girth: float
    length: float


Ornament = Callable[[Patch], Relief]


def plain(patch: Patch) -> Relief:
    """No relief."""
    return Relief(np.zeros((len(patch.t), len(patch.u)), np.float32))


@dataclass(frozen=True)
class Band:
    """A stretch of a sheet: its ornament, what lies under it, and how many rows of mesh it gets."""

    ground: Substance
    rows: int
    ornament: Ornament = plain


@dataclass(frozen=True)
class Sheet:
    """``edges``: (B + 1,) values of s that bound the bands; ``girths``, ``lengths``: (B,) metres;
    ``dents``: (u, s, radius in metres, depth in metres) of blows, in the mesh only."""

    bands: tuple[Band, ...]
    edges: NDArray
    girths: NDArray
    lengths: NDArray
    seed: int
    dents: tuple[tuple[float, float, float, float], ...] = field(default=())

    def rows(self) -> NDArray:
        """Values of s of the mesh's rows: every band's own count, band edges included."""
        spans = zip(self.edges[:-1], self.edges[1:], self.bands, strict=True)
        return np.concatenate(
            [[0.0], *(np.linspace(a, b, band.rows + 1)[1:] for a, b, band in spans)]
        )

    def reliefs(self, u: NDArray, s: NDArray) -> list[tuple[Band, slice, Patch, Relief]]:
        """Every band with its rows of the grid and its relief there."""
        out = []
        index = np.clip(np.searchsorted(self.edges, s, side="right") - 1, 0, len(self.bands) - 1)
        for k, band in enumerate(self.bands):
            rows = np.flatnonzero(index == k)
            if len(rows):
                t = np.clip((s[rows] - self.edges[k]) / (self.edges[k + 1] - self.edges[k]), 0, 1)
                patch = Patch(u, t, float(self.girths[k]), float(self.lengths[k]))
                out.append((band, slice(rows[0], rows[-1] + 1), patch, band.ornament(patch)))
        return out

    def height(self, u: NDArray, s: NDArray) -> NDArray[np.float32]:
        """Displacement (len(s), len(u)) in metres."""
        total = np.zeros((len(s), len(u)), np.float32)
        for _, rows, _, relief in self.reliefs(u, s):
            total[rows] = relief.height
        girth, length = float(np.mean(self.girths)), float(np.sum(self.lengths))
        for du, ds, radius, depth in self.dents:
            around = ((u - du + 0.5) % 1.0 - 0.5) * girth
            along = (s - ds) * length
            total -= (depth * np.exp(-(along[:, None] ** 2 + around**2) / radius**2)).astype(
                np.float32
            )
        return total


def paint(sheet: Sheet, width: int, height: int, name: str) -> Material:
    """The sheet's material: base colour (sRGB), ORM and normal textures of height x width
    texels."""
    u = (np.arange(width) + 0.5) / width
    s = 1 - (np.arange(height) + 0.5) / height  # v grows downward, s upward
    flip = slice(None, None, -1)
    s_up = s[flip]
    canvas = _Canvas.blank(height, width)
    noise = fractal_noise(u, s_up, (12, max(3, 12 * height // width)), 5, sheet.seed)
    for band, rows, patch, relief in sheet.reliefs(u, s_up):
        canvas.draw(rows, patch, relief, band.ground, noise[rows], sheet.seed)
    canvas.age(u, s_up, noise, sheet, width, height)
    normal = canvas.normals(sheet, s_up)
    return Material(
        name=name,
        base_color_texture=Texture(_bytes(canvas.color[flip]), "srgb", ("repeat", "clamp")),
        orm_texture=Texture(_bytes(canvas.orm[flip]), "linear", ("repeat", "clamp")),
        normal_texture=Texture(_bytes(normal[flip] * 0.5 + 0.5), "linear", ("repeat", "clamp")),
        roughness=1.0,
        metalness=1.0,
    )


@dataclass
class _Canvas:
    """Texel arrays while they are painted, rows in order of s."""

    color: NDArray[np.float32]
    orm: NDArray[np.float32]
    relief: NDArray[np.float32]
    micro: NDArray[np.float32]

    @staticmethod
    def blank(height: int, width: int) -> _Canvas:
        empty = [np.zeros((height, width, c), np.float32) for c in (3, 3)]
        empty[1][..., 0] = 1.0
        return _Canvas(*empty, *(np.zeros((height, width), np.float32) for _ in range(2)))

    def draw(
        self,
        rows: slice,
        patch: Patch,
        relief: Relief,
        ground: Substance,
        noise: NDArray,
        seed: int,
    ) -> None:
        """Ground and layers of one band."""
        full = np.ones(noise.shape, np.float32)
        for mask, substance in ((full, ground), *relief.layers):
            if not np.any(mask):
                continue
            m = mask[..., None]
            color = _pigment(substance, patch, noise, seed)
            self.color[rows] += m * (color - self.color[rows])
            self.orm[rows][..., 1] += mask * (substance.roughness - self.orm[rows][..., 1])
            self.orm[rows][..., 2] += mask * (substance.metalness - self.orm[rows][..., 2])
        self.relief[rows] = relief.height
        self.micro[rows] = relief.micro
        # dirt sits in the corner between two bands
        edge = np.minimum(patch.t, 1 - patch.t) * patch.length
        self.orm[rows][..., 0] -= (0.55 * np.exp(-edge / 0.0012)).astype(np.float32)[:, None]

    def age(
        self, u: NDArray, s: NDArray, noise: NDArray, sheet: Sheet, width: int, height: int
    ) -> None:
        """Patina in the hollows, polish on the edges, grain everywhere."""
        from scipy.ndimage import gaussian_filter

        texel = float(np.sum(sheet.lengths)) / height
        total = self.relief + self.micro
        blurred = gaussian_filter(
            total, (0.0022 / texel,) * 2, mode=("nearest", "wrap"), truncate=2.5
        )
        hollow = np.clip((blurred - total) / 0.0011, 0, 1) + (1 - self.orm[..., 0])
        hollow = np.clip(hollow * (0.85 + 0.25 * noise), 0, 1)
        worn = np.clip((total - blurred) / 0.0010, 0, 1)
        grain = fractal_noise(u, s, (160, 160 * height // width), 3, sheet.seed + 50)
        metal = self.orm[..., 2]
        dark = np.array((0.16, 0.10, 0.05), np.float32)
        strength = (hollow * (0.55 + 0.2 * metal))[..., None]
        self.color += strength * (dark * (0.5 + self.color) - self.color)
        self.color *= (1 + 0.12 * (worn * metal) + 0.018 * grain)[..., None]
        self.orm[..., 1] += 0.30 * hollow - 0.07 * worn * metal + 0.035 * noise + 0.02 * grain
        self.orm[..., 1] = np.clip(self.orm[..., 1], 0.1, 0.95)
        self.orm[..., 2] *= 1 - 0.35 * hollow
        self.orm[..., 0] = np.clip(1 - 0.8 * hollow, 0, 1)
        self.micro += 1.1e-5 * grain * (0.5 + metal) + 3.5e-5 * noise * metal

    def normals(self, sheet: Sheet, s: NDArray) -> NDArray[np.float32]:
        """Tangent-space normals (H, W, 3) of ``micro``, green up (towards larger s)."""
        height, width = self.micro.shape
        index = np.clip(np.searchsorted(sheet.edges, s, side="right") - 1, 0, len(sheet.bands) - 1)
        across = (np.asarray(sheet.girths)[index] / width).astype(np.float32)[:, None]
        along = np.float32(np.sum(sheet.lengths) / height)
        dx = (np.roll(self.micro, -1, axis=1) - np.roll(self.micro, 1, axis=1)) / (2 * across)
        dy = np.gradient(self.micro, axis=0) / along
        length = np.sqrt(1 + dx * dx + dy * dy)
        return np.stack([-dx / length, -dy / length, 1 / length], axis=-1)


def _pigment(substance: Substance, patch: Patch, noise: NDArray, seed: int) -> NDArray[np.float32]:
    """sRGB colour (H, W, 3), or (3,) when nothing varies it."""
    color = np.array(substance.color, np.float32)
    if substance.tint is not None:
        color = color + smoothstep(-1.2, 1.6, noise)[..., None] * (
            np.array(substance.tint, np.float32) - color
        )
    if substance.veins is not None:
        cells = (5, max(2, round(5 * patch.length / patch.girth)))
        swirl = fractal_noise(patch.u, patch.t, cells, 5, seed + 20, gain=0.6)
        fine = fractal_noise(patch.u, patch.t, (cells[0] * 2, cells[1] * 2), 4, seed + 30, gain=0.6)
        vein = np.clip(np.exp(-np.abs(swirl) / 0.05) + 0.45 * np.exp(-np.abs(fine) / 0.04), 0, 1)
        color = color + vein[..., None] * (np.array(substance.veins, np.float32) - color)
    if substance.crackle > 0:
        cells = (max(8, round(patch.girth / 0.011)), max(2, round(patch.length / 0.011)))
        first, second = cellular_noise(patch.u, patch.t, cells, seed + 40)
        color = color * (1 - substance.crackle * np.exp(-(second - first) / 0.035))[..., None]
    return color


def _bytes(x: NDArray) -> NDArray[np.uint8]:
    """[0, 1] to uint8, rounded."""
    return np.clip(x * 255 + 0.5, 0, 255).astype(np.uint8)
