"""The hierarchy of a USD stage: prims as nodes, and nodes as prims."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset import hierarchy
from appearance_opt.asset.alpha import list_names
from appearance_opt.asset.notes import counted
from appearance_opt.asset.paths import MAX_NAME
from appearance_opt.asset.types import Credits, Node

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset, Mesh

COPYRIGHT = "copyright"
"""Key of a layer's custom data; USD itself has no place for it."""


class Prims:
    """The prims above the meshes of a stage as ``nodes``, in metres, Y up. ``to_metres``: (3, 3)
    from the stage's coordinates, of columns."""

    def __init__(self, cache: Any, to_metres: NDArray) -> None:
        self.nodes: list[Node] = []
        self._cache, self._numbers, self._world = cache, dict[str, int](), list[np.ndarray]()
        self._turn = np.eye(4)
        self._turn[:3, :3] = to_metres
        self._back = np.linalg.inv(self._turn)

    def own(self, prim: Any, meshes: Iterable[Mesh]) -> list[Mesh]:
        """The meshes that a prim shows, as its own. One that has no place of its own, and no other
        beside it, belongs to the prim above it, as most writers have objects and their shapes."""
        from pxr import UsdGeom

        parent = prim.GetParent()
        alone = parent.IsA(UsdGeom.Xform) and _shapes(parent) == 1
        if alone and not UsdGeom.Xformable(prim).GetOrderedXformOps():
            prim = parent
        number = self._number(prim)
        return [replace(mesh, node=number) for mesh in meshes]

    def _number(self, prim: Any) -> int:
        key = str(prim.GetPath())
        if key not in self._numbers:
            parent = prim.GetParent()
            above = None if parent.IsPseudoRoot() else self._number(parent)
            matrix = np.array(self._cache.GetLocalToWorldTransform(prim)).T
            world = self._turn @ matrix @ self._back
            local = world if above is None else _relative(self._world[above], world)
            name = prim.GetDisplayName() or str(prim.GetName())
            self._numbers[key] = len(self.nodes)
            self.nodes.append(Node(name, above, local))
            self._world.append(world)
        return self._numbers[key]


def _relative(above: NDArray, world: NDArray) -> NDArray:
    """From ``world`` to what lies ``above`` it, which may flatten space."""
    try:
        return np.linalg.solve(above, world)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(above) @ world


def _shapes(prim: Any) -> int:
    """How many shapes lie directly below a prim?"""
    from pxr import Usd, UsdGeom

    below = prim.GetFilteredChildren(Usd.TraverseInstanceProxies())
    return sum(child.IsA(UsdGeom.Gprim) for child in below)


def credits_of(stage: Any) -> Credits:
    """What the root layer of a stage says of its owners."""
    said = stage.GetRootLayer().customLayerData.get(COPYRIGHT, "")
    return Credits(said if isinstance(said, str) else "")


def note_dropped(
    stage: Any, note: Callable[[str], None], sets_read: Callable[[Any], Iterable[str]]
) -> None:
    """Note cameras, lights, texture coordinates that no texture reads, though others are there
    (``sets_read``: names of those that the textures of a mesh read), and custom data, with
    counts."""
    from pxr import UsdGeom, UsdLux

    found: dict[str, list[str]] = {"cameras": [], "lights": [], "spare": [], "custom": []}
    for prim in stage.Traverse():
        name = str(prim.GetName())
        if prim.IsA(UsdGeom.Camera):
            found["cameras"].append(name)
        elif prim.HasAPI(UsdLux.LightAPI):
            found["lights"].append(name)
        elif prim.IsA(UsdGeom.Mesh):
            sets = _sets(prim)
            if len(sets) > 1 and sets - set(sets_read(prim)):
                found["spare"].append(name)
        if prim.IsA(UsdGeom.Xformable) and prim.HasAuthoredCustomData():
            found["custom"].append(name)
    for key, one, many, what in (
        ("cameras", "camera", "cameras", "{} dropped"),
        ("lights", "light", "lights", "{} dropped"),
        ("spare", "mesh", "meshes", "texture coordinates that no texture reads dropped, of {}"),
        ("custom", "prim", "prims", "custom data of {} dropped"),
    ):
        if found[key]:
            told = what.format(counted(len(found[key]), one, many))
            note(f"{told} ({list_names(found[key])})")


def _sets(prim: Any) -> set[str]:
    """Names of the sets of texture coordinates of a mesh."""
    from pxr import Sdf, UsdGeom

    kinds = (Sdf.ValueTypeNames.TexCoord2fArray, Sdf.ValueTypeNames.TexCoord2dArray)
    primvars = UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithValues()
    return {str(p.GetPrimvarName()) for p in primvars if p.GetTypeName() in kinds}


def write_nodes(stage: Any, top: str, asset: Asset) -> tuple[list[str], NDArray]:
    """Write the nodes of an asset below the prim ``top``: (path of each, (N, 4, 4) from its
    coordinates to the world). One node above all others is ``top`` itself."""
    from pxr import Gf, Tf, UsdGeom

    transforms, world = hierarchy.place_nodes(asset.nodes)
    hung = all(m.node is not None for m in asset.meshes)
    is_top = hung and sum(n.parent is None for n in asset.nodes) == 1
    paths: list[str] = []
    taken: set[str] = {f"{top}/Materials"}
    for node, transform in zip(asset.nodes, transforms, strict=True):
        if node.parent is None and is_top:
            path, prim = top, UsdGeom.Xform.Get(stage, top)
        else:
            above = top if node.parent is None else paths[node.parent]
            word = Tf.MakeValidIdentifier(node.name)[:MAX_NAME]
            path, k = f"{above}/{word}", 0
            while path in taken:
                path, k = f"{above}/{word}_{k}", k + 1
            prim = UsdGeom.Xform.Define(stage, path)
        taken.add(path)
        paths.append(path)
        if path.rsplit("/", 1)[1] != node.name:
            prim.GetPrim().SetDisplayName(node.name)
        matrix = hierarchy.compose_one(transform)
        if not np.array_equal(matrix, np.eye(4)):
            prim.AddTransformOp().Set(Gf.Matrix4d(*matrix.T.ravel().tolist()))
    return paths, world
