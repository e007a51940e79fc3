"""The pairs of meshes that are baked, and Blender's maps as a material of ours."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from experiments.common import OUT as RESULTS

if TYPE_CHECKING:
    from pathlib import Path

    from appearance_opt.asset.types import Mesh

OUT = RESULTS / "baking"
ROWS = {"chess_king": 4864, "flight_helmet": 2820, "relic": 8182}
"""Triangles of LOW by asset."""

SIZE = 1024
"""Texels of a map along a side."""


def make_low(source: Path, triangles: int, path: Path) -> None:
    """Decimated and unwrapped, no material."""
    from appearance_opt import save
    from appearance_opt.asset import load
    from appearance_opt.asset.types import Asset, Mesh
    from appearance_opt.config import simplify_options
    from appearance_opt.jobs.simplify import simplify

    options = simplify_options("draft", triangles=triangles, steps=0, pool=4, texture_size=SIZE)
    low = simplify(load(source), None, options).start.meshes[0]
    bare = Mesh(low.positions, low.faces, low.normals, low.uvs, low.tangents, name="low")
    save(Asset((bare,), "low"), path)


def maps_of_blender(mesh: Mesh, folder: Path) -> Mesh:
    """A mesh with the maps that blender_bake.py has written to ``folder``."""
    from appearance_opt.asset.types import Material, Texture

    maps = {
        n: np.load(folder / f"{n}.npy") for n in ("normal", "base_color", "roughness", "metalness")
    }
    byte = {n: np.round(m / 257).astype(np.uint8) for n, m in maps.items()}
    orm = np.stack(
        [
            np.full((SIZE, SIZE), 255, np.uint8),
            byte["roughness"][..., 0],
            byte["metalness"][..., 0],
        ],
        -1,
    )
    clamp = ("clamp", "clamp")
    material = Material(
        roughness=1.0,
        metalness=1.0,
        base_color_texture=Texture(byte["base_color"], "srgb", clamp),
        orm_texture=Texture(orm, "linear", clamp),
        normal_texture=Texture(byte["normal"], "linear", clamp),
    )
    return replace(mesh, material=material)
