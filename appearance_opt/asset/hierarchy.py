"""The nodes of an asset: where they are, and meshes in their coordinates and back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.instances import Instances, place_copies
from appearance_opt.asset.origin import ZERO, settle

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.origin import Origin
    from appearance_opt.asset.types import Asset, Mesh, Node

OF_MESH = "_mesh"
"""What follows the name of a node in that of a node which brings its mesh to its place."""

SHEAR = 1e-5
"""By how much translation, rotation and scale may miss a matrix, relative to its largest number:
more than rounding in a file of single precision."""


@dataclass(frozen=True)
class Transform:
    """Translation, rotation (a unit quaternion x, y, z, w) and scale: what engines keep of a
    node."""

    translation: tuple[float, ...] = (0.0, 0.0, 0.0)
    rotation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    scale: tuple[float, ...] = (1.0, 1.0, 1.0)


def place_nodes(nodes: Sequence[Node]) -> tuple[list[Transform], NDArray[np.float64]]:
    """(the transform of each node relative to its parent; (N, 4, 4) to the world).

    A transform that shears, or flattens space, is none that glTF has for nodes (2.0, 3.5.3) or an
    engine keeps: its node keeps its place alone, and what hangs below it keeps its own.
    """
    wanted = np.empty((len(nodes), 4, 4))
    world = np.empty((len(nodes), 4, 4))
    transforms = []
    for k, node in enumerate(nodes):
        above = np.eye(4) if node.parent is None else world[node.parent]
        wanted[k] = node.matrix if node.parent is None else wanted[node.parent] @ node.matrix
        local = np.linalg.solve(above, wanted[k])
        found = decompose(local)
        if found is None:
            place = local[:3, 3] if np.isfinite(local).all() else np.zeros(3)
            found = Transform(tuple(place.tolist()))
        transforms.append(found)
        world[k] = above @ compose_one(found)
    return transforms, world


def decompose(matrix: NDArray) -> Transform | None:
    """A (4, 4) matrix as translation, rotation and scale; None if it is singular, or they cannot
    make it. A reflection becomes a negative scale along x."""
    from scipy.spatial.transform import Rotation

    linear = matrix[:3, :3]
    scale = np.linalg.norm(linear, axis=0)
    most = float(scale.max())
    if not np.isfinite(matrix).all() or scale.min() <= SHEAR * most or most == 0:
        return None
    if np.linalg.det(linear) < 0:
        scale[0] = -scale[0]
    axes = linear / scale
    if np.abs(axes.T @ axes - np.eye(3)).max() > SHEAR:
        return None
    out = Transform(tuple(matrix[:3, 3].tolist()), scale=tuple(scale.tolist()))
    if np.array_equal(axes, np.eye(3)):
        return out
    return replace(out, rotation=tuple(Rotation.from_matrix(axes).as_quat().tolist()))


def compose_one(t: Transform) -> NDArray[np.float64]:
    """The (4, 4) matrix of a transform."""
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat(t.rotation).as_matrix() * np.array(t.scale)
    out[:3, 3] = t.translation
    return out


def in_coordinates(
    meshes: Sequence[Mesh], world: NDArray, origin: Sequence[float]
) -> tuple[list[Mesh], Origin]:
    """Meshes of the world, at ``origin``, in the coordinates of a node that ``world`` (4, 4) brings
    to the world: (with positions in single precision, relative to a place in its coordinates; that
    place, zero unless they lie far from the pivot)."""
    back = np.linalg.inv(world) @ _translation(origin)
    if np.array_equal(back, np.eye(4)):
        return list(meshes), ZERO
    place = Instances(back[None])
    put = [replace(place_copies(m, place, m.name), node=m.node) for m in meshes]
    return settle(put, lambda _: None)


def _translation(offset: Sequence[float]) -> NDArray[np.float64]:
    out = np.eye(4)
    out[:3, 3] = offset
    return out


def group_by_node(asset: Asset) -> dict[int | None, list[int]]:
    """Numbers of the meshes of each node of an asset; those of no node below None."""
    groups: dict[int | None, list[int]] = {}
    for k, mesh in enumerate(asset.meshes):
        groups.setdefault(mesh.node if asset.nodes else None, []).append(k)
    return groups


def owners(asset: Asset) -> NDArray[np.int32] | None:
    """(F,) number of the node of each face of all meshes, one after the other, -1 for none; None
    for an asset without nodes."""
    if not asset.nodes:
        return None
    own = [-1 if m.node is None else m.node for m in asset.meshes]
    return np.repeat(np.array(own, np.int32), [len(m.faces) for m in asset.meshes])


def merge_nodes(asset: Asset) -> Asset:
    """An asset whose meshes belong to no node."""
    return replace(asset, nodes=(), meshes=tuple(replace(m, node=None) for m in asset.meshes))


def without_idle_nodes(asset: Asset, kept: Iterable[int] = ()) -> Asset:
    """An asset without the nodes that lead neither to a mesh nor to one of those ``kept``."""
    used = {m.node for m in asset.meshes if m.node is not None} | set(kept)
    for k in reversed(range(len(asset.nodes))):
        parent = asset.nodes[k].parent
        if k in used and parent is not None:
            used.add(parent)
    if len(used) == len(asset.nodes):
        return asset
    number = {old: new for new, old in enumerate(sorted(used))}
    nodes = (asset.nodes[k] for k in number)
    return replace(
        asset,
        nodes=tuple(n if n.parent is None else replace(n, parent=number[n.parent]) for n in nodes),
        meshes=tuple(
            m if m.node is None else replace(m, node=number[m.node]) for m in asset.meshes
        ),
    )
