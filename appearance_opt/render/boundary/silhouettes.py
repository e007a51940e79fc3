"""Which edges of a mesh are silhouettes: what lies beyond one is not the face next to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render.surface import vertex_position

if TYPE_CHECKING:
    from appearance_opt.render.camera import Camera
    from appearance_opt.render.drawn import Drawn, Shown
    from appearance_opt.render.edge_list import EdgeList


@dataclass
class GatheredEdges:
    """Edges of what is drawn: their numbers ``index`` and packets ``corners`` (see ``EdgeList``),
    and their ends ``a`` and ``b``."""

    index: mi.UInt32
    corners: mi.ArrayXu
    a: mi.Point3f
    b: mi.Point3f


def gather_edges(shown: Shown, index: mi.UInt32, active: mi.Bool | bool = True) -> GatheredEdges:
    """Gather the edges of the given numbers; differentiable in the vertices."""
    edges = edges_of(shown)
    corners = dr.gather(mi.ArrayXu, edges.packets, index, active, shape=(4, dr.width(index)))
    a, b = (vertex_position(shown.surface, corners[k]) for k in (0, 1))
    return GatheredEdges(index, corners, a, b)


def edges_of(shown: Shown | Drawn) -> EdgeList:
    """Return the edges of what is drawn, which must have some."""
    assert shown.edges is not None, "silhouettes need the edges of what is drawn"
    return shown.edges


def is_silhouette(shown: Shown, edge: GatheredEdges, camera: Camera) -> mi.Bool:
    """Tell whether both faces of edges lie on one side of the plane through eye and edge. No
    winding is needed, but for culled faces: what turns its back to the eye is not there. Creases
    count as silhouettes: shading jumps there, and moves with them."""
    m = dr.cross(edge.a - camera.eye, edge.b - edge.a)
    side, other_side = (
        dr.dot(m, vertex_position(shown.surface, edge.corners[k]) - edge.a) for k in (2, 3)
    )
    boundary = edge.corners[3] == edge.corners[1]
    out = boundary | (side * other_side > 0)
    sides, creased = edges_of(shown).sides, edges_of(shown).creased
    if creased is not None:
        out |= dr.gather(mi.Bool, creased, edge.index)
    if sides is None:
        return out
    bits = dr.gather(mi.UInt32, sides, edge.index)
    gone, other_gone = _turned_away(bits, side), boundary | _turned_away(bits >> 2, other_side)
    return (out | (gone != other_gone)) & ~(gone & other_gone)


def _turned_away(bits: mi.UInt32, side: mi.Float) -> mi.Bool:
    """Does a culled face turn its back to the eye? ``bits`` of ``EdgeList.sides``; ``side``:
    product of its opposite vertex, from the edge on, and the normal of the plane through eye and
    edge."""
    return ((bits & 1) != 0) & (dr.select((bits & 2) != 0, side, -side) > 0)


def seen_opposite(shown: Shown, edge: GatheredEdges, camera: Camera) -> mi.UInt32:
    """Return the opposite vertex of a face of each silhouette that is not culled."""
    sides = edges_of(shown).sides
    if sides is None:
        return edge.corners[2]
    m = dr.cross(edge.a - camera.eye, edge.b - edge.a)
    side = dr.dot(m, vertex_position(shown.surface, edge.corners[2]) - edge.a)
    away = _turned_away(dr.gather(mi.UInt32, sides, edge.index), side)
    return dr.select(away, edge.corners[3], edge.corners[2])
