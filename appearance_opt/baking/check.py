"""Is a mesh fit to be baked to? Each fault is one line that says how many, and what to do."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance_opt.errors import InputError
from appearance_opt.render import upload

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset
    from appearance_opt.latent.mesh import LatentMesh

OUTSIDE = 1e-5
"""How far texture coordinates may lie outside the unit square: exporters round."""

NO_AREA, NO_SURFACE = 1e-12, 1e-6
"""UV area (fraction of the square) that counts as none, and the share of the surface that such
triangles may have: slivers without area in space may well have none in the atlas."""

OVERLAP_SIZE, OVERLAP_MARGIN, OVERLAP_SHARE = 2048, 0.05, 1e-3
"""Overlaps are looked for on a grid of this many points a side; a point counts for a triangle if it
lies this far inside, in grid cells; fewer overlapping points than this share of the covered ones
are rounding, or the folded slivers that automatic atlases leave (1.5e-4 in xatlas's of the demo's
8,999 triangles)."""

MENDING = "use --unwrap to make a new atlas"


def check_uvs(asset: Asset, name: str) -> None:
    """Raise InputError for texture coordinates that are missing, outside the unit square, or
    without area. ``name``: how to call the file."""
    missing = sum(m.uvs is None for m in asset.meshes)
    if missing:
        raise InputError(
            f"{name}: {missing} of {len(asset.meshes)} meshes have no texture coordinates; {MENDING}"
        )
    outside = total = flat = 0
    area_flat = area_all = 0.0
    for mesh in asset.meshes:
        assert mesh.uvs is not None
        outside += int(((mesh.uvs < -OUTSIDE) | (mesh.uvs > 1 + OUTSIDE)).any(axis=1).sum())
        total += len(mesh.uvs)
        p, t = (
            mesh.positions[mesh.faces].astype(np.float64),
            mesh.uvs[mesh.faces].astype(np.float64),
        )
        area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
        a, b = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
        none = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2 < NO_AREA
        flat += int(none.sum())
        area_flat += float(area[none].sum())
        area_all += float(area.sum())
    if outside:
        raise InputError(
            f"{name}: {outside} of {total} texture coordinates lie outside the unit square; {MENDING}"
        )
    if area_flat > NO_SURFACE * area_all:
        share = 100 * area_flat / area_all
        raise InputError(
            f"{name}: {flat} triangles have no area in texture space, {share:.2g} % of the surface; {MENDING}"
        )


def check_overlap(mesh: LatentMesh, name: str) -> None:
    """Raise InputError if triangles overlap in texture space."""
    triangles, share = overlap(mesh)
    if share > OVERLAP_SHARE:
        raise InputError(
            f"{name}: {triangles} of {len(mesh.faces)} triangles overlap others in texture space, "
            f"{100 * share:.2g} % of the covered texels; {MENDING}"
        )


def overlap(mesh: LatentMesh, size: int = OVERLAP_SIZE) -> tuple[int, float]:
    """(triangles that overlap others in the atlas, share of the covered grid points that more than
    one triangle holds)."""
    count = len(mesh.faces)
    uv = mesh.uvs[mesh.frame_faces]
    # every triangle at a height of its own: a ray from above meets those that overlap one by one
    height = np.repeat((np.arange(count) + 0.5) / count, 3)
    soup = np.concatenate([uv.reshape(-1, 2), height[:, None]], axis=1).astype(np.float32)
    scene = upload.scene_of(soup, np.arange(3 * count).reshape(-1, 3))
    inset = mi.Float(_inset(uv, size).ravel())
    marked = dr.zeros(mi.UInt32, count)
    covered = doubled = 0
    rows = max(1, min(size, (1 << 20) // size))
    with dr.suspend_grad():
        for row in range(0, size, rows):
            i = dr.arange(mi.UInt32, rows * size)
            scale = dr.opaque(mi.Float, 1 / size)
            u = (mi.Float(i % size) + 0.5) * scale
            v = (mi.Float(i // size) + dr.opaque(mi.Float, row + 0.5)) * scale
            first, second = _two_hits(scene, inset, count, u, v)
            both = second != NONE
            for hit in (first, second):
                dr.scatter(marked, mi.UInt32(1), dr.select(both, hit, 0), both)
            covered += int(dr.count(first != NONE)[0])
            doubled += int(dr.count(both)[0])
    return int(np.array(marked).sum()), doubled / max(covered, 1)


NONE = 0xFFFFFFFF

PASSES = 4
"""Triangles whose very edge a point may touch before it is given up."""


def _two_hits(
    scene: mi.Scene, inset: mi.Float, count: int, u: mi.Float, v: mi.Float
) -> tuple[mi.UInt32, mi.UInt32]:
    """The first two triangles, from above, that hold the points well inside; ``NONE`` for none.
    ``count``: of all triangles."""
    top, layer = mi.Float(2), dr.opaque(mi.Float, 1 / count)
    first, second = mi.UInt32(NONE), mi.UInt32(NONE)
    for _ in range(PASSES):
        ray = mi.Ray3f(mi.Point3f(u, v, top), mi.Vector3f(0, 0, -1))
        hit = scene.ray_intersect_preliminary(
            ray, coherent=True, active=(top > 0) & (second == NONE)
        )
        valid = hit.is_valid()
        prim = dr.select(valid, hit.prim_index, 0)
        b1, b2 = hit.prim_uv.x, hit.prim_uv.y
        least = dr.gather(mi.Point3f, inset, prim)
        inside = valid & (1 - b1 - b2 > least.x) & (b1 > least.y) & (b2 > least.z)
        second = dr.select(inside & (first != NONE), hit.prim_index, second)
        first = dr.select(inside & (first == NONE), hit.prim_index, first)
        # half a layer below the triangle: from its own height, a ray may meet it once more
        top = dr.select(valid, mi.Float(prim) * layer, -1)
        dr.eval(first, second, top)
    return first, second


def _inset(uv: NDArray, size: int) -> NDArray[np.float32]:
    """(F, 3) barycentric coordinates at a distance of ``OVERLAP_MARGIN`` cells from each edge."""
    t = uv.astype(np.float64)
    a, b = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    double = np.maximum(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), 1e-30)
    sides = np.stack(
        [np.linalg.norm(t[:, (k + 2) % 3] - t[:, (k + 1) % 3], axis=1) for k in range(3)], axis=1
    )
    return np.minimum(OVERLAP_MARGIN / size * sides / double[:, None], 1.0).astype(np.float32)


PLACE, SIZE = 0.05, 0.1
"""Centres of the two boxes may differ by this share of HIGH's diagonal, and their diagonals by this
share."""


def check_place(high: Asset, low: Asset) -> None:
    """Raise InputError if the two are not in the same place or not of the same size."""
    offset, ratio, diagonal = misfit(high, low)
    if offset <= PLACE * diagonal and abs(ratio - 1) <= SIZE:
        return
    raise InputError(
        f"HIGH and LOW do not lie in one place: their centres are {offset:.4g} m apart "
        f"({100 * offset / diagonal:.0f} % of HIGH's size) and LOW is {ratio:.3g} times as large; "
        "use --align to fit translation and scale"
    )


def misfit(high: Asset, low: Asset) -> tuple[float, float, float]:
    """(distance of the boxes' centres, LOW's diagonal over HIGH's, HIGH's diagonal), metres."""
    (a0, a1), (b0, b1) = high.bounds(), low.bounds()
    diagonal = max(float(np.linalg.norm(a1 - a0)), 1e-300)
    offset = float(np.linalg.norm((b0 + b1) / 2 - (a0 + a1) / 2))
    return offset, float(np.linalg.norm(b1 - b0)) / diagonal, diagonal
