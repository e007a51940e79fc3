"""The shapes that USD knows by name (sphere, cube, cylinder, cone, capsule, plane) as triangles."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    import trimesh
    from numpy.typing import NDArray

SECTIONS = 64
"""Triangles around a round shape."""

SHARP = np.radians(40.0)
"""Edges at which faces meet at a larger angle are drawn sharp: rims and the edges of a cube, but no
facets."""

_TO_AXIS = {
    "X": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "Y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "Z": np.eye(3),
}
"""Rotations that lay a shape along z along another axis; a plane's width stays in x then, or its
length in y."""

Triangles = tuple["NDArray[np.float64]", "NDArray[np.float64]", "NDArray[np.int64]"]


def triangles(prim: Any, time: Any) -> Triangles | None:
    """(positions (V, 3), unit normals (V, 3), faces (F, 3)) of a shape in its own
    coordinates; None if it is none of them."""
    make = _SHAPES.get(str(prim.GetTypeName()))
    if make is None:
        return None

    def number(name: str, default: float) -> float:
        value = prim.GetAttribute(name).Get(time)
        size = default if value is None else float(value)
        if not 0 < size < np.inf:
            raise ValueError(f"the {name} of '{prim.GetPath()}' is {size}")
        return size

    import trimesh

    mesh = make(trimesh, number)
    mesh.vertices -= mesh.bounds.mean(axis=0)
    mesh = trimesh.graph.smooth_shade(mesh, angle=SHARP, facet_minarea=None)
    turn = _TO_AXIS.get(str(prim.GetAttribute("axis").Get(time)), _TO_AXIS["Z"])
    positions, normals = (
        np.array(v, np.float64) @ turn.T for v in (mesh.vertices, mesh.vertex_normals)
    )
    return positions, normals, np.array(mesh.faces, np.int64)


def _plane(_: Any, number: Callable[[str, float], float]) -> trimesh.Trimesh:
    import trimesh

    x, y = number("width", 2.0) / 2, number("length", 2.0) / 2
    return trimesh.Trimesh(
        [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)], [(0, 1, 2), (0, 2, 3)], process=False
    )


_SHAPES: dict[str, Callable[[Any, Callable[[str, float], float]], Any]] = {
    "Sphere": lambda t, n: t.creation.uv_sphere(n("radius", 1.0), count=(SECTIONS // 2, SECTIONS)),
    "Cube": lambda t, n: t.creation.box((n("size", 2.0),) * 3),
    "Cylinder": lambda t, n: t.creation.cylinder(
        n("radius", 1.0), n("height", 2.0), sections=SECTIONS
    ),
    "Cone": lambda t, n: t.creation.cone(n("radius", 1.0), n("height", 2.0), sections=SECTIONS),
    "Capsule": lambda t, n: t.creation.capsule(
        n("height", 1.0), n("radius", 0.5), count=(SECTIONS // 2, SECTIONS)
    ),
    "Plane": _plane,
}
