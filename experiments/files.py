"""What codecs, quantisation and compression cost: bytes, and dB against the heavy asset.

    python -m experiments.files [--assets relic,chess_king,spot] [--steps 200] [--triangles 4000]
    python -m experiments.files --table

Each asset is simplified once; the result is written in every way, read back and compared (6 views,
256 pixels). Results are appended to ``out/files/results.json`` row by row; a row that is there with
the same settings is not made again. KTX 2.0 needs an encoder on the path, and is left out without
one. Needs ``../shared/judge/references`` for all assets but relic.
"""

from __future__ import annotations

import argparse
from functools import cache
from typing import TYPE_CHECKING

from experiments.common import OUT as RESULTS
from experiments.common import Kept, source_of

if TYPE_CHECKING:
    from pathlib import Path

    from appearance_opt.asset import Asset, FileOptions

OUT = RESULTS / "files"
WAYS = {
    "png": {},
    "png, quantised": {"quantize": True},
    "png, quantised, meshopt": {"quantize": True, "compress": "meshopt"},
    "jpeg": {"textures": "jpeg"},
    "webp": {"textures": "webp"},
    "webp:90": {"textures": "webp:90"},
    "ktx2": {"textures": "ktx2"},
    "--for web": {"target": "web"},
}


def options_of(way: str, path: Path) -> FileOptions | None:
    """How to write in a way; None if what writes it is not installed."""
    from appearance_opt.asset import ktx2
    from appearance_opt.options.files import OutputOptions

    if "ktx2" in way and ktx2.encoder() is None:
        return None
    return OutputOptions(**WAYS[way]).for_file(path)  # type: ignore[arg-type]


def result_of(asset: str, settings: dict) -> Path:
    """The asset simplified, without loss in its file; made when it is first asked for."""
    import appearance_opt

    out = OUT / f"{asset}_{settings['triangles']}_{settings['steps']}.glb"
    if not out.is_file():
        out.parent.mkdir(parents=True, exist_ok=True)
        values = appearance_opt.simplify_options("draft", **settings)
        appearance_opt.simplify(reference_of(asset), out, values)
    return out


@cache
def reference_of(asset: str) -> Asset:
    """The heavy asset."""
    from appearance_opt.asset import load

    return load(source_of(asset))


def measure(asset: str, way: str, settings: dict) -> dict:
    """One row."""
    import appearance_opt
    from appearance_opt.asset import load, save

    plain = result_of(asset, settings)
    path = (
        OUT / f"{asset}_{way.strip('-').replace(' ', '_').replace(':', '_').replace(',', '')}.glb"
    )
    options = options_of(way, path)
    assert options is not None
    save(load(plain), path, options)
    values = {"views": 6, "resolution": 256}
    metrics = appearance_opt.compare(reference_of(asset), path, **values).metrics
    return {"bytes": path.stat().st_size, "psnr": metrics.psnr_covered}


def table(rows: list[dict]) -> str:
    """Markdown: bytes as shares of PNG's, and dB less than it."""
    assets = list(dict.fromkeys(r["asset"] for r in rows))
    lines = ["| written as | " + " | ".join(assets) + " |", "|---|" + "---|" * len(assets)]
    of = {(r["asset"], r["way"]): r for r in rows}
    for way in WAYS:
        cells = []
        for asset in assets:
            row, plain = of.get((asset, way)), of.get((asset, "png"))
            if row is None or plain is None:
                cells.append("")
                continue
            share = f"{100 * row['bytes'] / plain['bytes']:.1f} %, {row['bytes'] / 1e6:.2f} MB"
            loss = plain["psnr"] - row["psnr"]
            cells.append(
                f"{share}, {row['psnr']:.2f} dB" if way == "png" else f"{share}, {loss:+.2f}"
            )
        lines.append(f"| {way} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--assets", default="relic,chess_king,spot")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--triangles", type=int, default=4000)
    parser.add_argument("--table", action="store_true", help="only print what is there")
    args = parser.parse_args()
    kept = Kept(OUT / "results.json")
    if not args.table:
        settings = {"steps": args.steps, "triangles": args.triangles}
        for asset in args.assets.split(","):
            for way in (w for w in WAYS if options_of(w, OUT / "any.glb") is not None):
                key = {"asset": asset, "way": way, **settings}
                kept.row(key, lambda a=asset, w=way: measure(a, w, settings))
    print(table(kept.rows))


if __name__ == "__main__":
    main()
