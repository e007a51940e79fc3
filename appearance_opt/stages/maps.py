"""The maps of a bake: which are made, which of them are fitted, and the mesh that bears them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.baking.closed_form import FIELDS, Settings
from appearance_opt.baking.encode import material_change
from appearance_opt.baking.target_mesh import with_material

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.config import BakeOptions
    from appearance_opt.stages.pair import Pair

FITTED = ("red", "green", "blue", "roughness", "metalness", "normal_x", "normal_y", "normal_z")
"""Channels that a fit may move."""


def fitted_parts(options: BakeOptions, unlit: bool) -> tuple[str, ...]:
    """What the fit moves: parts that are written. Colour and roughness are fitted together or not
    at all; of what is ``unlit``, images show the colour alone."""
    wants = options.baking.wants
    if unlit:
        written = {"normal": False, "material": wants("base-color")}
    else:
        written = {"normal": wants("normal"), "material": wants("base-color") and wants("orm")}
    return () if options.baking.closed_form else tuple(p for p in options.fit.parts if written[p])


def bake_settings(pair: Pair, options: BakeOptions) -> Settings:
    """What the closed form bakes for the maps that are asked for. Notes what cannot be had."""
    o = options.baking
    wanted = {n for n in FIELDS if o.wants(n)}
    if not pair.survey.emits and "emission" in wanted:
        wanted.remove("emission")
        if "emission" in o.maps:
            pair.notes.append("HIGH emits no light: there is no emission map")
    if o.wants("base-color") or o.wants("orm"):
        wanted.add("material")
    if fitted_parts(options, pair.subject.unlit):
        wanted |= {"material", "normal"}
    return Settings(
        options.texture.size,
        tuple(n for n in FIELDS if n in wanted),
        o.samples,
        pair.cage,
        o.hit,  # type: ignore[arg-type]
        o.ao_rays,
        float("inf") if o.ao_distance is None else o.ao_distance / pair.scale,
    )


def in_metres(maps: Mapping[str, NDArray], scale: float) -> dict[str, NDArray[np.float32]]:
    """The same maps, lengths in metres; ``scale``: metres per unit."""
    factors = {"displacement": scale, "curvature": 1 / scale}
    return {n: v * np.float32(factors[n]) if n in factors else v for n, v in maps.items()}


def with_maps(pair: Pair, maps: Mapping[str, NDArray], options: BakeOptions) -> Asset:
    """LOW with the ``maps`` (lengths in metres) that are asked for, and what of it was left
    alone."""
    change = material_change({**maps}, options.baking, pair.subject.unlit)
    asset = with_material(pair.low.asset, change)
    if options.baking.wants("base-color"):
        # the map holds the whole colour: vertex colours would tint it again
        asset = replace(asset, meshes=tuple(replace(m, colors=None) for m in asset.meshes))
    return pair.low_parts.with_kept(replace(asset, notes=()))


def has_place(out: Path, options: BakeOptions) -> bool:
    """Does the format of ``out`` have a place for all of the maps that are asked for?"""
    o = options.baking
    return not (
        o.wants("object-normal")
        or o.wants("curvature")
        or o.green == "directx"
        or (o.wants("ao") and not o.wants("orm"))
        or (o.wants("displacement") and out.suffix.lower() == ".obj")
    )
