"""The latent: a mesh, and the parts that say how it looks; drawn at a pose."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.latent.laplacian import Laplacian
from appearance_opt.latent.mesh import LatentTopology, local_edge_length
from appearance_opt.latent.parts import Pose
from appearance_opt.latent.positions import POSITIONS
from appearance_opt.render import upload
from appearance_opt.render.drawn import Drawn
from appearance_opt.render.material import MaterialMaps

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from appearance_opt.latent.mesh import LatentMesh
    from appearance_opt.latent.parameter import Parameter, Rates
    from appearance_opt.latent.parts import Guard, Part
    from appearance_opt.render.edge_list import EdgeList
    from appearance_opt.render.passing import Scene
    from appearance_opt.render.surface import Surface

    Values = dict[str, mi.Float]
    """What is stored, by the name of the part."""

    Decoded = dict[str, Any]
    """What is drawn of it, by the name of the part: of the parts that are fitted."""

P = TypeVar("P", bound="Part")


class TracedMesh:
    """The mesh of one tessellation level, ready to be traced, at flat positions ``vertices``
    (3 N)."""

    def __init__(self, mesh: LatentMesh, vertices: mi.Float, tangents: bool) -> None:
        self.topology = LatentTopology(mesh, tangents)
        positions = np.array(vertices).reshape(-1, 3)
        self._moving = upload.MovingScene(positions, mesh.faces, self.topology.culled)
        self.scene: Scene = self._moving.scene

    def move(self, vertices: mi.Float) -> None:
        """Rebuild the BVH at the given positions."""
        self._moving.move(vertices)


class Latent:
    """A mesh and its ``parts``, in the order in which they place vertices (``latent.build`` makes
    it). ``constants``: channels of the material without a map. ``poses``: those that it is drawn
    at (of an animation one for each frame, in their order); ``pose`` is the one it is drawn at now.

    What is fitted are the ``parameters``. ``decode``, ``vertices``, ``surface``, ``maps``,
    ``track`` and ``gradients`` are pure (see ``latent.parts``).
    """

    def __init__(
        self,
        mesh: LatentMesh,
        parts: tuple[Part, ...],
        constants: Mapping[str, float],
        poses: tuple[Pose, ...],
    ) -> None:
        self.mesh, self.parts, self.constants = mesh, parts, dict(constants)
        self.poses, self.pose = poses, poses[-1]
        self.parameters: dict[str, Parameter] = {
            p.name: p.parameter for p in parts if p.parameter is not None
        }
        self._fitted = tuple(p for p in parts if p.parameter is not None)
        self._placing = tuple(p for p in parts if p.places)
        self._deforms = any(p.places for p in self._fitted)
        self._moving = self._deforms or any(p.frame is not None for p in poses)
        tangents = any("normal_x" in p.channels for p in parts)
        self._traced: dict[int, TracedMesh] = {}
        for level in {p.level: None for p in poses}:
            at_rest = self.vertices(pose=Pose(level))
            self._traced[level] = TracedMesh(self._mesh_of(level), at_rest, tangents)
        if self.pose.frame is not None:
            self.update_scene()

    # what is fitted

    def values(self) -> Values:
        """Snapshot of all parameters (arrays are never changed in place, so this copies
        nothing)."""
        return {name: p.value for name, p in self.parameters.items()}

    def assign(self, values: Mapping[str, mi.Float]) -> None:
        """Change parameters. The traced mesh stays where it is: ``update_scene`` moves it."""
        for name, value in values.items():
            self.parameters[name].value = value

    def restore(self, values: Mapping[str, mi.Float]) -> None:
        """Go back to a snapshot."""
        self.assign({name: mi.Float(value) for name, value in values.items()})
        dr.eval([p.value for p in self.parameters.values()])
        self.update_scene()

    def set_rates(self, rates: Rates) -> None:
        """Change the learning rates of all parameters."""
        for part in self._fitted:
            part.set_rates(rates)

    def part(self, kind: type[P]) -> P | None:
        """The first part of a class, the fitted one of two; None without."""
        found = [p for p in self.parts if isinstance(p, kind)]
        return min(found, key=lambda p: p.parameter is None, default=None)

    def fitted(self, kind: type[P]) -> P | None:
        """The part of a class that is fitted, None if there is none."""
        part = self.part(kind)
        return None if part is None or part.parameter is None else part

    def guards(self) -> dict[str, Guard]:
        """What keeps parameters in order, relative to the start, by their name."""
        found = {part.name: part.guard() for part in self._fitted}
        return {name: guard for name, guard in found.items() if guard is not None}

    def laplacians(self, relative: bool) -> dict[int, Laplacian]:
        """The regularizer of the mesh at rest by tessellation level, relative to where it is now,
        or to 0. Empty if no vertex can move."""
        out = {}
        for level in self._traced if self._deforms else ():
            mesh = self.posed_mesh(Pose(level))
            length = local_edge_length(mesh.positions, mesh.faces)
            out[level] = Laplacian(mesh.positions, mesh.faces, length, relative)
        return out

    # how it is drawn

    def decode(self, stored: Values) -> Decoded:
        """What is drawn of stored values."""
        return {p.name: p.decode(stored[p.name]) for p in self._fitted}

    def track(self, decoded: Decoded) -> Decoded:
        """Copies with gradients attached."""
        return {p.name: p.track(decoded[p.name]) for p in self._fitted}

    def gradients(self, tracked: Decoded, stored: Values) -> Values:
        """Gradients of the parameters, which have the given values, after the backward pass of
        tracked ones."""
        return {p.name: p.pull_back(tracked[p.name], stored[p.name]) for p in self._fitted}

    def vertices(self, decoded: Decoded | None = None, pose: Pose | None = None) -> mi.Float:
        """Flat positions (3 N) of the drawn mesh, differentiable; by default as it is now."""
        out = mi.Float()
        for part in self._placing:
            out = part.place(out, _value(part, decoded), pose or self.pose)
        return out

    def surface(self, vertices: mi.Float, pose: Pose | None = None) -> Surface:
        """Surface at flat positions (3 N) of the drawn mesh, differentiable in them."""
        return self._traced[(pose or self.pose).level].topology.surface(vertices)

    def maps(self, decoded: Decoded | None = None) -> MaterialMaps:
        """All maps; by default as they are now."""
        shown = [(p, _value(p, decoded)) for p in self.parts if p.channels]
        layers = tuple(layer for p, value in shown for layer in p.layers(value))
        coverages = (p.coverage(value) for p, value in shown)
        coverage = next((c for c in coverages if c is not None), None)
        return MaterialMaps(layers, self.constants, coverage=coverage)

    @property
    def seen_through(self) -> bool:
        """Does it keep back less than all of the light behind it?"""
        return self.maps().coverage is not None

    def drawn(
        self, decoded: Decoded | None = None, surface: Surface | None = None, walkable: bool = False
    ) -> Drawn:
        """What is seen at the current pose. ``surface``: if it is made already; ``walkable``: with
        edges that can be walked over."""
        surface = self.surface(self.vertices(decoded)) if surface is None else surface
        return Drawn(self.scene, surface, self.maps(decoded), self.edges(self.pose, walkable))

    def edges(self, pose: Pose, walkable: bool) -> EdgeList:
        """The edges of the drawn mesh, with what lies around each face if ``walkable``."""
        topology = self._traced[pose.level].topology
        return topology.walkable if walkable else topology.edges

    def fixed(self) -> tuple:
        """What the pure functions read and no step changes."""
        return (self._traced, *(p.fixed() for p in self.parts))

    @property
    def topology(self) -> LatentTopology:
        """Connectivity of the mesh that is drawn now."""
        return self._traced[self.pose.level].topology

    @property
    def scene(self) -> Scene:
        """The mesh that is drawn now, for tracing rays."""
        return self._traced[self.pose.level].scene

    def select(self, pose: Pose) -> None:
        """Draw another pose from now on."""
        if pose.level != self.pose.level or pose.frame is not self.pose.frame:
            self.pose = pose
            self.update_scene()

    def update_scene(self) -> None:
        """Move the traced mesh to where the parts place it (rebuilds its BVH)."""
        if self._moving:
            self._traced[self.pose.level].move(self.vertices())

    # what is written

    def host_positions(self) -> NDArray[np.float32]:
        """Current positions (V, 3) of the base mesh."""
        return next(p.export()[POSITIONS] for p in self.parts if p.name == POSITIONS)

    def host_maps(self) -> dict[str, NDArray[np.float32]]:
        """Current maps of the material in natural units, channel name -> (size, size), fitted or
        not."""
        return {n: v for p in self.parts if p.channels for n, v in p.export().items()}

    def posed_mesh(self, pose: Pose | None = None) -> LatentMesh:
        """The mesh as it is drawn at a pose (by default at rest, the finest), where it is now."""
        pose = pose or Pose(max(self._traced))
        positions = np.array(self.vertices(pose=pose)).reshape(-1, 3)
        return replace(self._traced[pose.level].topology.mesh, positions=positions)

    def _mesh_of(self, level: int) -> LatentMesh:
        mesh = self.mesh
        for part in self.parts:
            mesh = part.mesh(mesh, level)
        return mesh


def _value(part: Part, decoded: Decoded | None) -> Any:
    """The decoded value of a part, by default its current one."""
    return part.now() if decoded is None or part.parameter is None else decoded[part.name]
