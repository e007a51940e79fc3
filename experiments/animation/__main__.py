"""Light characters against heavy ones, over frames that no fit has seen.

    python -m experiments.animation [--rows human:3244,...] [--steps 100] [--resolution 256]
    python -m experiments.animation --table

Each row has some candidates: ``animate`` (at most 4 bones per vertex, fitted on every other frame
of one clip), the same with the whole support of 8, our own ``simplify`` of the bind pose with
transferred weights (4 per vertex, as many steps), and gltfpack (``-si``, skins kept; needs node
and the npm package gltfpack, in ``--node FOLDER`` or on the path; left out without them). All are
read back from their files and measured at the frames between those of the fit, over another clip,
and at rest: 2 views of each frame that nothing was chosen by. Results are kept row by row in
``out/animation/results.json``; ``out/animation/NAME.png`` shows frames of the heavy character,
every candidate beside it.
"""

from __future__ import annotations

import argparse
import subprocess
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from experiments.common import OUT as RESULTS
from experiments.common import Kept, asset, source_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.asset.types import Asset
    from experiments.animation.measure import Take

OUT = RESULTS / "animation"
INFLUENCES, SUPPORT = 4, 8
MOST_FRAMES, VIEWS = 4, 2
"""Frames of a clip that are measured, and views of each."""


class Row:
    """A character, how many triangles it may have, the clip of the fit and another one; ``dense``:
    is the fit with the whole support measured, too?"""

    def __init__(
        self,
        name: str,
        triangles: int,
        clips: tuple[str, str],
        init: str = "decimate",
        dense: bool = False,
    ) -> None:
        self.name, self.triangles, self.init, self.dense = name, triangles, init, dense
        self.seen, self.unseen = clips

    @property
    def label(self) -> str:
        """As ``--rows`` names it."""
        sphere = ":sphere" if self.init == "sphere" else ""
        return f"{self.name}:{self.triangles}{sphere}"

    def source(self) -> Path:
        """The heavy character."""
        if self.name == "creature":
            return source_of(self.name)
        return asset({"human": "human/human.glb", "fox": "fox/Fox.glb"}[self.name])


ROWS = (
    Row("human", 3244, ("walk", "zombie"), dense=True),
    Row("human", 1082, ("walk", "zombie")),
    Row("creature", 3600, ("walk", "look")),
    Row("fox", 288, ("Walk", "Run"), dense=True),
    Row("fox", 400, ("Walk", "Run"), init="sphere"),
)


def fit_animated(row: Row, out: Path, settings: dict, influences: int) -> None:
    """The job that is measured: every other frame of the first clip."""
    import appearance_opt

    values = {**settings, "triangles": row.triangles, "init": row.init, "clip": row.seen}
    values |= {"influences": influences, "support": SUPPORT, "frames": "::2"}
    appearance_opt.animate(row.source(), out, **values)


def simplify_at_rest(row: Row, out: Path, settings: dict) -> None:
    """What users of a static tool get: the bind pose simplified, weights of the closest point."""
    import appearance_opt
    from appearance_opt.asset.batch import Batch
    from appearance_opt.asset.rig import Skin
    from appearance_opt.initial.influences import transfer_influences
    from appearance_opt.latent.skinning import prune
    from appearance_opt.stages.animation import anchored

    heavy, rig = anchored(appearance_opt.load(row.source(), keep_rig=True))
    still = tuple(replace(m, skin=None) for m in heavy.meshes)
    bind = replace(heavy, rig=None, nodes=(), meshes=still)
    light = appearance_opt.simplify(bind, None, triangles=row.triangles, **settings).asset
    skins = [m.skin for m in heavy.meshes if m.skin is not None]
    widest = max(s.bones.shape[1] for s in skins)

    def joined(name: str):
        arrays = [getattr(s, name) for s in skins]
        return np.concatenate([np.pad(a, ((0, 0), (0, widest - a.shape[1]))) for a in arrays])

    batch, whole = Batch(heavy.meshes), Skin(joined("bones"), joined("weights"))
    meshes = []
    for m in light.meshes:
        assert m.normals is not None
        skin = transfer_influences(
            m.positions, m.normals, batch.joined("positions"), batch.faces, whole,
            len(rig.bone_nodes),
        )  # fmt: skip
        meshes.append(replace(m, skin=prune(skin, INFLUENCES)))
    light = replace(light, meshes=tuple(meshes), rig=rig, nodes=(), contents=heavy.contents)
    appearance_opt.save(light, out)


def gltfpack(row: Row, out: Path, node: Path | None, aggressive: bool) -> bool:
    """The same file by gltfpack; False if there is none. Nothing is quantised."""
    heavy = _triangles(row.source())
    command = ["gltfpack"] if node is None else ["node", str(node / "node_modules/gltfpack/cli.js")]
    command += ["-i", str(row.source()), "-o", str(out), "-noq", "-kn", "-se", "1"]
    command += ["-si", f"{row.triangles / heavy:.6f}", "-sv", *(["-sa"] if aggressive else [])]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except FileNotFoundError:
        return False
    return out.is_file()


def _triangles(path: Path) -> int:
    import appearance_opt

    return appearance_opt.load(path).triangle_count


def candidates(row: Row, settings: dict, node: Path | None) -> dict[str, Path]:
    """The files of a row by candidate; those that are there are not made again."""
    stem = f"{row.label.replace(':', '_')}_{settings['steps']}_{settings['resolution']}"
    makers: dict[str, Callable[[Path], object]] = {
        "animate": lambda p: fit_animated(row, p, settings, INFLUENCES)
    }
    if row.init == "decimate":
        makers["simplify at rest"] = lambda p: simplify_at_rest(row, p, settings)
        makers["gltfpack"] = lambda p: gltfpack(row, p, node, False)
        makers["gltfpack -sa"] = lambda p: gltfpack(row, p, node, True)
    if row.dense:
        makers["8 bones"] = lambda p: fit_animated(row, p, settings, SUPPORT)
    out = {}
    for name, make in makers.items():
        path = OUT / f"{stem}_{name.replace(' ', '_')}.glb"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            print(f"{row.label}: {name}", flush=True)
            make(path)
        if path.is_file():
            out[name] = path
    return out


def takes_of(heavy: Asset, row: Row, resolution: int) -> dict[str, list[Take]]:
    """The heavy character at frames between those of the fit, over the other clip, and at rest."""
    from experiments.animation.measure import take

    assert heavy.rig is not None
    out = {}
    for name, clip in (("seen clip", row.seen), ("other clip", row.unseen)):
        c = heavy.rig.clip(clip)
        last = int(np.floor(c.end * heavy.rig.rate + 1e-3))
        odd = np.arange(1, last + 1, 2)
        chosen = odd[np.unique(np.linspace(0, len(odd) - 1, MOST_FRAMES).round().astype(int))]
        out[name] = take(heavy, clip, (chosen / heavy.rig.rate).tolist(), VIEWS, resolution)
    out["rest"] = take(heavy, None, [0.0], 2 * VIEWS, resolution)
    return out


def run_row(row: Row, settings: dict, node: Path | None) -> dict:
    """Make the candidates of a row and measure them."""
    import appearance_opt
    from experiments.animation.measure import errors, images_of, summary, upright

    files = candidates(row, settings, node)
    heavy = appearance_opt.load(row.source(), keep_rig=True)
    takes = takes_of(heavy, row, settings["resolution"])
    scores: dict[str, dict] = {}
    shown = upright(heavy, takes["seen clip"])
    pictures = {"heavy": [t.images[0] for t in shown]}
    for name, path in files.items():
        light = appearance_opt.load(path, keep_rig=True)
        scores[name] = {"triangles": light.triangle_count}
        scores[name] |= {of: summary(errors(light, at)) for of, at in takes.items()}
        pictures[name] = [images_of(light, t)[0] for t in shown]
    write_sheet(OUT / f"{row.label.replace(':', '_')}.png", pictures)
    return {"scores": scores}


def write_sheet(path: Path, pictures: dict[str, list]) -> None:
    """A picture with a column for each candidate and a row for each frame."""
    from appearance_opt.asset.images import encode_png
    from appearance_opt.evaluate.pictures import picture

    columns = [np.concatenate([picture(i) for i in images]) for images in pictures.values()]
    path.write_bytes(encode_png(np.concatenate(columns, axis=1)))


def table(rows: list[dict]) -> str:
    """Markdown: PSNR in dB over covered pixels."""
    lines = [
        "| character | candidate | triangles | unseen frames: mean (worst to best) | FLIP | "
        "silhouette shift (px) | other clip | at rest |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        for name, s in row["scores"].items():
            seen = s["seen clip"]
            lines.append(
                f"| {row['row']} | {name} | {s['triangles']:,} | {seen['psnr']:.2f} "
                f"({seen['worst']:.2f} to {seen['best']:.2f}) | {seen['flip']:.4f} | "
                f"{seen['shift']:.3f} | {s['other clip']['psnr']:.2f} | {s['rest']['psnr']:.2f} |"
            )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", default=",".join(r.label for r in ROWS))
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--node", type=Path, help="folder with node_modules/gltfpack")
    parser.add_argument("--table", action="store_true", help="only print what is there")
    args = parser.parse_args()
    kept = Kept(OUT / "results.json")
    settings = {"steps": args.steps, "resolution": args.resolution}
    if not args.table:
        for row in (r for r in ROWS if r.label in args.rows.split(",")):
            key = {"row": row.label, **settings}
            kept.row(key, partial(run_row, row, settings, args.node))
    print(table(kept.of(settings)))


if __name__ == "__main__":
    main()
