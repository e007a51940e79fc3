"""Where others put the vertices of a character, against our own poses.

    python -m experiments.animation.evaluators FILE [--clip NAME] [--count 7] [--node FOLDER]

FILE is what ``animate`` wrote: USD is posed by UsdSkel's own skinning (usd-core), GLB by three.js
in node (GLTFLoader, AnimationMixer, SkinnedMesh; ``--node``: a folder with node_modules/three).
Prints the largest distance between vertices, relative to the height of the character, and how much
the pictures of the two differ. Times lie between keys, too.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset


def pose_by_usdskel(path: Path, clip: str, times: Sequence[float]) -> list[NDArray[np.float64]]:
    """(N, 3) points of all skinned meshes at each time, in the order of the stage, in metres; each
    skinned by UsdSkelSkinningQuery."""
    from pxr import Usd, UsdGeom, UsdSkel

    stage = Usd.Stage.Open(str(path))
    for prim in stage.Traverse():
        if "clip" in prim.GetVariantSets().GetNames():
            prim.GetVariantSets().GetVariantSet("clip").SetVariantSelection(clip)
    unit = UsdGeom.GetStageMetersPerUnit(stage)
    rate = stage.GetTimeCodesPerSecond()
    cache = UsdSkel.Cache()
    found = []
    for prim in stage.Traverse():
        if prim.IsA(UsdSkel.Root):
            root = UsdSkel.Root(prim)
            cache.Populate(root, Usd.PrimDefaultPredicate)
            for binding in cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate):
                skeleton = cache.GetSkelQuery(binding.GetSkeleton())
                found += [(skeleton, query) for query in binding.GetSkinningTargets()]
    order = {p.GetPath(): k for k, p in enumerate(stage.Traverse())}
    found.sort(key=lambda pair: order[pair[1].GetPrim().GetPath()])
    out = []
    for time in times:
        code, points = Usd.TimeCode(time * rate), []
        xforms = UsdGeom.XformCache(code)
        for skeleton, query in found:
            prim = query.GetPrim()
            moves = skeleton.ComputeSkinningTransforms(code)
            p = UsdGeom.Mesh(prim).GetPointsAttr().Get(code)
            query.ComputeSkinnedPoints(moves, p, code)
            world = np.array(xforms.GetLocalToWorldTransform(skeleton.GetPrim()))
            points.append((np.array(p, np.float64) @ world[:3, :3] + world[3, :3]) * unit)
        out.append(np.concatenate(points))
    return out


def pose_by_three(
    path: Path, clip: str, times: Sequence[float], node: Path
) -> list[NDArray[np.float64]]:
    """(N, 3) vertices of all meshes at each time, in the order of the scene."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "points.bin"
        script = Path(__file__).with_name("three_pose.mjs")
        seconds = ",".join(f"{t:.17g}" for t in times)
        command = ["node", str(script), str(path), clip, seconds, str(node), str(out)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"three.js: {done.stderr.strip()}")
        counts = [count for _, count in json.loads(done.stdout.splitlines()[-1])]
        values = np.fromfile(out, np.float64)
    return list(values.reshape(len(times), sum(counts), 3))


def pose_by_us(asset: Asset, clip: str, times: Sequence[float]) -> list[NDArray[np.float64]]:
    """The same by this package."""
    from appearance_opt.asset.posing import pose, pose_positions

    matrices = [pose(asset, clip, t) for t in times]
    return [np.concatenate([pose_positions(m, at) for m in asset.meshes]) for at in matrices]


def farthest(a: NDArray, b: NDArray) -> float:
    """The largest distance between points of the same number; between nearest ones, both ways, if
    there are not as many: readers may split vertices otherwise."""
    from scipy.spatial import cKDTree

    if a.shape == b.shape:
        return float(np.linalg.norm(a - b, axis=1).max())
    return max(float(cKDTree(x).query(y)[0].max()) for x, y in ((a, b), (b, a)))


def picture_error(asset: Asset, clip: str, time: float, points: NDArray) -> float:
    """PSNR in dB over covered pixels between the asset as we pose it and with the vertices nearest
    to ``points`` instead. Two views."""
    from scipy.spatial import cKDTree

    from appearance_opt.asset.posing import pose_asset
    from appearance_opt.evaluate.metrics import compare_images
    from experiments.animation.measure import images_of, take

    ours = take(asset, clip, [time], 2, 256)[0]
    posed = pose_asset(asset, clip, time)
    tree = cKDTree(points)
    theirs = tuple(
        replace(m, positions=points[tree.query(m.positions)[1]].astype(np.float32))
        for m in posed.meshes
    )
    still = replace(posed, meshes=theirs)
    return compare_images(ours.images, images_of(still, ours)).psnr_covered


def main() -> None:
    import appearance_opt
    from appearance_opt import backend

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--clip")
    parser.add_argument("--count", type=int, default=7, help="times, evenly over the clip")
    parser.add_argument("--node", type=Path, default=Path(), help="folder with node_modules/three")
    args = parser.parse_args()
    backend.select()
    asset = appearance_opt.load(args.file, keep_rig=True)
    assert asset.rig is not None, "there is no rig in the file"
    clip = asset.rig.clip(args.clip or asset.rig.clips[0].name)
    times = np.linspace(clip.start, clip.end, args.count).tolist()
    if args.file.suffix.startswith(".usd"):
        name, theirs = "UsdSkel", pose_by_usdskel(args.file, clip.name, times)
    else:
        name, theirs = "three.js", pose_by_three(args.file, clip.name, times, args.node)
    ours = pose_by_us(asset, clip.name, times)
    height = float(np.ptp(np.concatenate(ours)[:, 1]))
    each = [farthest(a, b) / height for a, b in zip(ours, theirs, strict=True)]
    worst = int(np.argmax(each))
    psnr = picture_error(asset, clip.name, times[worst], theirs[worst])
    print(
        f"{args.file.name}, {clip.name}, {len(times)} times: {name} and we differ by at most "
        f"{max(each):.1e} of the height; pictures of the worst time by {psnr:.1f} dB"
    )


if __name__ == "__main__":
    main()
