"""Shapes of the triangles that decimation leaves: slivers, and triangles that are folded over.

    python -m experiments.triangle_quality [--ratios 0.015 0.05 0.2] [--assets spot stacked ...]

As in a start: what outside views see of each face is its importance, and nothing is fitted.
"slivers": share of the triangles with a quality 4 sqrt(3) area / (sum of squared sides) below 0.1;
the first one is the input's. "folded": triangles that look away (by more than 100 degrees) from
each of at least two neighbours, in connected parts of more than 12: smaller ones are thin boxes and
crossed cards. "stacked" is made here: a post whose flat underside has flaps of coincident
triangles, as booleans leave them.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from experiments.common import ASSETS, Missing, Placed, asset, source_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset

FILES = {
    "spot": "spot/spot.obj",
    "chess_king": "chess_king/King.usd",
    "flight_helmet": "flight_helmet/FlightHelmet.gltf",
    "fox": "fox/Fox.glb",
    "elephant": "elephant/SoC-ElephantWithMonochord.usdc",
    "teapot": "teapot/Teapot.usd",
    "human": "human/human.glb",
    "bush_cards": "tree/bush_cards.glb",
    "oak_cards": "tree/oak_cards.glb",
    "oak_leaves": "tree/oak_leaves.glb",
}
RATIOS = (0.015, 0.05, 0.2)
SLIVER, AWAY, SMALL, LEAST = 0.1, -0.17, 12, 40
"""Quality of slivers, cosine of folds, triangles of parts that are not looked at for folds, and
least budget."""


def stacked(segments: int = 120, rings: int = 60, fans: int = 40) -> Asset:
    """A post, closed, with flaps on its underside: two triangles of opposite sense over the same
    corners, 1 to 9 such pairs at an edge."""
    from appearance_opt.asset.types import Asset, Material, Mesh

    rng = np.random.default_rng(0)
    turn = 2 * np.pi * np.arange(segments) / segments
    radius = np.concatenate(
        [np.linspace(0.02, 0.5, rings // 2), 0.35 + 0.15 * np.cos(np.linspace(0, 9, rings))]
    )
    height = np.concatenate([np.zeros(rings // 2), np.linspace(0, 2, rings)])
    p = np.stack(
        [
            np.outer(radius, np.cos(turn)),
            np.repeat(height[:, None], segments, 1),
            np.outer(radius, np.sin(turn)),
        ],
        -1,
    )
    row = np.arange(p.size // 3).reshape(len(radius), segments)
    a, b = row[:-1], np.roll(row, -1, 1)[:-1]
    c, d = row[1:], np.roll(row, -1, 1)[1:]
    ends = [
        [(r[0], r[i], r[i + 1]) for i in range(1, segments - 1)] for r in (row[0], row[-1][::-1])
    ]
    faces = [
        np.stack([a, b, d], -1).reshape(-1, 3),
        np.stack([a, d, c], -1).reshape(-1, 3),
        *map(np.array, ends),
    ]
    points, flaps = [*p.reshape(-1, 3)], []
    for _ in range(fans):
        ring, k = rng.integers(rings // 6, rings // 3), rng.integers(segments)
        i, j = row[ring, k], row[ring + 1, k]
        side = points[row[ring, (k + 1) % segments]] - points[i]
        for n in range(rng.integers(1, 10)):
            points.append((points[i] + points[j]) / 2 + side * (0.3 + 0.02 * n))
            flaps += [(i, j, len(points) - 1), (j, i, len(points) - 1)]
    mesh = Mesh(
        np.array(points, np.float32),
        np.concatenate([*faces, np.array(flaps)]).astype(np.int32),
        material=Material(),
    )
    return Asset((mesh,), "stacked")


def loaded(name: str) -> Asset:
    """An asset by name: see ``FILES``, "relic" and "stacked". Raises Missing."""
    from appearance_opt.asset import load

    if name == "stacked":
        return stacked()
    return load(
        source_of(name) if name == "relic" else asset(FILES[name]), missing_textures="ignore"
    )


def shapes(p: NDArray, f: NDArray) -> tuple[float, int]:
    """(share of slivers, folded triangles)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    from appearance_opt.asset.normals import unit
    from appearance_opt.initial.edges import sides_of
    from appearance_opt.initial.flips import quality

    a, b, c = (np.asarray(p, np.float64)[f[:, k]] for k in range(3))
    slivers = float(np.mean(quality(a, b, c) < SLIVER))
    normal = unit(np.cross(b - a, c - a))
    sides = sides_of(f)
    first, _, _ = sides.corners(f)
    pair = sides.start[sides.uses == 2]
    i, j = sides.face[pair], sides.face[pair + 1]
    cosine = np.sum(normal[i] * normal[j], axis=1) * np.where(first[pair] != first[pair + 1], 1, -1)
    most, count = np.full(len(f), -1.0), np.bincount(np.concatenate([i, j]), minlength=len(f))
    for k in (i, j):
        np.maximum.at(most, k, cosine)
    graph = coo_matrix((np.ones(len(i)), (i, j)), (len(f), len(f)))
    part = connected_components(graph, directed=False)[1]
    return slivers, int(((most < AWAY) & (count > 1) & (np.bincount(part)[part] > SMALL)).sum())


def rows(name: str, ratios: list[float], decimate: Callable[..., tuple]) -> list[str]:
    """Lines of the table, one per budget. ``decimate``: as ``decimate_with_source``."""
    from appearance_opt.initial.visibility import importance, pixel_counts
    from appearance_opt.views import VISIBILITY

    placed = Placed(loaded(name))
    heavy = placed.subject.survey.triangles
    count = len(heavy.faces)
    pixels = pixel_counts(heavy.scene, count, placed.sampler.held_out(VISIBILITY), 160)
    weight, seen = importance(heavy.positions, heavy.faces, pixels)
    before, _ = shapes(heavy.positions, heavy.faces)
    out = []
    for ratio in ratios:
        began = time.perf_counter()
        budget = max(round(ratio * count), LEAST)
        p, f, *_ = decimate(
            heavy.positions,
            heavy.faces[seen],
            budget,
            weight[seen],
            heavy.single[seen],
        )
        seconds = time.perf_counter() - began
        slivers, folded = shapes(p, f)
        shares = f"{100 * before:.1f} | {100 * slivers:.1f} ({round(slivers * len(f))})"
        out.append(f"| {name} | {count} | {len(f)} | {shares} | {folded} | {seconds:.1f} |")
    return out


def main() -> None:
    from appearance_opt import backend
    from appearance_opt.initial.decimate import decimate_with_source

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--ratios",
        type=float,
        nargs="+",
        default=list(RATIOS),
        help="shares of the triangles to keep",
    )
    names = ["stacked", *FILES, "relic"]
    parser.add_argument(
        "--assets",
        nargs="+",
        choices=names,
        default=names,
        help=f"models of {Path(ASSETS).name}, made here, or both",
    )
    given = parser.parse_args()
    backend.select("cpu")
    columns = (
        "asset",
        "triangles",
        "left",
        "slivers of the input (%)",
        "slivers (%)",
        "folded",
        "seconds",
    )
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for name in given.assets:
        try:
            print("\n".join(rows(name, given.ratios, decimate_with_source)), flush=True)
        except Missing as missing:
            print(f"| {name}: {missing} | | | | | | |")


if __name__ == "__main__":
    main()
