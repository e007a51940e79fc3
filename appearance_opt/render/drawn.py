"""What is seen: a mesh for rays, the same mesh to be shaded, its materials and its edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mitsuba as mi

from appearance_opt.render import upload

# not only for the type checker: Dr.Jit resolves the annotations of data classes when it looks for
# arrays
from appearance_opt.render.edge_list import EdgeList
from appearance_opt.render.material import MaterialMaps
from appearance_opt.render.passing import SidedScene
from appearance_opt.render.surface import Surface

if TYPE_CHECKING:
    from appearance_opt.render.upload import MeshArrays


@dataclass(frozen=True, eq=False)
class Shown:
    """What is seen, as far as no ray is traced: the ``surface``, its materials ``maps``, and its
    ``edges`` where derivatives at silhouettes are wanted, else None. Surface and maps may carry
    gradients."""

    surface: Surface
    maps: MaterialMaps
    edges: EdgeList | None = None


@dataclass(frozen=True, eq=False)
class Drawn:
    """Everything that an image shows. ``scene``, in which rays are traced, and ``surface``, which
    is drawn and shaded, are the same mesh at the same place. See ``Shown`` for the rest."""

    scene: mi.Scene | SidedScene
    surface: Surface
    maps: MaterialMaps
    edges: EdgeList | None = None

    @classmethod
    def of(cls, mesh: MeshArrays, maps: MaterialMaps) -> Drawn:
        """Upload a mesh that stands still."""
        scene = upload.scene_of(mesh.positions, mesh.faces, mesh.culled)
        return cls(scene, upload.surface_of(mesh), maps)

    @property
    def shown(self) -> Shown:
        """Return what stages that trace no ray are handed: the scene costs time in every call of a
        recorded one."""
        return Shown(self.surface, self.maps, self.edges)
