"""Which parts a latent has."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.latent.displacement import DISPLACEMENT, Height, Tessellation
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.opacity import Opacity
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.parts import Pose
from appearance_opt.latent.positions import Positions
from appearance_opt.latent.skinning import SkinWeights
from appearance_opt.latent.texels import NORMALS, OPACITY, Texels
from appearance_opt.render.material import CHANNELS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from appearance_opt.asset.rig import Skin
    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.latent.parts import Part
    from appearance_opt.latent.skinning import BoneFrames


def latent_of(
    mesh: LatentMesh,
    maps: Mapping[str, NDArray | float],
    fit: Iterable[str] = (),
    rates: Rates | None = None,
    levels: tuple[int, ...] = (0,),
    skinned: tuple[Skin, BoneFrames] | None = None,
) -> Latent:
    """A mesh with maps, of which what is named in ``fit`` is fitted: any of "shape", "normal",
    "material", "opacity" and "displacement".

    ``maps``: natural values of every map, channel name -> (size, size), or a number for a channel
    that is constant. With an image "opacity" the mesh is seen through, and drawn layer by layer. The
    map "displacement" has a size of its own; with it, or with ``levels``
    other than (0,), the mesh is drawn tessellated, at one of ``levels`` at a time, at first at the
    last of them. ``skinned``: weights of the vertices, fitted with the "shape", and what the bones
    do in the frames of an animation, each of which is a pose.
    """
    wanted = frozenset(fit)
    images = {n: np.asarray(maps[n]) for n in CHANNELS if n in maps and np.ndim(maps[n])}
    constants = {n: float(v) for n, v in maps.items() if not np.ndim(v) and n != OPACITY}
    parts: list[Part] = [Positions(mesh, "shape" in wanted)]
    if DISPLACEMENT in maps:
        image = np.asarray(maps[DISPLACEMENT])
        parts.append(Height(mesh, levels, image, DISPLACEMENT in wanted))
    elif any(levels):
        parts.append(Tessellation(mesh, levels))
    poses = tuple(Pose(level) for level in levels)
    if skinned is not None:
        skin, frames = skinned
        parts.append(SkinWeights(skin, frames, "shape" in wanted))
        poses = tuple(Pose(0, dr.opaque(mi.UInt32, k)) for k in range(frames.count))
    for fitted in (True, False):
        group = {n: v for n, v in images.items() if (_group(n) in wanted) == fitted}
        if group:
            parts.append(Texels(group, fitted))
    if OPACITY in maps:
        parts.append(Opacity(np.atleast_2d(maps[OPACITY]), OPACITY in wanted))
    latent = Latent(mesh, tuple(parts), constants, poses)
    latent.set_rates(rates or Rates())
    return latent


def _group(channel: str) -> str:
    """The word of ``fit`` that a channel belongs to."""
    return "normal" if channel in NORMALS else "material"
