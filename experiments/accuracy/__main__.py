"""Tables of the accuracy of every stage, as Markdown on standard output.

python -m experiments.accuracy                 # functions, physics, textures
python -m experiments.accuracy --images        # and our image against Mitsuba's, on ../shared/assets
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from appearance_opt import backend
from experiments import mitsuba_peer
from experiments.common import asset

if TYPE_CHECKING:
    from pathlib import Path

HELMET = "flight_helmet/FlightHelmet.gltf"
MODELS = (("spot/spot.obj", False), (HELMET, False), (HELMET, True))
"""Published models, and whether they are drawn with their normal maps."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", action="store_true")
    arguments = parser.parse_args()
    models = [(asset(name), mapped) for name, mapped in MODELS] if arguments.images else []
    backend.select("cpu")
    functions()
    physics_tables()
    texture_tables()
    if models:
        image_table(models)


def functions() -> None:
    from experiments.accuracy.stages import lines

    print("| function | domain | largest relative error | mean |\n|---|---|---|---|")
    for r in lines():
        print(f"| `{r.function}` | {r.domain} | {r.largest:.1e} | {r.mean:.1e} |")


def physics_tables() -> None:
    from experiments.accuracy import physics

    cosines = (0.05, 0.3, 0.7, 1.0)
    print("\n| white, roughness | " + " | ".join(f"viewer's cosine {c}" for c in cosines) + " |")
    print("|---|" + "---|" * len(cosines))
    for metalness, name in ((1.0, "metal"), (0.0, "dielectric")):
        for roughness in (0.08, 0.3, 0.6, 1.0):
            values = (physics.albedo(1.0, roughness, metalness, c) for c in cosines)
            print(f"| {name}, {roughness} | " + " | ".join(f"{v:.4f}" for v in values) + " |")
    print(f"\nReciprocity: largest relative difference {physics.reciprocity():.1e}.\n")
    print("| roughness | integral of D(h) n.h |\n|---|---|")
    for roughness in (0.0, 0.08, 0.2, 0.5, 1.0):
        print(f"| {roughness} | {physics.normalisation(roughness):.5f} |")
    print("\n| x | tone map | exact |\n|---|---|---|")
    for x, ours, exact in physics.tone_map_corners():
        print(f"| {x:g} | {ours:.9g} | {exact:.9g} |")


def texture_tables() -> None:
    from experiments.accuracy import textures

    print("\n| lookup | texture | largest difference |\n|---|---|---|")
    for size in ((64, 64), (37, 5), (1, 1), (1, 256)):
        for wrap in textures.WRAPS:
            print(
                f"| bilinear, {wrap} | {size[0]} x {size[1]} | {textures.bilinear(size, wrap):.1e} |"
            )
    for size in ((64, 64), (256, 64)):
        print(f"| mip levels | {size[0]} x {size[1]} | {max(textures.levels(size)):.1e} |")
    print(f"| trilinear | 64 x 64 | {textures.trilinear((64, 64)):.1e} |")


def image_table(models: list[tuple[Path, bool]]) -> None:
    from experiments.accuracy.images import compare

    mitsuba_peer.register()
    print("\n| model | PSNR | pixels that differ by more than 2 / 255 |\n|---|---|---|")
    for path, normal_maps in models:
        result = compare(path, normal_maps=normal_maps)
        name = f"{path.stem}, with normal maps" if normal_maps else path.stem
        print(f"| {name} | {result.psnr:.1f} dB | {100 * result.differing:.2f} % |")


if __name__ == "__main__":
    main()
