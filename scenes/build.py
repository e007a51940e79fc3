"""Write a scene to a file: ``python -m scenes.build NAME OUT [--triangles N] [--texture-size
N]``."""

from __future__ import annotations

import argparse
import inspect
import sys
from collections.abc import Callable, Sequence

from appearance_opt.asset import Asset, save
from appearance_opt.errors import InputError
from scenes import analytic
from scenes.creature import creature
from scenes.relic import relic

SCENES: dict[str, Callable[..., Asset]] = {
    "relic": relic,
    "creature": creature,
    "furnace": analytic.furnace,
    "checker": analytic.checker,
    "torus": analytic.torus,
    "two_materials": analytic.two_materials,
    "double_sheet": analytic.double_sheet,
    "bumpy_sphere": analytic.bumpy_sphere,
}


def build(name: str, **options: int | None) -> Asset:
    """The scene ``name``; options that are None keep the scene's own value. Raises InputError for
    an unknown scene, an option that it does not have, or a value that is not positive."""
    if name not in SCENES:
        raise InputError(f"no scene '{name}'; there are {', '.join(SCENES)}")
    scene = SCENES[name]
    given = {key: value for key, value in options.items() if value is not None}
    for key, value in given.items():
        if key not in inspect.signature(scene).parameters:
            raise InputError(f"scene '{name}' has no {key.replace('_', ' ')} to choose")
        if value <= 0:
            raise InputError(f"{key.replace('_', ' ')} must be positive, not {value}")
    return scene(**given)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m scenes.build", description="Write a procedural scene to a file."
    )
    parser.add_argument("name", nargs="?", help="the scene")
    parser.add_argument("out", nargs="?", help="the file to write (.glb, .gltf, .obj, .usd*)")
    parser.add_argument("--triangles", type=int, help="about this many triangles")
    parser.add_argument("--texture-size", type=int, help="texels across the largest texture")
    parser.add_argument("--list", action="store_true", help="list the scenes")
    options = parser.parse_args(arguments)
    if options.list:
        for name, scene in SCENES.items():
            print(f"{name:14} {' '.join((inspect.getdoc(scene) or '').split()).split('. ')[0]}")
        return 0
    if options.name is None or options.out is None:
        parser.error("give a scene and a file to write, or --list")
    try:
        asset = build(options.name, triangles=options.triangles, texture_size=options.texture_size)
        save(asset, options.out)
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{options.out}: {asset.triangle_count} triangles, {len(asset.meshes)} meshes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
