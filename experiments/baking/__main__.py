"""Closed-form bake against Blender's Cycles bake, and the fitted bakes against the closed form.

    python -m experiments.baking --blender BPY/bin/python [--rows chess_king,...] [--preset default] [--table]
    python -m experiments.baking --joint [--rows chess_king,...]

BPY is a virtual environment of its own, for Blender's package wants other versions than ours:

    python3.11 -m venv BPY && BPY/bin/pip install "bpy==4.5.*"

Without --blender, its table stays empty. Pairs: each asset decimated to 2 to 5 % of its triangles
and unwrapped, geometry alone; both bakers get the same two files. The judge is the renderer in
``../shared/judge``, which is not ours. --joint adds a bake whose shape is fitted, too, without any
triangle more (``joint --subdivision 0``), from the same two files. Each stage that is on
disk in ``out/baking`` is not run again (delete the folder to start over); ``--table`` prints the
tables for docs/baking.md from what is there. Times are of the bakes alone, ours with warm kernels.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from pathlib import Path

import numpy as np

from experiments.baking.pairs import OUT, ROWS, SIZE, make_low, maps_of_blender
from experiments.common import judge, needs_judge, source_of

CAGES = (1.0, 1 / 4, 1 / 16)
"""Blender's cages, in units of the reach of our rays."""

METRICS = (("psnr_cov", 2), ("flip", 4), ("sil_shift_px", 3))


def ours(source: Path, low: Path, stem: Path, preset: str, steps: int | None) -> dict:
    """Closed form and fit. Returns times and what was found."""
    from appearance_opt import bake, bake_options

    closed = bake(
        source, low, f"{stem}_closed.glb", bake_options(closed_form=True, texture_size=SIZE)
    )
    again = bake(source, low, None, bake_options(closed_form=True, texture_size=SIZE))
    begin = time.perf_counter()
    fitted = bake(
        source, low, f"{stem}_fitted.glb", bake_options(preset, texture_size=SIZE, steps=steps)
    )
    assert fitted.fit is not None
    return {
        "missed": closed.missed_share,
        "reach": closed.reach,
        "seconds": closed.seconds,
        "seconds_warm": again.seconds,
        "fit_seconds": time.perf_counter() - begin,
        "fit_steps": fitted.fit.steps,
        "curve": [(p.seconds, p.step, p.psnr) for p in fitted.fit.curve],
    }


def with_shape(source: Path, low: Path, stem: Path, preset: str, steps: int | None) -> dict:
    """The bake that moves LOW's vertices, too: the same triangles and texture coordinates."""
    from appearance_opt import joint_options, save
    from appearance_opt.jobs.joint import joint

    options = joint_options(preset, subdivision=(0,), texture_size=SIZE, steps=steps)
    result = joint(source, low, None, options)
    save(result.shown, f"{stem}_joint.glb")
    return {"seconds": result.seconds["total"], "steps": result.fit.steps}


def blender(python: str, source: Path, low: Path, stem: Path, reach: float) -> dict:
    """Blender's bake at the best of several cages: its cage takes the first surface from outside,
    so one that is wide enough for the whole mesh shows neighbouring parts. Best: nearest to ours in
    the mean."""
    script = Path(__file__).with_name("blender_bake.py")
    tried = {}
    for share in CAGES:
        folder = Path(f"{stem}_blender_{share:g}")
        if not (folder / "seconds.json").exists():
            command = [
                python,
                str(script),
                str(source),
                str(low),
                str(folder),
                str(SIZE),
                str(share * reach),
                "4",
            ]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        seconds = json.loads((folder / "seconds.json").read_text())
        apart = angles(Path(f"{stem}_closed.glb"), np.load(folder / "normal.npy"))
        tried[share] = {
            "cage": share * reach,
            "seconds": sum(seconds.values()),
            "seconds_by_map": seconds,
            **apart,
        }
    best = min(tried, key=lambda share: tried[share]["all_mean"])
    blender_asset(stem, Path(f"{stem}_blender_{best:g}"))
    return {**tried[best], "tried": tried, "same_rule": same_rule(source, low, stem, best, reach)}


def same_rule(source: Path, low: Path, stem: Path, share: float, reach: float) -> dict:
    """Blender's normals against ours when our rays are Blender's: to the outermost surface of the
    same cage, from the middle of each texel."""
    from appearance_opt import bake, bake_options

    options = bake_options(
        closed_form=True, texture_size=SIZE, hit="outermost", cage=share * reach, samples=1
    )
    bake(source, low, f"{stem}_outermost.glb", options)
    return angles(Path(f"{stem}_outermost.glb"), np.load(f"{stem}_blender_{share:g}/normal.npy"))


def blender_asset(stem: Path, folder: Path) -> None:
    """Blender's maps on the same mesh with the same frames, as a GLB."""
    from appearance_opt import load, save
    from appearance_opt.asset.types import Asset

    mesh = maps_of_blender(load(f"{stem}_closed.glb").meshes[0], folder)
    save(Asset((mesh,), "blender"), f"{stem}_blender.glb")


def angles(baked: Path, theirs: np.ndarray) -> dict:
    """Degrees between the normal map of a file and one of Blender, over covered texels ("all"), and
    over those whose normal in Blender's map points out of LOW ("outward"). The others show the back
    of a triangle of HIGH, where Blender's ray, unlike ours, stops: no light reaches them."""
    from appearance_opt import load
    from appearance_opt.baking.target_mesh import prepare
    from appearance_opt.baking.texel_points import texel_coverage

    asset = load(baked)
    covered = texel_coverage(prepare(asset).mesh, SIZE)
    texture = asset.meshes[0].material.normal_texture
    assert texture is not None
    vectors = [v[..., :3][covered] * 2.0 - 1 for v in (texture.linear(), theirs / 65535)]
    a, b = (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9) for v in vectors)
    angle = np.degrees(np.arccos(np.clip(np.sum(a * b, axis=1), -1, 1)))
    outward = b[:, 2] > 0
    out = {"inward": float(1 - outward.mean())}
    for name, some in (("all", angle), ("outward", angle[outward])):
        out |= {f"{name}_mean": float(some.mean()), f"{name}_median": float(np.median(some))}
    return out


def run_row(
    asset: str, preset: str, steps: int | None, python: str | None, views: int, free: bool
) -> dict:
    """One asset, all stages."""
    from appearance_opt import backend

    backend.select("cpu")
    OUT.mkdir(parents=True, exist_ok=True)
    stem = OUT / asset
    path = Path(f"{stem}.json")
    row = (
        json.loads(path.read_text())
        if path.exists()
        else {"asset": asset, "triangles": ROWS[asset]}
    )
    source, low = source_of(asset), Path(f"{stem}_low.glb")
    if not low.exists():
        make_low(source, ROWS[asset], low)
    if (row.get("preset"), row.get("steps")) != (preset, steps):
        row.update(ours=ours(source, low, stem, preset, steps), preset=preset, steps=steps)
        row.pop("scores", None)
        path.write_text(json.dumps(row, indent=1))
    if python is not None and "blender" not in row:
        row["blender"] = blender(python, source, low, stem, row["ours"]["reach"])
        row.pop("scores", None)
        path.write_text(json.dumps(row, indent=1))
    if free and row.get("joint", {}).get("asked") != [preset, steps]:
        row["joint"] = {"asked": [preset, steps], **with_shape(source, low, stem, preset, steps)}
        row.pop("scores", None)
        path.write_text(json.dumps(row, indent=1))
    if "scores" not in row or row.get("views") != views:
        names = ["closed", "fitted", *(n for n in ("blender", "joint") if n in row)]
        row.update(
            scores=judge(source, {n: f"{stem}_{n}.glb" for n in names}, stem, views), views=views
        )
        path.write_text(json.dumps(row, indent=1))
    return row


def cell(scores: dict) -> str:
    return " / ".join(f"{scores[m]:.{d}f}" for m, d in METRICS)


def tables(rows: list[dict]) -> str:
    """Markdown."""
    lines = [
        "| asset, triangles | Blender | closed form | degrees apart: mean, median | Blender's inward normals "
        "| degrees, others: mean, median | same rule, others: mean, median | times |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        name = f"{r['asset']}, {r['triangles']}"
        if "blender" not in r:
            continue
        b = r["blender"]
        degrees = [
            ", ".join(f"{of[f'{which}_{k}']:.2f}" for k in ("mean", "median"))
            for of, which in ((b, "all"), (b, "outward"), (b["same_rule"], "outward"))
        ]
        ratio = b["seconds"] / r["ours"]["seconds_warm"]["closed form"]
        lines.append(
            f"| {name} | {cell(r['scores']['blender'])} | {cell(r['scores']['closed'])} | {degrees[0]} | "
            f"{100 * b['inward']:.1f} % | {degrees[1]} | {degrees[2]} | {ratio:.1f} |"
        )
    lines += [
        "",
        "| asset, triangles | closed form | fitted, shape kept | shape fitted, too | gain (dB) | FLIP ratio | steps |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        c = r["scores"]["closed"]
        fits = [r["scores"][n] for n in ("fitted", "joint") if n in r["scores"]]
        cells = [cell(f) for f in fits] + ["not run"] * (2 - len(fits))
        gains = ", ".join(f"{f['psnr_cov'] - c['psnr_cov']:+.2f}" for f in fits)
        flips = ", ".join(f"{f['flip'] / c['flip']:.2f}" for f in fits)
        steps = ", ".join(
            str(n)
            for n in (r["ours"]["fit_steps"], r.get("joint", {}).get("steps"))
            if n is not None
        )
        lines.append(
            f"| {r['asset']}, {r['triangles']} | {cell(c)} | {' | '.join(cells)} | {gains} | {flips} | {steps} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--blender", default=None, metavar="PYTHON")
    parser.add_argument("--rows", default=",".join(ROWS))
    parser.add_argument("--preset", default="default")
    parser.add_argument("--steps", type=int, default=None, help="instead of the preset's time")
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--joint", action="store_true", help="also fit the shape")
    parser.add_argument("--table", action="store_true")
    a = parser.parse_args()
    names = [n for n in a.rows.split(",") if n]
    if a.table:
        found = [OUT / f"{n}.json" for n in names]
        print(
            tables(
                [
                    r
                    for p in found
                    if p.exists()
                    for r in [json.loads(p.read_text())]
                    if "scores" in r
                ]
            )
        )
        return
    needs_judge()
    print(tables([run_row(n, a.preset, a.steps, a.blender, a.views, a.joint) for n in names]))


if __name__ == "__main__":
    main()
