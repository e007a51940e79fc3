"""Which parts of an asset can be seen through.

Exporters write MASK and BLEND far more often than they mean it: what counts is the alpha that a
mesh really shows.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from appearance_opt.asset.normals import weld
from appearance_opt.asset.packing import resize
from appearance_opt.asset.sides import connected_parts
from appearance_opt.asset.types import Texture

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset, Material, Mesh

Kind = Literal["opaque", "mask", "blend", "transmission"]
UNLIT = "unlit"
"""What is opaque and unlit, beside the kinds."""

KINDS: tuple[Kind, ...] = get_args(Kind)

OPAQUE = 1 - 1.5 / 255
"""Alpha from which on nothing is seen through: one step of eight bits below 1."""


FITTED, KEPT = "fitted", "kept as it is"
"""What ``simplify`` does with a part."""

NAMED = 5
"""Names that a note lists before it counts."""


def kind_of(material: Material) -> Kind:
    """How a material is seen through, by its own words (see ``separate_opaque`` for materials that
    do not mean them)."""
    if material.transmission > 0:
        return "transmission"
    return material.alpha_mode


def seen_through(mesh: Mesh) -> bool:
    """Is there anything of a mesh that light passes?"""
    return kind_of(mesh.material) != "opaque"


def coverage(material: Material) -> tuple[float, Texture | None]:
    """(factor, linear texture of one channel or None): the share of the light behind it that a
    material keeps back, for formats and renderers that know no transmission. It is alpha times 1 -
    t (1 - F), where t is the transmission and F the reflectance at normal incidence; glTF 2.0,
    B.3.1: F = ((ior - 1) / (ior + 1))^2."""
    m = material
    alpha, factor = None, 1.0
    if m.alpha_mode != "opaque":
        factor, color = m.opacity, m.base_color_texture
        if color is not None and color.pixels.shape[2] == 4:
            alpha = Texture(color.pixels[..., 3:], "linear", color.wrap)
    if m.transmission <= 0:
        return factor, alpha
    if m.alpha_mode == "mask":  # what passes the test lets light through: no test is left
        values = np.ones((1, 1, 1), np.float32) if alpha is None else alpha.linear()
        test = (values * np.float32(factor) >= m.alpha_cutoff).astype(np.float32)
        alpha, factor = (
            Texture(test, "linear", ("repeat",) * 2 if alpha is None else alpha.wrap),
            1.0,
        )
    passing = m.transmission * (1 - ((m.ior - 1) / (m.ior + 1)) ** 2)
    through = m.transmission_texture
    if through is None:
        return factor * (1 - passing), alpha
    kept = 1 - np.float32(passing) * through.linear()[..., :1]
    if alpha is None:
        return factor, Texture(kept, "linear", through.wrap)
    height, width = (max(t.pixels.shape[k] for t in (alpha, through)) for k in (0, 1))
    values = resize(alpha.linear(), height, width) * resize(kept, height, width)
    return factor, Texture(values, "linear", alpha.wrap)


@dataclass(frozen=True)
class Share:
    """How much of an asset is of one kind, and what ``simplify`` does with it."""

    meshes: int
    triangles: int
    becomes: str


def kept_apart(asset: Asset, by_light: bool = True) -> list[bool]:
    """Which meshes take no part in a fit of what ``separate_opaque`` returns: those that are seen
    through, and (``by_light``) unlit ones, unless all that is opaque is unlit, for one result
    cannot be both."""
    clear = [seen_through(m) for m in asset.meshes]
    lit = any(not m.material.unlit for m, out in zip(asset.meshes, clear, strict=True) if not out)
    return [
        out or (by_light and lit and m.material.unlit)
        for m, out in zip(asset.meshes, clear, strict=True)
    ]


def count_kinds(asset: Asset) -> dict[str, Share]:
    """The share of each kind that an asset has; what is unlit is told apart."""
    apart = kept_apart(asset)
    found: dict[str, list[tuple[int, bool]]] = {kind: [] for kind in ("opaque", UNLIT, *KINDS[1:])}
    for mesh, out in zip(asset.meshes, apart, strict=True):
        kind = kind_of(mesh.material)
        found[UNLIT if kind == "opaque" and mesh.material.unlit else kind].append(
            (len(mesh.faces), out)
        )
    becomes = {kind: KEPT if any(out for _, out in n) else FITTED for kind, n in found.items()}
    return {
        k: Share(len(n), sum(count for count, _ in n), becomes[k]) for k, n in found.items() if n
    }


def separate_opaque(asset: Asset) -> Asset:
    """The asset with what is opaque all over told apart from what is not, where materials speak of
    transparency.

    Each connected part of a mesh is one or the other, by the alpha of the texels that its faces
    reach: one material may be that of a body and of its hair. Opaque parts get an opaque material,
    and a mesh of their own where their mesh has others; notes name the materials. Costs nothing
    without such materials.
    """
    if not any(map(seen_through, asset.meshes)):
        return asset
    tests = _Tests()
    solid: dict[int, Material] = {}
    meshes: list[Mesh] = []
    mixed: dict[str, int] = {}
    for mesh in asset.meshes:
        clear = _parts_with(mesh, ~tests.opaque(mesh)) if seen_through(mesh) else None
        if clear is None or clear.all():
            meshes.append(mesh)
            continue
        given = mesh.material
        opaque = solid.setdefault(
            id(given), replace(given, alpha_mode="opaque", opacity=1.0, transmission=0.0)
        )
        rest = _only(mesh, ~clear)
        colors = None if rest.colors is None else rest.colors[:, :3]
        meshes.append(replace(rest, material=opaque, colors=colors))
        if clear.any():
            meshes.append(_only(mesh, clear))
            mixed[given.name] = mixed.get(given.name, 0) + int((~clear).sum())
    notes = []
    whole = [m.name for m in solid.values() if m.name not in mixed]
    if whole:
        names = list_names(whole)
        notes.append(
            f"materials that speak of transparency are opaque wherever they are used, and count as that: {names}"
        )
    if mixed:
        told = f"{list_names(mixed)} ({sum(mixed.values())} triangles)"
        notes.append(
            f"parts of transparent materials that are opaque all over are told apart from the others: {told}"
        )
    return replace(asset, meshes=tuple(meshes), notes=(*asset.notes, *notes)) if notes else asset


def _parts_with(mesh: Mesh, marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(F,) faces of connected parts that have a marked face."""
    if marked.all() or not marked.any():
        return marked
    first, place = weld(mesh.positions)
    part = connected_parts(place[mesh.faces].astype(np.int64), len(first))
    return (np.bincount(part, marked) > 0)[part]


def _only(mesh: Mesh, chosen: NDArray[np.bool_]) -> Mesh:
    """The mesh with some of its faces, and what they use of its vertices."""
    if chosen.all():
        return mesh
    used, index = np.unique(mesh.faces[chosen], return_inverse=True)
    return mesh.take(used, index.reshape(-1, 3))


def list_names(names: Iterable[str]) -> str:
    """Names for a note, the first ``NAMED`` of them."""
    known = list(dict.fromkeys(names))
    more = f" and {len(known) - NAMED} more" if len(known) > NAMED else ""
    return ", ".join(f"'{n}'" for n in known[:NAMED]) + more


@dataclass
class _Tests:
    """Looks each texture up once."""

    _sums: dict[tuple[int, float], NDArray[np.int32] | None] = field(default_factory=dict)

    def opaque(self, mesh: Mesh) -> NDArray[np.bool_]:
        """(F,) faces that light does not pass."""
        m, count = mesh.material, len(mesh.faces)
        if m.transmission > 0:  # a texture that takes it all back is not worth a search
            nothing = (
                m.transmission_texture is not None
                and not m.transmission_texture.pixels[..., 0].any()
            )
            return np.full(count, nothing)
        needed = m.alpha_cutoff if m.alpha_mode == "mask" else OPAQUE
        if needed <= 0:
            return np.ones(count, bool)
        least = np.full(count, m.opacity)
        if mesh.colors is not None and mesh.colors.shape[1] == 4:
            least *= mesh.colors[:, 3][mesh.faces].min(axis=1)
        enough = least >= needed
        texture = m.base_color_texture
        if texture is None or texture.pixels.shape[2] < 4 or not enough.any():
            return enough
        sums = self._below(texture, needed / float(least[enough].min()))
        return enough if sums is None else enough & (_counts(sums, mesh, texture) == 0)

    def _below(self, texture: Texture, needed: float) -> NDArray[np.int32] | None:
        """(H + 1, W + 1) numbers of texels with less alpha than ``needed`` above and left of each
        corner of the grid; None if there are none at all."""
        key = id(texture), needed
        if key not in self._sums:
            alpha = texture.pixels[..., 3]
            top = np.iinfo(alpha.dtype).max if alpha.dtype.kind == "u" else 1
            below = alpha < np.float32(needed * top)
            sums = None
            if below.any():
                sums = np.zeros((below.shape[0] + 1, below.shape[1] + 1), np.int32)
                np.cumsum(below, axis=0, dtype=np.int32, out=sums[1:, 1:])
                np.cumsum(sums[1:, 1:], axis=1, out=sums[1:, 1:])
            self._sums[key] = sums
        return self._sums[key]


def _counts(sums: NDArray[np.int32], mesh: Mesh, texture: Texture) -> NDArray[np.int32]:
    """(F,) marked texels in the boxes around the faces, of those that bilinear lookups reach.
    ``sums``: see ``_Tests._below``. A face that crosses the border of the image, where it repeats,
    counts all of it."""
    size = np.array(sums.shape[::-1]) - 1
    if mesh.uvs is None:
        return np.full(len(mesh.faces), sums[-1, -1])
    corners = mesh.uvs.astype(np.float64)[mesh.faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    for axis in (0, 1):
        if texture.wrap[axis] == "repeat":  # into the period in which the box begins
            period = np.floor(low[:, axis])
            low[:, axis] -= period
            high[:, axis] -= period
    first, last = np.floor(low * size - 0.5), np.floor(high * size - 0.5) + 1
    clamped = np.array([w == "clamp" for w in texture.wrap])
    whole = (((first < 0) | (last >= size)) & ~clamped).any(axis=1)
    x0, y0 = np.clip(first, 0, size - 1).astype(np.int64).T
    x1, y1 = np.clip(last, 0, size - 1).astype(np.int64).T + 1
    inside = sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0]
    return np.where(whole, sums[-1, -1], inside)
