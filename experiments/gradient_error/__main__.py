"""Error and price of vertex gradients: our estimators beside Mitsuba's, against finite differences.

    python -m experiments.gradient_error                    # all scenes at 128^2: out/gradient_error/vertices.csv
    python -m experiments.gradient_error --scenes ball torus --no-peers
    python -m experiments.gradient_error --sizes             # spot at 64^2 to 512^2 with 1k to 94k triangles: sizes.csv
    python -m experiments.gradient_error --sizes spot-1k:64 --no-peers
    python -m experiments.gradient_error --plot              # table and pictures from what was measured

References are computed when first asked for and kept under out/gradient_error/cache. Scenes that
are in the table already are skipped; ``--force`` measures them, and ``--new-references`` makes the
references, anew.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import drjit as dr
import numpy as np

from appearance_opt import backend
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.boundary.edges import Edges
from appearance_opt.render.boundary.estimator import Finder
from appearance_opt.render.boundary.intersections import Intersections
from appearance_opt.render.boundary.pairs import Pairs
from appearance_opt.render.quality import Quality
from experiments import mitsuba_peer
from experiments.gradient_error.estimators import Ours
from experiments.gradient_error.metrics import error_of
from experiments.gradient_error.peers import Peer
from experiments.gradient_error.plot import draw
from experiments.gradient_error.problems import make_problem, problem_names
from experiments.gradient_error.reference import Truth, truth

OUT = Path("out/gradient_error")
REPEATS, TIMED = 6, 8


def at_edges(density: float, rays: int, samples: int = 1, *others: Finder) -> Quality:
    """Points at silhouettes, and what ``others`` find."""
    return Quality(samples, visibility=CameraRays((Edges(density), *others), rays))


SETTINGS = {
    "none": Quality(visibility=CameraRays(())),
    "pairs": Quality(visibility=Pairs()),
    "pairs, 2 x 2": Quality(4, visibility=Pairs()),
    "pairs, 4 x 4": Quality(16, visibility=Pairs()),
    "edges 1, 4 rays": at_edges(1.0, 4),
    "edges 1, 8 rays (default)": Quality(),
    "edges 2, 4 rays": at_edges(2.0, 4),
    "edges 4, 8 rays": at_edges(4.0, 8),
    "edges 4, 8 rays, intersections": at_edges(4.0, 8, 1, Intersections()),
    "edges 8, 16 rays, 2": at_edges(8.0, 16, 2),
    "edges 8, 16 rays, 2, intersections": at_edges(8.0, 16, 2, Intersections()),
    "edges 8, 16 rays, 2 x 2": at_edges(8.0, 16, 4),
    "edges 8, 16 rays, 2 x 2, intersections": at_edges(8.0, 16, 4, Intersections()),
    "edges 16, 64 rays, 4 x 4": at_edges(16.0, 64, 16),
}
"""Edges: silhouette points per pixel of silhouette, rays per pixel that a silhouette crosses, rays
in the others (one where nothing is said)."""

PEERS = [("direct_projective", s) for s in (4, 16, 64)] + [("prb_projective", 16)]
SIZES = [
    ("spot-1k", 64),
    ("spot-1k", 128),
    ("spot-1k", 256),
    ("spot-1k", 512),
    ("spot-6k", 256),
    ("spot-94k", 256),
]


@dataclass
class Row:
    """One estimator on one scene. ``ratio``: time over that of a gradient without silhouettes."""

    scene: str
    triangles: int
    resolution: int
    loss: str
    estimator: str
    milliseconds: float
    ratio: float
    fields_relative: float
    fields_cosine: float
    fields_bias: float
    vertices_relative: float
    vertices_cosine: float
    vertices_bias: float
    reference_fields: float
    reference_vertices: float


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scenes", nargs="*", help="only these; pictures are then left as they are"
    )
    parser.add_argument("--loss", default="log-srgb-l1", choices=("log-srgb-l1", "l2"))
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument(
        "--sizes", nargs="*", metavar="SCENE:RESOLUTION", help="all of them when none is named"
    )
    parser.add_argument("--force", action="store_true")
    parser.add_argument("--new-references", action="store_true")
    parser.add_argument("--plot", action="store_true")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    arguments = parser.parse_args()
    name = "vertices" if arguments.sizes is None else "sizes"
    if arguments.loss != "log-srgb-l1":
        name += f"_{arguments.loss}"
    if not arguments.plot:
        backend.select(arguments.device)
        mitsuba_peer.register()
        path = OUT / f"{name}.csv"
        cases = [(s, 128) for s in arguments.scenes or problem_names()]
        if arguments.sizes is not None:
            cases = [(s, int(r)) for s, r in (c.split(":") for c in arguments.sizes)] or SIZES
        for scene, resolution in cases:
            wanted = [*SETTINGS, *(() if arguments.no_peers else map(peer_name, PEERS))]
            if (
                not arguments.force
                and not arguments.new_references
                and measured(path, scene, resolution, wanted)
            ):
                continue
            rows = measure(
                scene, resolution, arguments.loss, not arguments.no_peers, arguments.new_references
            )
            keep(path, rows)
    if not arguments.scenes and not arguments.sizes:
        draw(OUT)


def measure(scene: str, resolution: int, loss: str, peers: bool, force: bool) -> list[Row]:
    """All estimators on one scene."""
    problem = make_problem(scene, resolution)
    reference = truth(problem, loss, force)
    floor = [error_of(a[:1], a[1]).relative / 2 for a in (reference.by_field, reference.by_vertex)]
    print(f"{scene} at {resolution}^2: the reference's own error {floor[0]:.3f} / {floor[1]:.3f}")
    ours = Ours(problem, reference.target, loss)
    rows: list[Row] = []

    def add(name: str, g: np.ndarray, milliseconds: float) -> None:
        fields, vertices = errors(g, reference)
        base = rows[0].milliseconds if rows else milliseconds
        rows.append(
            Row(scene, len(problem.faces), resolution, loss, name, milliseconds, milliseconds / base,
                fields.relative, fields.cosine, fields.bias,
                vertices.relative, vertices.cosine, vertices.bias, *floor)
        )  # fmt: skip
        print(
            f"  {name:26} {milliseconds:8.1f} ms {milliseconds / base:7.2f} x   fields {fields.relative:.3f} "
            f"{fields.cosine:.4f} {fields.bias:+.3f}   vertices {vertices.relative:.3f} {vertices.cosine:.4f} "
            f"{vertices.bias:+.3f}"
        )

    times = milliseconds_of(
        {n: lambda s, q=q: ours.device(q, s) for n, q in SETTINGS.items()}, TIMED
    )
    for name, quality in SETTINGS.items():
        add(name, np.stack([ours(quality, seed) for seed in range(REPEATS)]), times[name])
    for integrator, samples in PEERS if peers else ():
        peer = Peer(problem, reference.target, loss, integrator)
        name = peer_name((integrator, samples))
        peer.device(1, 0)  # compiles
        add(name, *timed(lambda s, p=peer, n=samples: p(n, s), 3 if resolution <= 128 else 2))
    return rows


def peer_name(peer: tuple[str, int]) -> str:
    return f"{peer[0]}, {peer[1]} spp"


def measured(path: Path, scene: str, resolution: int, estimators: list[str]) -> bool:
    """Are all of these in the table already?"""
    if not path.exists():
        return False
    with path.open() as file:
        there = {
            r["estimator"]
            for r in csv.DictReader(file)
            if (r["scene"], r["resolution"]) == (scene, str(resolution))
        }
    return there.issuperset(estimators)


def errors(gradients: np.ndarray, reference: Truth) -> tuple:
    """(over smooth fields, over single vertices) of repetitions (R, V, 3)."""
    along = np.einsum("rvc,nvc->rn", gradients.astype(np.float64), reference.fields)
    fields = error_of(along, reference.by_field.mean(0))
    return fields, error_of(gradients[:, reference.vertices], reference.by_vertex.mean(0))


def milliseconds_of(work: dict[str, Callable[[int], object]], repeats: int) -> dict[str, float]:
    """Smallest wall time of each, taken in turns: what else runs on the machine only ever adds to
    it."""
    times: dict[str, list[float]] = {name: [] for name in work}
    for seed in range(repeats + 1):
        for name, call in work.items():
            dr.sync_thread()
            began = time.perf_counter()
            dr.eval(call(seed))
            dr.sync_thread()
            times[name].append(1e3 * (time.perf_counter() - began))
    return {name: min(t[1:]) for name, t in times.items()}


def timed(gradient: Callable[[int], np.ndarray], repeats: int) -> tuple[np.ndarray, float]:
    """Repetitions (R, V, 3), and the smallest time of one in milliseconds: for what is too slow to
    be run for its time alone."""
    results, times = [], []
    for seed in range(repeats):
        began = time.perf_counter()
        results.append(gradient(seed))
        times.append(1e3 * (time.perf_counter() - began))
    return np.stack(results), min(times)


def keep(path: Path, rows: list[Row]) -> None:
    """Replace the rows of one scene in a table."""
    path.parent.mkdir(parents=True, exist_ok=True)
    old = []
    if path.exists():
        with path.open() as file:
            old = list(csv.DictReader(file))
    this = (rows[0].scene, str(rows[0].resolution))
    every = [r for r in old if (r["scene"], r["resolution"]) != this] + [asdict(r) for r in rows]
    temporary = path.with_suffix(".partial")
    with temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(asdict(rows[0])))
        writer.writeheader()
        writer.writerows(
            {k: f"{v:.5g}" if isinstance(v, float) else v for k, v in r.items()} for r in every
        )
    temporary.rename(path)


if __name__ == "__main__":
    main()
