"""The demo object: a lidded enamel urn with gilt mounts on a marble plinth, 0.77 m high.

Every part is a sheet of bands turned on a lathe (or swept along a curve); see the README beside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset import Asset, Material, Mesh
from scenes import ornament as o
from scenes.bands import Band, Sheet, Substance, paint
from scenes.cloisonne import cloisonne
from scenes.lathe import Piece, Profile, arc, curve, join, line, place, profile_sheet, tube, turn

GOLD = Substance((0.94, 0.75, 0.40), 0.30, 1.0, tint=(0.84, 0.58, 0.26))
COBALT = Substance((0.035, 0.11, 0.43), 0.20, tint=(0.02, 0.05, 0.24))
TURQUOISE = Substance((0.08, 0.53, 0.54), 0.22, tint=(0.03, 0.36, 0.44))
IVORY = Substance((0.91, 0.85, 0.71), 0.38, tint=(0.82, 0.72, 0.53), crackle=0.35)
CORAL = Substance((0.76, 0.21, 0.13), 0.30, tint=(0.60, 0.12, 0.08))
MARBLE = Substance((0.05, 0.085, 0.075), 0.24, tint=(0.09, 0.15, 0.12), veins=(0.78, 0.78, 0.68))
RUBY = Material("ruby", (0.34, 0.006, 0.016), roughness=0.14)
PEARL = Material("pearl", (0.80, 0.74, 0.63), roughness=0.25)
SETTING = Material("setting", (0.85, 0.50, 0.13), roughness=0.30, metalness=1.0)

MEDALLIONS = 8

_FULL_COUNT = 486_000
"""Triangles at density 1, where every band has the rows written beside it."""


def relic(triangles: int = 400_000, texture_size: int = 2048) -> Asset:
    """The urn with about ``triangles`` triangles. ``texture_size``: texels across the body's maps;
    the other parts have half."""
    density = float(np.sqrt(triangles / _FULL_COUNT))
    body_profile, body_sheet = _body(density)
    half = max(64, texture_size // 2)
    meshes = [
        _turned(_plinth(density), _columns(128, density), half, "plinth", _octagon),
        _turned(_foot(density), _columns(256, density), half, "foot"),
        _turned((body_profile, body_sheet), _columns(528, density), texture_size, "body"),
        _turned(_lid(density), _columns(256, density), half, "lid"),
        _handles(density, half),
        *_jewels(body_profile, body_sheet, density),
    ]
    return Asset(tuple(meshes), name="relic")


def _plinth(density: float) -> tuple[Profile, Sheet]:
    pieces = [
        (line((0, 0), (0.114, 0)), MARBLE, 3, None),
        (curve((0.114, 0), (0.118, 0.001), (0.120, 0.005)), MARBLE, 4, None),
        (line((0.120, 0.005), (0.120, 0.026)), MARBLE, 8, None),
        (curve((0.120, 0.026), (0.118, 0.030), (0.112, 0.031)), MARBLE, 4, None),
        (arc((0.111, 0.032), (0.108, 0.038), 0.003), GOLD, 8, o.rope(128, 1.0, 0.0012)),
        (curve((0.107, 0.039), (0.1015, 0.042), (0.100, 0.048)), MARBLE, 8, None),
        (line((0.100, 0.048), (0.099, 0.050), (0.085, 0.050)), MARBLE, 4, None),
        (line((0.085, 0.050), (0, 0.050)), MARBLE, 3, None),
    ]
    return profile_sheet(
        _pieces(pieces, density),
        11,
        dents=((0.07, 0.42, 0.006, 0.0025), (0.82, 0.62, 0.005, 0.002)),
    )


def _foot(density: float) -> tuple[Profile, Sheet]:
    pieces = [
        (line((0, 0.050), (0.090, 0.050)), GOLD, 2, None),
        (arc((0.091, 0.0505), (0.091, 0.0615), 0.0045), GOLD, 14, o.rope(64, 1.6, 0.0022)),
        (line((0.091, 0.0615), (0.086, 0.0625)), GOLD, 2, None),
        (
            curve((0.086, 0.0625), (0.081, 0.076), (0.062, 0.089), (0.041, 0.097)),
            COBALT,
            34,
            o.petals(16, 0.0045, GOLD, TURQUOISE, GOLD),
        ),
        (arc((0.040, 0.098), (0.037, 0.106), 0.003), GOLD, 14, o.beads(24)),
        (
            curve((0.034, 0.107), (0.0245, 0.118), (0.0245, 0.128), (0.032, 0.138)),
            IVORY,
            24,
            o.flutes(16, 0, 0.0022, 0.16, GOLD),
        ),
        (arc((0.033, 0.139), (0.034, 0.145), 0.003), GOLD, 8, o.rope(40, 1.0, 0.0012)),
        (arc((0.034, 0.146), (0.034, 0.180), 0.023, 60), GOLD, 36, o.gadroons(14, 3.0, 0.0065)),
        (arc((0.034, 0.181), (0.033, 0.187), 0.003), GOLD, 8, o.rope(40, 1.0, 0.0012)),
        (curve((0.031, 0.188), (0.027, 0.195), (0.031, 0.202)), COBALT, 10, None),
        (arc((0.034, 0.203), (0.038, 0.210), 0.003), GOLD, 10, o.beads(26)),
        (line((0.037, 0.211), (0, 0.211)), GOLD, 2, None),
    ]
    return profile_sheet(_pieces(pieces, density), 23, dents=((0.30, 0.30, 0.010, 0.0025),))


def _body(density: float) -> tuple[Profile, Sheet]:
    belly = cloisonne(
        MEDALLIONS, wire=GOLD, field=TURQUOISE, leaves=TURQUOISE, petal=IVORY, heart=CORAL
    )
    pieces = [
        (line((0, 0.2105), (0.036, 0.2105)), GOLD, 2, None),
        (arc((0.037, 0.211), (0.043, 0.218), 0.003), GOLD, 8, o.rope(44, 1.0, 0.0012)),
        (
            curve((0.043, 0.219), (0.078, 0.231), (0.110, 0.257), (0.132, 0.292)),
            COBALT,
            44,
            o.petals(16, 0.0065, GOLD, IVORY, GOLD),
        ),
        (arc((0.133, 0.293), (0.138, 0.304), 0.0045), GOLD, 11, o.rope(96, 1.6, 0.0022)),
        (
            curve(
                (0.139, 0.305), (0.1515, 0.342), (0.1535, 0.372), (0.148, 0.404), (0.1365, 0.432)
            ),
            COBALT,
            44,
            belly,
        ),
        (arc((0.136, 0.433), (0.131, 0.443), 0.0045), GOLD, 11, o.rope(96, -1.6, 0.0022)),
        (
            curve((0.130, 0.444), (0.124, 0.458), (0.1145, 0.469)),
            IVORY,
            24,
            o.meander(22, 0.0014, COBALT),
        ),
        (arc((0.114, 0.4695), (0.107, 0.476), 0.002), GOLD, 12, o.beads(72)),
        (
            curve((0.106, 0.477), (0.090, 0.490), (0.069, 0.499)),
            COBALT,
            26,
            o.tongues(24, 0.0034, TURQUOISE, CORAL, GOLD),
        ),
        (arc((0.068, 0.500), (0.064, 0.507), 0.003), GOLD, 10, o.rope(56, 1.4, 0.0016)),
        (
            curve((0.062, 0.508), (0.0545, 0.528), (0.053, 0.552), (0.060, 0.578)),
            IVORY,
            28,
            o.flutes(18, 2.5, 0.0036, 0.20, GOLD),
        ),
        (arc((0.061, 0.579), (0.067, 0.593), 0.005), GOLD, 14, o.gadroons(36, 0, 0.0032)),
        (curve((0.068, 0.594), (0.071, 0.597), (0.071, 0.601)), GOLD, 4, None),
        (line((0.071, 0.601), (0.067, 0.603)), GOLD, 2, None),
        (line((0.067, 0.603), (0, 0.603)), GOLD, 2, None),
    ]
    dents = ((0.93, 0.30, 0.012, 0.0030), (0.43, 0.44, 0.016, 0.0025), (0.60, 0.62, 0.010, 0.0025))
    return profile_sheet(_pieces(pieces, density), 37, dents)


def _lid(density: float) -> tuple[Profile, Sheet]:
    pieces = [
        (line((0, 0.6035), (0.065, 0.6035)), GOLD, 2, None),
        (arc((0.066, 0.604), (0.066, 0.614), 0.004), GOLD, 14, o.rope(60, 1.6, 0.0020)),
        (line((0.065, 0.615), (0.0625, 0.616)), GOLD, 2, None),
        (
            curve((0.0625, 0.616), (0.059, 0.636), (0.045, 0.654), (0.024, 0.664)),
            GOLD,
            46,
            o.scales(20, 5, 0.0030, COBALT, TURQUOISE, GOLD),
        ),
        (arc((0.023, 0.665), (0.022, 0.673), 0.003), GOLD, 12, o.beads(16)),
        (curve((0.019, 0.674), (0.0115, 0.683), (0.015, 0.692)), IVORY, 10, None),
        (arc((0.016, 0.693), (0.016, 0.698), 0.0025), GOLD, 6, o.rope(28, 1.0, 0.0008)),
        (
            curve((0.015, 0.699), (0.0265, 0.712), (0.024, 0.728), (0.009, 0.741)),
            GOLD,
            32,
            o.gadroons(12, 2.5, 0.0042),
        ),
        (arc((0.0085, 0.742), (0.0085, 0.747), 0.002), GOLD, 6, o.rope(16, 1.0, 0.0006)),
        (line((0.008, 0.748), (0, 0.750)), GOLD, 2, None),
    ]
    return profile_sheet(_pieces(pieces, density), 53, dents=((0.2, 0.45, 0.010, 0.002),))


def _pieces(
    rows: list[tuple[NDArray, Substance, int, Callable | None]], density: float
) -> list[Piece]:
    return [
        Piece(
            profile, Band(ground, max(1, round(count * density)), *((carving,) if carving else ()))
        )
        for profile, ground, count, carving in rows
    ]


def _columns(count: int, density: float) -> int:
    """Columns of mesh: a multiple of 16, so that repeats and medallions meet vertices evenly."""
    return max(32, 16 * round(count * density / 16))


def _turned(
    shape: tuple[Profile, Sheet],
    columns: int,
    size: int,
    name: str,
    cross_section: Callable | None = None,
) -> Mesh:
    profile, sheet = shape
    return turn(profile, sheet, columns, paint(sheet, size, size, name), name, cross_section)


def _octagon(angle: NDArray) -> NDArray:
    """Radius of a unit octagon with rounded corners, flats facing the axes (a p-norm of its
    planes)."""
    planes = angle[:, None] - np.arange(8) * (np.pi / 4)
    return 1.0 / np.sum(np.clip(np.cos(planes), 0, None) ** 60, axis=1) ** (1 / 60)


def _handles(density: float, texture: int) -> Mesh:
    """Both handles: a twisted S from belly to rim with collars, and three scrolls that curl off
    it."""
    sheet = Sheet(
        (Band(GOLD, max(24, round(240 * density)), o.rope(5, 16.0, 0.0034)),),
        np.array([0.0, 1.0]), np.array([0.055]), np.array([0.30]), 71,
    )  # fmt: skip
    scroll = Sheet(
        (Band(GOLD, max(16, round(80 * density)), o.rope(4, 5.0, 0.0018)),),
        np.array([0.0, 1.0]), np.array([0.035]), np.array([0.14]), 73,
    )  # fmt: skip
    material = paint(sheet, texture // 4, texture, "handles")
    main = curve(
        (0.140, 0.420), (0.165, 0.408), (0.195, 0.420), (0.212, 0.455), (0.210, 0.505), (0.188, 0.553),
        (0.152, 0.588), (0.112, 0.600), (0.082, 0.594), (0.064, 0.587), count=400,
    )  # fmt: skip
    columns = max(10, 2 * round(10 * density))
    parts = [tube(main, _handle_radius, sheet, columns, material, "handle")]
    for centre, outer, start, hand, turns in (
        ((0.196, 0.392), 0.030, 1.9, -1, 1.7),
        ((0.187, 0.590), 0.030, 3.6, -1, 1.7),
        ((0.186, 0.475), 0.028, 0.2, 1, 1.6),
    ):
        t = np.linspace(0, 1, 300)
        radius, angle = outer * (0.12 + 0.88 * (1 - t) ** 1.2), start + hand * 2 * np.pi * turns * t
        path = np.stack(
            [centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)], axis=1
        )
        parts.append(tube(path, _scroll_radius, scroll, columns, material, "scroll"))
    right = join(parts, "handle")
    return join([right, _half_turn(right)], "handles")


def _handle_radius(s: NDArray) -> NDArray:
    """Metres along the handle: swelling in the middle, three collars, round ends."""
    collars = sum(np.exp(-(((s - c) / 0.012) ** 2)) for c in (0.16, 0.5, 0.84))
    body = 0.0068 + 0.0028 * np.sin(np.pi * s) + 0.0034 * collars
    return body * np.sqrt(np.clip(1 - (2 * s - 1) ** 24, 0, 1))


def _scroll_radius(s: NDArray) -> NDArray:
    """Metres along a scroll: it thins, and ends in a ball."""
    ball = np.exp(-(((s - 0.95) / 0.03) ** 2))
    return (0.0066 * (1 - 0.55 * s) + 0.0042 * ball) * np.sqrt(np.clip(1 - (2 * s - 1) ** 30, 0, 1))


def _half_turn(mesh: Mesh) -> Mesh:
    turned = np.array((-1, 1, -1), np.float32)
    return Mesh(
        mesh.positions * turned,
        mesh.faces,
        mesh.normals * turned,
        mesh.uvs,
        material=mesh.material,
        name=mesh.name,
    )


def _jewels(profile: Profile, sheet: Sheet, density: float) -> list[Mesh]:
    """Rubies in corded settings on the medallions and on top, pearls on the knop."""
    belly = int(np.argmax(sheet.girths))
    point, normal = (x[0] for x in profile.at(np.array([sheet.edges[belly : belly + 2].mean()])))
    rubies, settings, pearls = [], [], []
    for k in range(MEDALLIONS):
        angle = 2 * np.pi * (k + 0.5) / MEDALLIONS
        around = np.array((np.sin(angle), 0.0, np.cos(angle)))
        up = normal[0] * around + np.array((0.0, normal[1], 0.0))
        seat = point[0] * around + np.array((0.0, point[1], 0.0)) + 0.0030 * up
        rubies.append(place(_gem(0.0082, 0.0075, RUBY, density), seat, up))
        settings.append(place(_setting(0.0088, 0.0019, density), seat + 0.0008 * up, up))
    for k in range(7):
        angle = 2 * np.pi * (k + 0.5) / 7
        around = np.array((np.sin(angle), 0.0, np.cos(angle)))
        seat = 0.0625 * around + np.array((0.0, 0.163, 0.0))
        pearls.append(place(_gem(0.0060, 0.0058, PEARL, density), seat, around))
        settings.append(place(_setting(0.0064, 0.0016, density), seat, around))
    rubies.append(
        place(
            _gem(0.0125, 0.0125, RUBY, density),
            np.array((0.0, 0.758, 0.0)),
            np.array((0.0, 1.0, 0.0)),
        )
    )
    return [join(rubies, "rubies"), join(pearls, "pearls"), join(settings, "settings")]


def _gem(radius: float, height: float, material: Material, density: float) -> Mesh:
    """Ellipsoid about the origin, ``height`` its half axis along +Y."""
    polar = np.linspace(-np.pi / 2, np.pi / 2, 60)
    outline = np.stack([radius * np.cos(polar), height * np.sin(polar)], axis=1)
    outline[[0, -1], 0] = 0.0
    band = Band(GOLD, max(6, round(14 * density)))
    return turn(*profile_sheet([Piece(outline, band)], 0), _columns(32, density), material, "gem")


def _setting(radius: float, thickness: float, density: float) -> Mesh:
    """A corded ring on a disc about the origin."""
    pieces = [
        (line((0, -0.004), (radius, -0.004)), GOLD, 1, None),
        (
            arc((radius, -0.004), (radius, thickness), 0.9 * thickness),
            GOLD,
            9,
            o.rope(20, 1.5, 0.0007),
        ),
        (line((radius, thickness), (0, thickness - 0.003)), GOLD, 1, None),
    ]
    return turn(
        *profile_sheet(_pieces(pieces, density), 0), _columns(64, density), SETTING, "setting"
    )
