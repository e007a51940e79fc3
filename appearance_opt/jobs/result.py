"""What jobs hand back, and all that a report knows of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from appearance_opt.asset import write

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from appearance_opt.asset.file_options import FileOptions
    from appearance_opt.asset.types import Asset
    from appearance_opt.errors import AppearanceError, DivergedError
    from appearance_opt.evaluate.chart import Chart
    from appearance_opt.evaluate.motion import Motion
    from appearance_opt.optimize.loop import FitResult
    from appearance_opt.stages.export import Exported
    from appearance_opt.stages.parts import Parts


@dataclass
class Result:
    """What a job did.

    ``asset``: the result, with a displacement map if there is one. ``columns``: by name, what a report shows beside the
    source, the start first and what came of it last. ``fit``: curve and counts, None without one.
    ``title`` of a report, ``facts`` that it lists by name, ``pictures`` (H, W, 3) that it shows
    beside those of the maps, ``charts`` that it draws. ``notes``: what the user should know, a line each. ``seconds``:
    wall-clock time by stage. ``files``: those that hold the asset, if it was written, the main one
    first. ``error``: set when the fit diverged, or a bound that is strict was
    not met (jobs raise it after the best state is written).
    """

    asset: Asset
    columns: dict[str, Asset]
    fit: FitResult | None = None
    title: str = ""
    facts: dict[str, object] = field(default_factory=dict)
    pictures: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    charts: list[Chart] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    error: AppearanceError | None = None

    def write(self, asset: Asset, path: Path, options: FileOptions) -> None:
        """Write the files of ``asset``, what its format can hold of the result, where they are to
        be. Raises OSError."""
        write(asset, path, options)

    @property
    def start(self) -> Asset:
        """The same before the fit."""
        return next(iter(self.columns.values()))

    def outcome(self) -> str:
        """What came of it, in a few words."""
        return self.title

    def lines(self) -> list[str]:
        """What a terminal shows of it."""
        line = f"{self.outcome()}, {self.seconds['total']:.1f} s"
        if self.fit is not None and self.fit.curve:
            psnr = [point.psnr for point in self.fit.curve]
            line += f", held-out PSNR {psnr[0]:.2f} -> {max(psnr):.2f} dB"
        return [line]

    def record(self) -> dict[str, Any]:
        """Numbers of it for JSON; PSNR in dB, before the fit and of the best state."""
        psnr = [] if self.fit is None else [point.psnr for point in self.fit.curve]
        return {
            **self.facts,
            "held_out_psnr": [psnr[0], max(psnr)] if psnr else None,
            "steps": 0 if self.fit is None else self.fit.steps,
            "seconds": self.seconds,
            "notes": self.notes,
        }

    def motion(self) -> Motion | None:
        """What a report shows of how it moves; None for what stands still."""
        return None

    @property
    def drawn(self) -> Asset:
        """The result for formats that have no place for a displacement map."""
        return self.asset

    @property
    def shown(self) -> Asset:
        """What is to be looked at: with a displacement map, the finest tessellated mesh."""
        return list(self.columns.values())[-1]


@dataclass
class SimplifyResult(Result):
    """What a job did that fits a mesh (``simplify``, ``joint``, ``fit``).

    The first meshes of ``asset`` were fitted: one for each node of the source, two where some of
    its faces are seen from one side and others from both. The others passed through: they have
    ``kept_triangles``, which ``triangles`` and ``source_triangles`` do not count. ``tessellated``:
    with a displacement map, the mesh as drawn at each level (and ``start`` at the finest one).
    """

    fit: FitResult = field(kw_only=True)
    triangles: int = field(kw_only=True)
    source_triangles: int = field(kw_only=True)
    kept_triangles: int = 0
    tessellated: dict[int, Asset] = field(default_factory=dict)

    @property
    def drawn(self) -> Asset:
        """See ``Result``: the finest tessellated mesh."""
        return self.tessellated[max(self.tessellated)] if self.tessellated else self.asset

    @classmethod
    def of(
        cls,
        exported: Exported,
        parts: Parts,
        fit: FitResult,
        source: tuple[str, int],
        notes: Iterable[str],
        error: DivergedError | None = None,
    ) -> SimplifyResult:
        """What was fitted, with the ``parts`` that were left alone after it. ``source``: name of
        what it was fitted to, and number of its triangles (0: it has none)."""
        name, before = source
        asset, start, after = exported.asset, exported.start, exported.asset.triangle_count
        levels = {k: parts.with_kept(a) for k, a in exported.levels.items()}
        kept = parts.with_kept(asset)
        last = {f"level {k}": a for k, a in levels.items()} or {"result": kept}
        return cls(
            kept,
            {"start": parts.with_kept(start), **last},
            title=f"{name}: {f'{before:,} to ' if before else ''}{after:,} triangles",
            facts={"triangles": f"{after} of {before}" if before else after},
            notes=[*notes, *fit.notes()],
            error=error,
            fit=fit,
            triangles=after,
            source_triangles=before,
            kept_triangles=parts.kept_triangles,
            tessellated=levels,
        )

    def outcome(self) -> str:
        """Triangles before and after."""
        kept = f" and {self.kept_triangles} kept as they are" if self.kept_triangles else ""
        return f"{self.facts['triangles']} triangles{kept}"


@dataclass
class BakeResult(Result):
    """What ``bake`` did. ``asset``: LOW with the maps. ``maps``: channel name -> (size, size),
    lengths in metres; ``covered``, ``missed``: texels of charts, and those whose rays found
    nothing; ``reach``: how far rays went, metres."""

    maps: dict[str, NDArray[np.float32]] = field(kw_only=True)
    covered: NDArray[np.bool_] = field(kw_only=True)
    missed: NDArray[np.bool_] = field(kw_only=True)
    reach: float = field(kw_only=True)

    def outcome(self) -> str:
        """How much of LOW found nothing of HIGH."""
        return f"{100 * self.missed_share:.2f} % of the texels missed"

    @property
    def closed_form(self) -> Asset:
        """LOW with the maps before the fit."""
        return self.start

    @property
    def missed_share(self) -> float:
        """Fraction of the covered texels whose rays found nothing."""
        return float(self.missed.sum() / max(int(self.covered.sum()), 1))
