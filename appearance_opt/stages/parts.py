"""Which parts of an asset a job works on, and which pass into its result as they are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from appearance_opt.asset.alpha import kept_apart, list_names, seen_through, separate_opaque
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from appearance_opt.asset.types import Asset, Mesh


@dataclass(frozen=True)
class Parts:
    """``fitted``: what a job works on, with the notes and files of the whole; ``kept``: meshes that
    it leaves alone: they hide nothing of the others, cast no occlusion on them, and go to the
    result with all that they have."""

    fitted: Asset
    kept: tuple[Mesh, ...] = ()

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

    def describe_kept(self, becomes: str) -> list[str]:
        """Notes that name the kept meshes, or none without any. ``becomes``: what the job does with
        them."""
        if not self.kept:
            return []
        out = []
        for what, seen in (("transparent", True), ("unlit", False)):
            meshes = [m for m in self.kept if seen_through(m) == seen]
            if meshes:
                names, count = list_names(m.name for m in meshes), sum(len(m.faces) for m in meshes)
                out.append(f"{what} parts {becomes}: {len(meshes)} ({names}) of {count} triangles")
        return out


def split(asset: Asset, name: str, job: str, by_light: bool = True) -> Parts:
    """What a job works on, and what it keeps (see ``alpha.kept_apart``). Raises InputError if
    nothing is left to fit. ``name`` of the asset, and what the ``job`` does to it, for the
    message."""
    asset = separate_opaque(asset)
    apart = kept_apart(asset, by_light)
    kept = tuple(m for m, out in zip(asset.meshes, apart, strict=True) if out)
    fitted = tuple(m for m, out in zip(asset.meshes, apart, strict=True) if not out)
    if not fitted:
        raise InputError(
            f"{name}: all of it is transparent ({list_names(m.material.name for m in kept)}), and "
            f"transparent parts are kept as they are: there is nothing to {job}; "
            "materials that shall count as opaque must say so"
        )
    return Parts(replace(asset, meshes=fitted) if kept else asset, kept)
