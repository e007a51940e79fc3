"""Which parts of an asset a job works on, and which pass into its result as they are."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

from appearance_opt.asset.alpha import kept_apart, list_names, seen_through, separate_opaque
from appearance_opt.asset.hierarchy import merge_nodes
from appearance_opt.asset.notes import counted
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from appearance_opt.asset.types import Asset, Mesh

CROWD = 100
"""Parts of a result from which on a note tells what each costs."""


@dataclass(frozen=True)
class Parts:
    """``fitted``: what a job works on, with the notes and files of the whole; ``kept``: meshes that
    it leaves alone: they hide nothing of the others, cast no occlusion on them, and go to the
    result with all that they have. ``named``: numbers of those that the user asked to keep."""

    fitted: Asset
    kept: tuple[Mesh, ...] = ()
    named: frozenset[int] = frozenset()

    @property
    def kept_triangles(self) -> int:
        """Triangles that are left alone."""
        return sum(len(m.faces) for m in self.kept)

    @property
    def whole(self) -> Asset:
        """All of the asset, the kept meshes last."""
        return self.with_kept(self.fitted)

    def with_kept(self, result: Asset) -> Asset:
        """What became of ``fitted``, with the kept meshes after it."""
        return replace(result, meshes=(*result.meshes, *self.kept)) if self.kept else result

    def merged(self) -> Parts:
        """The same without nodes: what is fitted becomes one part."""
        whole = merge_nodes(self.whole)
        count = len(self.fitted.meshes)
        fitted = replace(whole, meshes=whole.meshes[:count])
        return replace(self, fitted=fitted, kept=whole.meshes[count:])

    def describe_kept(self, becomes: str) -> list[str]:
        """Notes that name the kept meshes, or none without any. ``becomes``: what the job does with
        them."""
        kinds: dict[str, list[Mesh]] = {"transparent": [], "unlit": [], "named": []}
        for k, m in enumerate(self.kept):
            kinds[
                "named" if k in self.named else "transparent" if seen_through(m) else "unlit"
            ].append(m)
        out = []
        for what, meshes in kinds.items():
            if meshes:
                names, count = list_names(m.name for m in meshes), sum(len(m.faces) for m in meshes)
                out.append(f"{what} parts {becomes}: {len(meshes)} ({names}) of {count} triangles")
        return out

    def describe_nodes(self, result: Asset) -> list[str]:
        """Notes on the parts that ``fitted`` is made of, and what became of them in a ``result``."""
        before, after = ({m.node for m in a.meshes} - {None} for a in (self.fitted, result))
        gone, out = sorted(before - after), []  # type: ignore[type-var]
        if gone:
            names = list_names(self.fitted.nodes[k].name for k in gone if k is not None)
            out.append(f"nothing is left of {counted(len(gone), 'part')} at this budget ({names})")
        if len(after) > CROWD:
            out.append(
                f"the result has {len(after):,} parts, each of which an engine draws by itself; "
                "--parts merge makes them one"
            )
        return out


def split(
    asset: Asset, name: str, job: str, by_light: bool = True, named: Sequence[str] = ()
) -> Parts:
    """What a job works on, and what it keeps: see ``alpha.kept_apart``, and what is ``named``:
    nodes, with all that is below them, and materials. Raises InputError if nothing is left to fit,
    or nothing bears such a name. ``name`` of the asset, and what the ``job`` does to it, for the
    message."""
    asset = separate_opaque(asset)
    chosen = _chosen(asset, named)
    apart = [a or c for a, c in zip(kept_apart(asset, by_light), chosen, strict=True)]
    kept = tuple(m for m, out in zip(asset.meshes, apart, strict=True) if out)
    fitted = tuple(m for m, out in zip(asset.meshes, apart, strict=True) if not out)
    if not fitted and any(chosen):
        raise InputError(
            f"--keep {', '.join(named)}: keeps all of {name}: nothing is left to {job}"
        )
    if not fitted:
        raise InputError(
            f"{name}: all of it is transparent ({list_names(m.material.name for m in kept)}), and "
            f"transparent parts are kept as they are: there is nothing to {job}; "
            "materials that shall count as opaque must say so"
        )
    told = [c for c, out in zip(chosen, apart, strict=True) if out]
    by_name = frozenset(k for k, c in enumerate(told) if c)
    return Parts(replace(asset, meshes=fitted) if kept else asset, kept, by_name)


def _chosen(asset: Asset, named: Sequence[str]) -> list[bool]:
    """Which meshes bear one of these names: their own, or that of their material, their node, or
    one above it. Raises InputError for a name that none bears."""
    bears: list[set[str]] = []
    for mesh in asset.meshes:
        names, node = {mesh.name, mesh.material.name}, mesh.node if asset.nodes else None
        while node is not None:
            names.add(asset.nodes[node].name)
            node = asset.nodes[node].parent
        bears.append(names)
    out = [False] * len(bears)
    for pattern in named:
        found = [any(fnmatchcase(n, pattern) for n in names) for names in bears]
        if not any(found):
            known = {n.lower(): n for names in bears for n in names}
            close = difflib.get_close_matches(pattern.lower(), sorted(known), 1, 0.4)
            hint = f"did you mean '{known[close[0]]}'? " if close else ""
            raise InputError(
                f"--keep {pattern}: no node or material has that name; {hint}there are "
                f"{list_names(sorted(known.values()))}"
            )
        out = [a or b for a, b in zip(out, found, strict=True)]
    return out
