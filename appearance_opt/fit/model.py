"""The latent as the fit sees it: named parameters, and the surface and maps they stand for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.latent.latent import LatentMesh, LatentTopology, local_edge_length
from appearance_opt.latent.parameter import Parameter
from appearance_opt.latent.texels import BOUNDS, TexelCodec
from appearance_opt.render import upload
from appearance_opt.render.material import CHANNELS, MaterialMaps, TexelLayer

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from appearance_opt.render.surface import Surface

NORMAL_CHANNELS = ("normal_x", "normal_y", "normal_z")
POSITIONS, TEXELS = "positions", "texels"


@dataclass(frozen=True)
class Rates:
    """Learning rates at the start of a fit. ``position``: in units of the local edge length;
    the others in the units of their maps (colours: square root of linear)."""

    position: float = 0.01
    normal: float = 0.01
    base_color: float = 0.005
    material: float = 0.005

    def of_channel(self, name: str) -> float:
        """Rate of a texel channel."""
        if name in NORMAL_CHANNELS:
            return self.normal
        return self.base_color if name in ("red", "green", "blue") else self.material


class Model:
    """A latent mesh with maps, of which the parts named in ``fit`` are parameters.

    ``fit``: subset of {"shape", "normal", "material", "gamma"}. ``maps``: natural values of every map the
    latent has, channel name -> (size, size), or a number for a channel that is constant. Maps that
    are not fitted are kept in a layer of their own, without gradients or moments.
    """

    def __init__(
        self, mesh: LatentMesh, maps: Mapping[str, NDArray | float], fit: frozenset[str], rates: Rates
    ) -> None:
        images = {n: np.asarray(maps[n]) for n in CHANNELS if n in maps and np.ndim(maps[n])}
        self.constants = {n: float(v) for n, v in maps.items() if not np.ndim(v)}
        fitted = tuple(n for n in images if _group(n) in fit)
        self.topology = LatentTopology(mesh, tangents="normal_x" in images)
        self.edge_length = local_edge_length(mesh.positions, mesh.faces)
        self.scene = upload.scene_of(mesh.positions, mesh.faces)
        self._scene_parameters = mi.traverse(self.scene)
        self._fixed_positions = mi.Float(np.ascontiguousarray(mesh.positions, np.float32).ravel())
        self.parameters: dict[str, Parameter] = {}
        if "shape" in fit:
            self.parameters[POSITIONS] = Parameter(POSITIONS, mi.Float(self._fixed_positions), 1, mi.Float(0))
        self.codec: TexelCodec | None = None
        if fitted:
            codec = TexelCodec(fitted, len(images[fitted[0]]))
            self.codec = codec
            self.parameters[TEXELS] = Parameter(
                TEXELS,
                codec.encode(images),
                codec.packed,
                mi.Float(0),
                codec.per_channel({n: BOUNDS[n][0] for n in fitted}),
                codec.per_channel({n: BOUNDS[n][1] for n in fitted}),
            )
        self._initial_texels = np.array(self.parameters[TEXELS].value) if fitted else np.empty(0, np.float32)
        self._fixed_layers: tuple[TexelLayer, ...] = ()
        self._fixed_maps = {n: v.astype(np.float32) for n, v in images.items() if n not in fitted}
        if self._fixed_maps:
            names = tuple(self._fixed_maps)
            fixed = TexelCodec(names, len(self._fixed_maps[names[0]]))
            self._fixed_layers = (fixed.layer(fixed.encode(self._fixed_maps)),)
        self.set_rates(rates)

    def set_rates(self, rates: Rates) -> None:
        """Change the learning rates of all parameters."""
        if POSITIONS in self.parameters:
            per_vertex = np.repeat(self.edge_length * rates.position, 3).astype(np.float32)
            self.parameters[POSITIONS].rate = mi.Float(per_vertex)
        if self.codec is not None:
            per_channel = {n: rates.of_channel(n) for n in self.codec.channels}
            self.parameters[TEXELS].rate = self.codec.per_channel(per_channel)

    def positions(self) -> mi.Float:
        """Current flat positions (3 V)."""
        return self.parameters[POSITIONS].value if POSITIONS in self.parameters else self._fixed_positions

    def update_scene(self) -> None:
        """Move the traced mesh to the current positions (rebuilds its BVH)."""
        if POSITIONS in self.parameters:
            self._scene_parameters["mesh.vertex_positions"] = self.positions()
            self._scene_parameters.update()

    def surface(self, positions: mi.Float) -> Surface:
        """Surface at flat positions (3 V), differentiable in them."""
        return self.topology.surface(positions)

    def fitted_layer(self) -> TexelLayer | None:
        """The maps that are parameters, as a fresh pyramid."""
        return self.codec.layer(self.parameters[TEXELS].value) if self.codec is not None else None

    def maps(self, fitted: TexelLayer | None) -> MaterialMaps:
        """All maps, with the given state of the fitted ones."""
        layers = self._fixed_layers if fitted is None else (fitted, *self._fixed_layers)
        return MaterialMaps(layers, self.constants)

    def host_positions(self) -> NDArray[np.float32]:
        """Current positions (V, 3)."""
        return np.array(self.positions()).reshape(-1, 3)

    def host_maps(self) -> dict[str, NDArray[np.float32]]:
        """Current maps in natural units, channel name -> (size, size), fitted or not."""
        out = dict(self._fixed_maps)
        if self.codec is not None:
            out.update(self.codec.to_maps(self.parameters[TEXELS].value))
        return out

    def touched(self, inside: NDArray[np.bool_], known: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(size, size) texels whose values mean something: inside a chart, and either known at the start
        or changed by the fit since."""
        if self.codec is None or known.any():
            return inside & known if known.any() else inside
        texels = np.array(self.parameters[TEXELS].value).reshape(inside.shape[0], inside.shape[1], -1)
        changed = (texels != self._initial_texels.reshape(texels.shape)).any(axis=-1)
        return inside & changed

    def values(self) -> dict[str, mi.Float]:
        """Snapshot of all parameters (arrays are never changed in place, so this copies nothing)."""
        return {name: p.value for name, p in self.parameters.items()}

    def restore(self, values: Mapping[str, mi.Float]) -> None:
        """Back to a snapshot."""
        for name, value in values.items():
            self.parameters[name].value = mi.Float(value)
        dr.eval([p.value for p in self.parameters.values()])
        self.update_scene()


def _group(channel: str) -> str:
    """The part of ``fit`` that a channel belongs to."""
    if channel in NORMAL_CHANNELS:
        return "normal"
    return "gamma" if channel == "gamma" else "material"
