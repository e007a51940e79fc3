"""Light characters over the frames of their clips: what does fitting over them gain?

    python -m experiments.animation [--asset human/human.glb] [--triangles 3244] [--clip walk]
        [--steps 300] [--resolution 192] [--gltfpack PATH]
    python -m experiments.animation --table

The ways: "gltfpack" (``-si``, skin kept; needs the program), "rest" (our ``simplify`` at rest, with
weights from the closest point that faces the same way, four per vertex), "animate" (fitted on the
clip), all of the same triangles. Each is measured in every clip, between the frames of the fit:
four views of each of some frames, the same for all ways. Results are kept row by row in
``out/animation/results.json``. ``--asset creature`` is that of ``scenes``.
"""

from __future__ import annotations

import argparse
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np

import appearance_opt as ao
from appearance_opt.asset.rig import Skin
from appearance_opt.asset.types import Asset
from appearance_opt.initial.influences import transfer_influences
from appearance_opt.latent.skinning import prune
from appearance_opt.stages.animation import anchored
from experiments.common import OUT as RESULTS
from experiments.common import Kept, asset
from scenes.creature import creature

OUT = RESULTS / "animation"
FRAMES, VIEWS = 10, 4


def simplified_at_rest(heavy: Asset, **options: object) -> Asset:
    """Our simplification of the bind pose, with transferred weights."""
    moving, rig = anchored(heavy)
    still = replace(moving, rig=None, meshes=tuple(replace(m, skin=None) for m in moving.meshes))
    light = ao.simplify(still, None, **options).asset
    skins = [m.skin for m in moving.meshes if m.skin is not None]
    widest = max(s.bones.shape[1] for s in skins)
    wide = [np.pad(s.bones, ((0, 0), (0, widest - s.bones.shape[1]))) for s in skins]
    weights = [np.pad(s.weights, ((0, 0), (0, widest - s.weights.shape[1]))) for s in skins]
    skin = Skin(np.concatenate(wide), np.concatenate(weights))
    first = np.cumsum([0] + [len(m.positions) for m in moving.meshes[:-1]])
    positions = np.concatenate([m.positions for m in moving.meshes])
    faces = np.concatenate([m.faces + o for m, o in zip(moving.meshes, first, strict=True)])
    meshes = []
    for mesh in light.meshes:
        assert mesh.normals is not None
        own = transfer_influences(
            mesh.positions, mesh.normals, positions, faces, skin, len(rig.bone_nodes)
        )
        meshes.append(replace(mesh, skin=prune(own, 4)))
    return replace(light, meshes=tuple(meshes), rig=rig)


def packed(source: Path, heavy: Asset, triangles: int, program: str) -> Asset:
    """What gltfpack makes of it."""
    out = OUT / f"{heavy.name}_{triangles}_gltfpack.glb"
    ratio = str(triangles / heavy.triangle_count)
    command = [program, "-i", str(source), "-o", str(out), "-si", ratio, "-sa", "-noq", "-kn"]
    subprocess.run(command, check=True, capture_output=True)
    return ao.load(out, keep_rig=True)


def measured(heavy: Asset, light: Asset) -> dict[str, dict[str, float]]:
    """By clip: mean PSNR over covered pixels, of the best and the worst frame, FLIP, silhouette
    shift in pixels."""
    out = {}
    assert heavy.rig is not None
    for clip in heavy.rig.clips:
        times = np.linspace(clip.start, clip.end, 2 * FRAMES + 1)[1::2]  # no frame of the fit's
        found = [
            ao.compare(
                heavy,
                light,
                clip=clip.name,
                frame=float(t) * heavy.rig.rate,
                views=VIEWS,
                resolution=256,
                samples=9,
                seed=k,
            ).metrics
            for k, t in enumerate(times)
        ]
        psnr = [m.psnr_covered for m in found]
        out[clip.name] = {
            "mean": float(np.mean(psnr)),
            "best": max(psnr),
            "worst": min(psnr),
            "flip": float(np.mean([m.flip for m in found])),
            "shift": float(np.mean([m.silhouette_shift for m in found])),
        }
    return out


def table(rows: list[dict]) -> str:
    """All rows in Markdown."""
    lines = [
        "| asset, triangles | way | clip | PSNR | best / worst frame | FLIP | silhouette shift |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        for clip, m in row["clips"].items():
            seen = "" if clip == row["clip"] else " (not fitted)"
            lines.append(
                f"| {row['asset']}, {row['triangles']} | {row['way']} | {clip}{seen} | "
                f"{m['mean']:.2f} | {m['best']:.2f} / {m['worst']:.2f} | {m['flip']:.4f} | "
                f"{m['shift']:.3f} |"
            )
    return "\n".join(lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--asset", default="human/human.glb")
    parser.add_argument("--triangles", type=int, default=3244)
    parser.add_argument("--clip", default="walk")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--resolution", type=int, default=192)
    parser.add_argument("--gltfpack", help="the program")
    parser.add_argument("--table", action="store_true", help="print what is there")
    given = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    rows = Kept(OUT / "results.json")
    if given.table:
        print(table(rows.rows))
        return
    source = None if given.asset == "creature" else asset(given.asset)
    heavy = creature() if source is None else ao.load(source, keep_rig=True)
    common = {
        "triangles": given.triangles, "steps": given.steps, "resolution": given.resolution,
        "pool": 64, "texture_size": 1024, "reallocate": 0,
    }  # fmt: skip
    ways = {
        "rest": lambda: simplified_at_rest(heavy, **common),
        "animate": lambda: ao.animate(heavy, None, clip=given.clip, **common).asset,
    }
    if given.gltfpack and source is not None:
        ways["gltfpack"] = lambda: packed(source, heavy, given.triangles, given.gltfpack)
    for way, make in ways.items():
        key = {"asset": heavy.name, "triangles": given.triangles, "way": way, "clip": given.clip,
               "steps": given.steps}  # fmt: skip
        rows.row(key, lambda make=make: {"clips": measured(heavy, make())})
    print(table(rows.rows))


if __name__ == "__main__":
    main()
