"""What was fitted, as assets in the place and scale of the input, and the files beside a result."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.height import displacement_of, height_png
from appearance_opt.initial.transfer import transfer_emission
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.displacement import DISPLACEMENT, Height
from appearance_opt.latent.export import to_asset
from appearance_opt.stages.fitting import clean_maps
from appearance_opt.stages.plain import flatten_maps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.rig import Skin
    from appearance_opt.asset.types import Asset, Credits
    from appearance_opt.config import CommonOptions
    from appearance_opt.latent.latent import Latent
    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.placement import Placement
    from appearance_opt.reference.subject import Subject
    from appearance_opt.stages.start import Start


BAKED = "baked into the base colours, with shadows and reflections: that of the reference"
"""What a file says of its light where that of the reference stands still."""


@dataclass(frozen=True)
class Exported:
    """``asset``: what was fitted; ``start``: the same before the fit, as it was drawn; ``levels``:
    with a displacement map, the mesh as drawn at each tessellation level."""

    asset: Asset
    start: Asset
    levels: dict[int, Asset]


def export(
    model: Latent, start: Start, subject: Subject, options: CommonOptions, exporter: Exporter
) -> Exported:
    """A fitted model: its maps cleaned, what the reference emits transferred, and maps whose
    variation nobody sees made numbers."""
    initial = latent_of(start.mesh, start.maps, levels=start.levels[-1:])
    begin = exporter.drawn(initial, start.maps)[initial.pose.level]
    maps = clean_maps(model, start.known)
    if subject.survey is not None:
        maps |= transfer_emission(subject.survey, model.posed_mesh(), options.texture.size)
    maps = flatten_maps(model, maps, start, subject, options)
    levels = exporter.drawn(model, maps) if options.displacement.fitted else {}
    return Exported(exporter.base(model, maps), begin, levels)


def with_lighting(like: Asset, subject: Subject) -> Asset:
    """What a result takes its credits from, which say what light is baked in, if any is."""
    if not subject.static_light:
        return like
    return replace(like, credits=replace(like.credits, lighting=BAKED))


class Exporter:
    """Assets of a displaced model, in the place and scale of the input ``like`` which they are,
    with its nodes and its credits. ``placement``: of the model in the world; ``skin``: of its
    vertices, if it has one."""

    def __init__(
        self, placement: Placement, like: Asset, name: str, skin: Skin | None = None
    ) -> None:
        self.placement, self.like, self.name = placement.relative_to(like.origin), like, name
        self.skin = skin

    def base(self, model: Latent, maps: dict) -> Asset:
        """The base mesh, its maps, and the displacement map in metres."""
        asset = self._asset(model.mesh, model.host_positions(), maps, self.name)
        height = model.part(Height)
        if height is None:
            return asset
        heights = height.export()[DISPLACEMENT]
        displacement = displacement_of(heights * np.float32(self.placement.scale))
        meshes = (
            replace(m, material=replace(m.material, displacement=displacement))
            for m in asset.meshes
        )
        return replace(asset, meshes=tuple(meshes))

    def drawn(self, model: Latent, maps: dict) -> dict[int, Asset]:
        """The mesh as it is drawn at each tessellation level."""
        out = {}
        for pose in model.poses:
            mesh, name = model.posed_mesh(pose), f"{self.name}_level{pose.level}"
            out[pose.level] = self._asset(mesh, mesh.positions, maps, name)
        return out

    def _asset(self, mesh: LatentMesh, positions: NDArray, maps: dict, name: str) -> Asset:
        like, world = self.like, self.placement.to_world(positions)
        asset = to_asset(mesh, world, maps, name, self.skin)
        meshes = (
            m if m.node is None else replace(m, name=like.nodes[m.node].name + m.name[len(name) :])
            for m in asset.meshes
        )
        return replace(
            asset,
            meshes=tuple(meshes),
            origin=like.origin,
            nodes=like.nodes,
            credits=_credits(like),
        )


OURS = "appearance_opt"
"""Key of what we say of a result in the extras of its file."""


def _credits(like: Asset) -> Credits:
    """Those of an asset, without what an earlier run has said of it: that is true no more."""
    extras = like.credits.extras
    if not isinstance(extras, dict) or OURS not in extras:
        return like.credits
    return replace(like.credits, extras={k: v for k, v in extras.items() if k != OURS} or None)


def write_companion(asset: Asset, out: Path) -> None:
    """The displacement map as ``<stem>_displacement.png`` for a format that has no place for its
    name."""
    displacement = asset.meshes[0].material.displacement
    if displacement is not None and out.suffix.lower() == ".obj":
        out.with_name(f"{out.stem}_displacement.png").write_bytes(height_png(displacement))
