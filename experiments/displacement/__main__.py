"""Division of labour: what do a normal map, a displacement map, and both add to 1,000 triangles?

    python -m experiments.displacement [--assets chess_king,flight_helmet,relic] [--budget 60] [--triangles 1000]
    python -m experiments.displacement --table

Per asset, at level 3: the base mesh with a normal map; displacement alone; both; and a mesh of 16
times the base triangles with a normal map, simplified directly. All are judged as they are drawn,
on held-out views. Results are appended to ``out/displacement/results.json`` row by row; a row that
is there with the same settings is not run again. Needs ``../shared/judge/references`` for the first
two assets.
"""

from __future__ import annotations

import argparse
import json

from experiments.common import OUT as RESULTS
from experiments.common import Kept, isolated, source_of

OUT = RESULTS / "displacement"
LEVEL, FACTOR = 3, 16
KINDS: dict[str, dict] = {
    "normal map alone": {},
    "displacement alone": {"displacement": True, "subdivision": (LEVEL,), "normal_map": False},
    "both": {"displacement": True, "subdivision": (LEVEL,)},
    f"{FACTOR} x the triangles": {"factor": FACTOR},
}
SIMPLIFY = """
import json, sys, appearance_opt as a
from appearance_opt.jobs.compare import compare
source, out, values = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
r = a.simplify(source, out, a.simplify_options("default", **values))
m = {n: compare(source, x, views=16).metrics for n, x in (("start", r.start), ("result", r.shown))}
names = ("psnr_covered", "flip", "silhouette_shift", "silhouette_iou")
print(json.dumps({"seconds": r.seconds, "steps": r.fit.steps, "drawn": r.shown.triangle_count,
                  **{k: {n: getattr(v, n) for n in names} for k, v in m.items()}}))
"""


def labour(asset: str, kind: str, triangles: int, common: dict) -> dict:
    """One row."""
    values = {**KINDS[kind], **common}
    values["triangles"] = triangles * values.pop("factor", 1)
    out = OUT / f"{asset}_{kind.replace(' ', '_')}.glb"
    return isolated(SIMPLIFY, str(source_of(asset)), str(out), json.dumps(values))


def table(rows: list[dict]) -> str:
    """Markdown: one line per asset and kind."""
    lines = [
        "| asset | kind | triangles drawn | start: PSNR / FLIP / shift | result: PSNR / FLIP / shift | s, steps |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        cells = [
            f"{s['psnr_covered']:.2f} / {s['flip']:.4f} / {s['silhouette_shift']:.3f}"
            for s in (r["start"], r["result"])
        ]
        lines.append(
            f"| {r['asset']} | {r['kind']} | {r['drawn']} | {cells[0]} | {cells[1]} | "
            f"{r['seconds']['total']:.0f}, {r['steps']} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--assets", default="chess_king,flight_helmet,relic")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--triangles", type=int, default=1000)
    parser.add_argument("--budget", type=float, default=60.0)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--table", action="store_true")
    a = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    kept = Kept(OUT / "results.json")
    common = {"budget": a.budget} if a.steps is None else {"steps": a.steps}
    for asset in a.assets.split(",") if not a.table else ():
        for kind in a.kinds.split(","):
            key = {"asset": asset, "kind": kind, "base": a.triangles, "common": common}
            row = kept.row(
                key, lambda asset=asset, kind=kind: labour(asset, kind, a.triangles, common)
            )
            print(table([row]).splitlines()[2], flush=True)
    print(table(kept.rows))


if __name__ == "__main__":
    main()
