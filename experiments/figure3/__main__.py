"""Shape and normal map of a grey, diffuse, closed mesh, from a sphere and from a decimated mesh.

    python -m experiments.figure3 [--assets relic,relic_body,chess_king] [--starts sphere,decimate] [--budget 65]
    python -m experiments.figure3 --table

Each asset is stripped of its material (grey 0.5, roughness 1, no metalness, no normal map): what is
left is its geometry. "sphere": 3,000 triangles, grown from a sphere; nothing of the reference but
its images is used. "decimate": 9,000 triangles, decimated, with the closed-form normal map. Then
the closed-form baker's figure on the meshes that the fit found, with the same texture coordinates,
and for "decimate" also on the decimated mesh itself. "relic_body" is the embedded urn without its
handles: a sphere has none to offer. Views: 16 of 384 x 384 from random sides under random point
lights, which no fit saw. Results are kept row by row in ``out/figure3/results.json``. Needs
``../shared/judge/references`` for chess_king.
"""

from __future__ import annotations

import argparse
import json

from experiments.common import OUT, Kept, isolated, source_of

FOLDER = OUT / "figure3"
TRIANGLES = {"sphere": 3000, "decimate": 9000}
WITHOUT = {"relic_body": ("relic", ["handles"])}
"""Assets that are another one without some of its meshes."""

TARGETS = {"sphere": 27.0, "decimate": 31.0}
"""dB that we want; the paper has 24.96 and 28.30 on meshes of its own."""

VIEWS, RESOLUTION = 16, 384

FIT = """
import json, sys
import appearance_opt as a
from appearance_opt.asset.types import Asset, Material, Mesh
from appearance_opt.jobs.compare import compare
source, stem, o = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
grey = Material(base_color=(0.5, 0.5, 0.5), roughness=1.0, metalness=0.0)
asset = a.load(source)
meshes = [m for m in asset.meshes if m.name not in o["without"]]
asset = Asset(tuple(Mesh(m.positions, m.faces, m.normals, material=grey) for m in meshes), asset.name)
a.save(asset, stem + "_reference.glb")
options = a.simplify_options(o.pop("preset"), triangles=o.pop("triangles"), init=o.pop("init"), **o["common"])
result = a.simplify(asset, stem + ".glb", options)
a.save(result.start, stem + "_start.glb")
closed = {}
for name in ("start", "result"):
    low = a.load(stem + ("_start.glb" if name == "start" else ".glb"))
    bake = a.bake_options(closed_form=True, texture_size=options.texture.size)
    try:
        closed[name] = a.bake(asset, low, stem + "_" + name + "_closed.glb", bake).asset
    except a.InputError as error:  # a baker needs a light mesh that lies near the heavy one
        print(error, file=sys.stderr)
names = ("psnr_covered", "psnr", "flip", "silhouette_shift")
def scores(x):
    if x is None:
        return None
    m = compare(asset, x, views=o["views"], resolution=o["resolution"]).metrics
    return {n: getattr(m, n) for n in names}
print(json.dumps({"seconds": result.seconds, "steps": result.fit.steps, "triangles": result.triangles,
                  "source_triangles": asset.triangle_count,
                  "start": scores(result.start), "result": scores(result.asset),
                  "closed_start": scores(closed.get("start")), "closed_result": scores(closed.get("result"))}))
"""


def row(asset: str, start: str, preset: str, common: dict) -> dict:
    """One fit and its closed-form bakes."""
    values = {"preset": preset, "init": start, "triangles": TRIANGLES[start], "common": common}
    source, without = WITHOUT.get(asset, (asset, []))
    values |= {"views": VIEWS, "resolution": RESOLUTION, "without": without}
    return isolated(
        FIT, str(source_of(source)), str(FOLDER / f"{asset}_{start}"), json.dumps(values)
    )


def cell(scores: dict | None) -> str:
    """PSNR over covered pixels and over whole images, FLIP, silhouette shift."""
    if scores is None:
        return "refused"
    decibels = f"{scores['psnr_covered']:.2f} / {scores['psnr']:.2f}"
    return f"{decibels} / {scores['flip']:.4f} / {scores['silhouette_shift']:.3f}"


def table(rows: list[dict]) -> str:
    """Markdown."""
    lines = [
        "| asset | start | closed form on the start | fitted | closed form on the fitted shape | goal | s, steps |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        lines.append(
            f"| {r['asset']}, {r['source_triangles']} | {r['init']}, {r['triangles']} | {cell(r['closed_start'])} | "
            f"{cell(r['result'])} | {cell(r['closed_result'])} | {TARGETS[r['init']]:.0f} | "
            f"{r['seconds']['total']:.0f}, {r['steps']} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--assets", default="relic,relic_body,chess_king,spot")
    parser.add_argument("--starts", default=",".join(TRIANGLES))
    parser.add_argument("--preset", default="default")
    parser.add_argument("--budget", type=float)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--table", action="store_true")
    a = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    kept = Kept(FOLDER / "results.json")
    common = {n: v for n, v in (("budget", a.budget), ("steps", a.steps)) if v is not None}
    for asset in a.assets.split(",") if not a.table else ():
        for start in a.starts.split(","):
            key = {"asset": asset, "init": start, "preset": a.preset, "common": common}
            print(
                table(
                    [
                        kept.row(
                            key,
                            lambda asset=asset, start=start: row(asset, start, a.preset, common),
                        )
                    ]
                ),
                flush=True,
            )
    print(table(kept.rows))


if __name__ == "__main__":
    main()
