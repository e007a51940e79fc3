"""The latent as the fit sees it: named parameters, and the surface and maps they stand for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.latent.displacement import DISPLACEMENT, Tessellator
from appearance_opt.latent.mesh import LatentMesh, LatentTopology, local_edge_length
from appearance_opt.latent.parameter import Parameter
from appearance_opt.latent.smoothing import Smoother
from appearance_opt.latent.texels import BOUNDS, NORMALS, TexelCodec
from appearance_opt.render import upload
from appearance_opt.render.material import CHANNELS, MaterialMaps, TexelLayer

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from appearance_opt.render.passing import Scene
    from appearance_opt.render.surface import Surface

POSITIONS, TEXELS = "positions", "texels"


@dataclass(frozen=True)
class Rates:
    """Learning rates at the start of a fit. ``position``: in units of the local edge length;
    ``displacement``: in units of the mean edge length of the finest tessellation; the others in the
    units of their maps (colours: square root of linear)."""

    position: float = 0.01
    normal: float = 0.01
    base_color: float = 0.005
    material: float = 0.005
    displacement: float = 0.01

    def of_channel(self, name: str) -> float:
        """Rate of a texel channel."""
        if name in NORMALS:
            return self.normal
        return self.base_color if name in ("red", "green", "blue") else self.material


@dataclass(frozen=True)
class Shape:
    """Where the drawn mesh is, on the device: flat base ``positions`` (3 V) and the pyramid
    ``relief`` of the displacement map, None without one. Either may carry gradients."""

    positions: mi.Float
    relief: TexelLayer | None


class Drawn:
    """One tessellation level, ready to be traced. Level 0 without displacement is the latent mesh
    itself."""

    def __init__(self, mesh: LatentMesh, level: int, displaced: bool, tangents: bool) -> None:
        self.tessellator = Tessellator(mesh, level, tangents) if displaced or level else None
        self.topology = (
            LatentTopology(mesh, tangents)
            if self.tessellator is None
            else self.tessellator.topology
        )
        drawn = self.topology.mesh
        self.edge_length = local_edge_length(drawn.positions, drawn.faces)
        self._moving = upload.MovingScene(drawn.positions, drawn.faces, self.topology.culled)
        self.scene = self._moving.scene

    def pose(self, shape: Shape) -> mi.Float:
        """Flat positions (3 N) of the drawn mesh; differentiable."""
        return (
            shape.positions
            if self.tessellator is None
            else self.tessellator(shape.positions, shape.relief)
        )

    def move(self, posed: mi.Float) -> None:
        """Rebuild the BVH at the given positions."""
        self._moving.move(posed)


class Model:
    """A latent mesh with maps, of which the parts named in ``fit`` are parameters.

    ``fit``: subset of {"shape", "normal", "material", "displacement"}. ``maps``: natural values of
    every map the latent has, channel name -> (size, size), or a number for a channel that is
    constant. Maps that are not fitted are kept in a layer of their own, without gradients or
    moments. The map "displacement" has a size of its own; with it, or with ``levels`` other than
    (0,), the mesh is drawn tessellated, at one of ``levels`` at a time (``select``).
    """

    def __init__(
        self,
        mesh: LatentMesh,
        maps: Mapping[str, NDArray | float],
        fit: frozenset[str],
        rates: Rates,
        levels: tuple[int, ...] = (0,),
    ) -> None:
        images = {n: np.asarray(maps[n]) for n in CHANNELS if n in maps and np.ndim(maps[n])}
        self.constants = {n: float(v) for n, v in maps.items() if not np.ndim(v)}
        fitted = tuple(n for n in images if _group(n) in fit)
        self.mesh, self.levels, self.level = mesh, levels, levels[-1]
        self._drawn = {
            k: Drawn(mesh, k, DISPLACEMENT in maps, "normal_x" in images) for k in levels
        }
        self.edge_length = local_edge_length(mesh.positions, mesh.faces)
        self._fixed_positions = mi.Float(np.ascontiguousarray(mesh.positions, np.float32).ravel())
        self.parameters: dict[str, Parameter] = {}
        if "shape" in fit:
            self.parameters[POSITIONS] = Parameter(
                POSITIONS, mi.Float(self._fixed_positions), 1, mi.Float(0)
            )
        self.codec = self._texel_parameter(TEXELS, fitted, images) if fitted else None
        self._initial_texels = (
            np.array(self.parameters[TEXELS].value) if fitted else np.empty(0, np.float32)
        )
        self._fixed_layers: tuple[TexelLayer, ...] = ()
        self._fixed_maps = {n: v.astype(np.float32) for n, v in images.items() if n not in fitted}
        if self._fixed_maps:
            names = tuple(self._fixed_maps)
            fixed = TexelCodec(names, len(self._fixed_maps[names[0]]))
            self._fixed_layers = (fixed.layer(fixed.encode(self._fixed_maps)),)
        self._relief_codec: TexelCodec | None = None
        self._fixed_relief: TexelLayer | None = None
        if DISPLACEMENT in maps:
            self._relief_codec = self._relief(np.asarray(maps[DISPLACEMENT]), DISPLACEMENT in fit)
        self.set_rates(rates)
        for drawn in self._drawn.values():
            if drawn.tessellator is not None:  # without one, the scene was made where it is
                drawn.move(drawn.pose(self.shape()))

    def _texel_parameter(
        self, name: str, channels: tuple[str, ...], images: Mapping[str, NDArray]
    ) -> TexelCodec:
        codec = TexelCodec(channels, len(images[channels[0]]))
        self.parameters[name] = Parameter(
            name,
            codec.encode(images),
            codec.packed,
            mi.Float(0),
            codec.per_channel({n: BOUNDS[n][0] for n in channels}),
            codec.per_channel({n: BOUNDS[n][1] for n in channels}),
        )
        return codec

    def _relief(self, image: NDArray, fitted: bool) -> TexelCodec:
        if fitted:
            return self._texel_parameter(DISPLACEMENT, (DISPLACEMENT,), {DISPLACEMENT: image})
        codec = TexelCodec((DISPLACEMENT,), len(image))
        self._fixed_relief = codec.layer(codec.encode({DISPLACEMENT: image}))
        return codec

    @property
    def drawn(self) -> Drawn:
        """The tessellation that is drawn now."""
        return self._drawn[self.level]

    @property
    def topology(self) -> LatentTopology:
        """Connectivity of the drawn mesh."""
        return self.drawn.topology

    def topologies(self) -> dict[int, LatentTopology]:
        """Connectivity of every level."""
        return {level: drawn.topology for level, drawn in self._drawn.items()}

    @property
    def scene(self) -> Scene:
        """The drawn mesh, for tracing rays."""
        return self.drawn.scene

    def select(self, level: int) -> None:
        """Draw another tessellation level from now on."""
        if level != self.level:
            self.level = level
            self.update_scene()

    def set_rates(self, rates: Rates) -> None:
        """Change the learning rates of all parameters."""
        if POSITIONS in self.parameters:
            per_vertex = np.repeat(self.edge_length * rates.position, 3).astype(np.float32)
            self.parameters[POSITIONS].rate = mi.Float(per_vertex)
        if self.codec is not None:
            per_channel = {n: rates.of_channel(n) for n in self.codec.channels}
            self.parameters[TEXELS].rate = self.codec.per_channel(per_channel)
        if DISPLACEMENT in self.parameters:
            edge = float(self._drawn[max(self.levels)].edge_length.mean())
            self.parameters[DISPLACEMENT].rate = mi.Float(edge * rates.displacement)

    def precondition(self, strength: float, rate: float) -> None:
        """Smooth the steps of the positions (see ``latent.smoothing``), with a ``rate`` in units of
        the positions."""
        parameter = self.parameters.get(POSITIONS)
        if parameter is not None:
            parameter.smooth = Smoother(len(self.mesh.positions), self.mesh.faces, strength)
            parameter.rate = mi.Float(rate)

    def positions(self) -> mi.Float:
        """Current flat base positions (3 V)."""
        return (
            self.parameters[POSITIONS].value
            if POSITIONS in self.parameters
            else self._fixed_positions
        )

    def shape(self) -> Shape:
        """What places the drawn mesh, as it is now."""
        return self.shape_of(self.values())

    def shape_of(self, values: Mapping[str, mi.Float]) -> Shape:
        """What places the drawn mesh, for given values of the parameters."""
        relief = self._fixed_relief
        if DISPLACEMENT in values:
            assert self._relief_codec is not None
            relief = self._relief_codec.layer(values[DISPLACEMENT])
        return Shape(values.get(POSITIONS, self._fixed_positions), relief)

    def layer_of(self, values: Mapping[str, mi.Float]) -> TexelLayer | None:
        """The maps that are parameters as a pyramid, for given values."""
        return self.codec.layer(values[TEXELS]) if self.codec is not None else None

    def track(self, shape: Shape, layer: TexelLayer | None) -> tuple[Shape, TexelLayer | None]:
        """Copies with gradients attached to those parts that are parameters."""
        positions, relief = mi.Float(shape.positions), shape.relief
        if POSITIONS in self.parameters:
            dr.enable_grad(positions)
        if DISPLACEMENT in self.parameters and relief is not None:
            relief = _track(relief)
        return Shape(positions, relief), None if layer is None else _track(layer)

    def gradients(
        self, shape: Shape, layer: TexelLayer | None, values: Mapping[str, mi.Float]
    ) -> dict[str, mi.Float]:
        """Gradients of the parameters, which have the given ``values``, after the backward pass of
        a tracked shape and layer."""
        out = {}
        if POSITIONS in values:
            out[POSITIONS] = dr.grad(shape.positions)
        for name, codec, tracked in (
            (DISPLACEMENT, self._relief_codec, shape.relief),
            (TEXELS, self.codec, layer),
        ):
            if name in values:
                assert codec is not None and tracked is not None
                out[name] = codec.pull_back(dr.grad(tracked.pyramid.texels), values[name])
        return out

    def posed(self) -> mi.Float:
        """Flat positions (3 N) of the drawn mesh as it is now."""
        return self.drawn.pose(self.shape())

    def update_scene(self) -> None:
        """Move the traced mesh to the current positions (rebuilds its BVH)."""
        if POSITIONS in self.parameters or DISPLACEMENT in self.parameters:
            self.drawn.move(self.posed())

    def surface(self, posed: mi.Float) -> Surface:
        """Surface at flat positions (3 N) of the drawn mesh, differentiable in them."""
        return self.topology.surface(posed)

    def fitted_layer(self) -> TexelLayer | None:
        """The maps that are parameters, as a fresh pyramid."""
        return self.layer_of(self.values())

    def fixed(self) -> tuple:
        """What a step reads and no step changes."""
        codecs = self.codec, self._relief_codec
        return (self._drawn, *codecs, self._fixed_layers, self._fixed_relief, self._fixed_positions)

    def maps(self, fitted: TexelLayer | None) -> MaterialMaps:
        """All maps, with the given state of the fitted ones."""
        layers = self._fixed_layers if fitted is None else (fitted, *self._fixed_layers)
        return MaterialMaps(layers, self.constants)

    def host_positions(self) -> NDArray[np.float32]:
        """Current base positions (V, 3)."""
        return np.array(self.positions()).reshape(-1, 3)

    def host_drawn(self, level: int) -> tuple[LatentMesh, NDArray[np.float32]]:
        """Mesh of a tessellation level and its current positions (N, 3)."""
        drawn = self._drawn[level]
        return drawn.topology.mesh, np.array(drawn.pose(self.shape())).reshape(-1, 3)

    def posed_mesh(self) -> LatentMesh:
        """The mesh as it is drawn at the finest level, where it is now."""
        mesh, positions = self.host_drawn(max(self.levels))
        return replace(mesh, positions=positions)

    def host_displacement(self) -> NDArray[np.float32] | None:
        """Current displacement map (size, size) in the units of the positions, or None."""
        if self._relief_codec is None:
            return None
        layer = self.shape().relief
        assert layer is not None
        size = self._relief_codec.size
        return np.array(layer.pyramid.texels)[: size * size].reshape(size, size)

    def host_maps(self) -> dict[str, NDArray[np.float32]]:
        """Current maps in natural units, channel name -> (size, size), fitted or not."""
        out = dict(self._fixed_maps)
        if self.codec is not None:
            out.update(self.codec.to_maps(self.parameters[TEXELS].value))
        return out

    def changed(self) -> NDArray[np.bool_]:
        """(size, size) texels that differ from those of the start. Needs fitted maps."""
        assert self.codec is not None
        texels = np.array(self.parameters[TEXELS].value).reshape(
            self.codec.size, self.codec.size, -1
        )
        return (texels != self._initial_texels.reshape(texels.shape)).any(axis=-1)

    def values(self) -> dict[str, mi.Float]:
        """Snapshot of all parameters (arrays are never changed in place, so this copies
        nothing)."""
        return {name: p.value for name, p in self.parameters.items()}

    def restore(self, values: Mapping[str, mi.Float]) -> None:
        """Back to a snapshot."""
        for name, value in values.items():
            self.parameters[name].value = mi.Float(value)
        dr.eval([p.value for p in self.parameters.values()])
        self.update_scene()


def _track(layer: TexelLayer) -> TexelLayer:
    """A copy whose texels carry gradients."""
    texels = mi.Float(layer.pyramid.texels)
    dr.enable_grad(texels)
    return layer.with_texels(texels)


def _group(channel: str) -> str:
    """The part of ``fit`` that a channel belongs to."""
    return "normal" if channel in NORMALS else "material"
