"""What a job may write where: checked before any work."""

from __future__ import annotations

import os
import shutil
import tempfile
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING

from appearance_opt.asset import check_folder, check_writable
from appearance_opt.asset.file_options import USD
from appearance_opt.asset.paths import MAX_NAME
from appearance_opt.asset.texture_files import SUFFIXES
from appearance_opt.errors import InputError
from appearance_opt.lock import lock_path, locked
from appearance_opt.optimize.archive import FILES as CHECKPOINT_FILES
from appearance_opt.options.files import OutputOptions
from appearance_opt.publish import recover

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from appearance_opt.asset.types import Asset
    from appearance_opt.config import CommonOptions

REPORT_FILES = ("report.html", "report.json", "view[0-9]*_*.png", "map_*.png")
"""Patterns of the names in a report."""

SUFFIX = "_M000_" + MAX_NAME * "x" + "_displacement.png"
"""The longest that writers add to the stem of a result, about, where they name pictures after
materials."""

BYTES_PER_TRIANGLE, BYTES_PER_TEXEL = 150, 12
"""Of a result: vertices, their attributes and indices as text or binary; four maps of three bytes,
not compressed."""

STATE_BYTES_PER_TEXEL = 400
"""Of a checkpoint: nine channels of a start, and of a fit value, two moments, mean and best value
of each, twice while one state takes the place of another."""

REPORT_BYTES = 20 << 20


@dataclass(frozen=True)
class Outputs:
    """All that a job writes. ``out``: the result, with what its writer puts beside it; ``levels``:
    tessellation levels that are written beside it, too; ``finest``: that of a displaced mesh, None
    without displacement; ``lods``: so many levels of detail that are files of their own, too;
    ``report``, ``checkpoint``, ``loose`` (of
    a bake's maps): folders."""

    out: Path | None = None
    report: Path | None = None
    checkpoint: Path | None = None
    loose: Path | None = None
    levels: tuple[int, ...] = ()
    finest: int | None = None
    lods: int = 0
    output: OutputOptions = field(default_factory=OutputOptions)

    @classmethod
    def of(
        cls,
        out: str | Path | None,
        options: CommonOptions | None = None,
        *,
        report: str | Path | None = None,
        checkpoint: str | Path | None = None,
        loose: str | Path | None = None,
        lods: int = 0,
    ) -> Outputs:
        """From what a job was given. ``options``: how results are written, and are tessellated
        meshes, too?"""
        levels = (
            options.levels()
            if options is not None and options.displacement.write_tessellated
            else ()
        )
        out, report, checkpoint, loose = (
            None if path is None else Path(path) for path in (out, report, checkpoint, loose)
        )
        if options is None:
            return cls(out, report, checkpoint, loose, levels, lods=lods)
        finest = max(options.levels()) if options.displacement.fitted else None
        return cls(out, report, checkpoint, loose, levels, finest, lods, options.output)

    @property
    def results(self) -> tuple[Path, ...]:
        """Files in the format of the result."""
        return tuple(path for path, _ in self._results())

    def _results(self) -> list[tuple[Path, int]]:
        """(file in the format of the result, tessellation level of the mesh in it)."""
        if self.out is None:
            return []
        out = [(level_path(self.out, level), level) for level in self.levels]
        out += [(lod_path(self.out, k), 0) for k in range(self.lods)]
        if self.finest is None or holds_displacement(self.out):
            return [(self.out, 0), *out]
        return [(self.out, self.finest), (base_path(self.out), 0), *out]

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folders with other files."""
        return tuple(p for p in (self.report, self.checkpoint, self.loose) if p is not None)

    def patterns(self) -> list[tuple[Path, str]]:
        """(folder, pattern of names) of all files that could be written or replaced."""
        out = []
        for path in self.results:
            out += [(path.parent, name) for name in (escape(path.name), *_beside(path))]
            out += [(path.with_name(path.stem + folder), "*") for folder in ("_textures", "_maps")]
        if self.report is not None:
            out += [(self.report, name) for name in REPORT_FILES]
        if self.checkpoint is not None:
            out += [(self.checkpoint, name) for name in CHECKPOINT_FILES]
        if self.loose is not None and self.out is not None:
            out.append((self.loose, f"{escape(self.out.stem)}_*"))
        return out

    def check(self) -> None:
        """Raise InputError if something could not be written where it is to be."""
        for path in self.results:
            longest = path.stem + (SUFFIX if path.suffix.lower() == ".obj" else "_textures")
            _check_names(path, [lock_path(path).name, longest])
            check_writable(path)
            self.output.for_file(path)
            check_folder(path.parent)
        for folder in self.folders:
            _check_names(folder, [folder.name])
            check_folder(folder)

    def check_sources(self, *sources: object) -> None:
        """Raise InputError if writing could replace a file that the user named (others than paths
        are passed over)."""
        files = [Path(s) for s in sources if isinstance(s, (str, Path))]
        named = {file.resolve() for file in files}
        for path in self.results:
            if path.resolve() in named:
                raise InputError(
                    f"{path}: is the input itself, which is never changed; choose another name"
                )
        self._check_files(files)

    def check_inputs(self, *assets: Asset | None) -> None:
        """Raise InputError if writing could replace a file that an asset was read from."""
        self._check_files(file for asset in assets if asset is not None for file in asset.files)

    def _check_files(self, files: Iterable[Path]) -> None:
        patterns = [(folder.resolve(), pattern) for folder, pattern in self.patterns()]
        for file in files:
            # a link would be replaced itself, not what it leads to
            for at in {file.parent.resolve() / file.name, file.resolve()}:
                if any(
                    at.parent == folder and fnmatchcase(at.name, name) for folder, name in patterns
                ):
                    raise InputError(
                        f"{self.out or self.report}: writing it could replace '{file}', which the input refers to "
                        "and which is never changed; choose another name or folder"
                    )

    def check_room(self, triangles: int, options: CommonOptions | None) -> None:
        """Raise InputError if a result of so many triangles would not fit on the disks, as far as
        can be told."""
        texels = 0 if options is None else options.texture.size**2
        need: list[tuple[Path, int]] = [(Path(tempfile.gettempdir()), 3 * texels)]
        for path, level in self._results():
            size = BYTES_PER_TRIANGLE * triangles * 4**level + BYTES_PER_TEXEL * texels
            need.append((path.parent, size))
        if self.loose is not None:
            need.append((self.loose, BYTES_PER_TEXEL * texels))
        if self.report is not None:
            need.append((self.report, REPORT_BYTES))
        if self.checkpoint is not None:
            need.append((self.checkpoint, STATE_BYTES_PER_TEXEL * texels))
        disks: dict[int, tuple[Path, int]] = {}
        for folder, size in need:
            there = next(p for p in (folder, *folder.resolve().parents) if p.exists())
            device = there.stat().st_dev
            disks[device] = (
                disks.get(device, (there, 0))[0],
                disks.get(device, (there, 0))[1] + size,
            )
        for there, size in disks.values():
            free = shutil.disk_usage(there).free
            if size > free:
                raise InputError(
                    f"{there}: what is to be written takes up to {size / 2**20:.0f} MiB, and {free / 2**20:.0f} MiB "
                    "are free on that disk; make room, or choose another folder or a smaller --texture-size"
                )

    @contextmanager
    def held(self) -> Iterator[None]:
        """While the job runs, no other run may write there. Raises InputError if one does. What a
        killed run has left half done there is undone first."""
        with ExitStack() as stack:
            if self.out is not None:
                stack.enter_context(locked(self.out.resolve()))
                recover(self.out.resolve().parent)
            for folder in {p.resolve() for p in (self.report, self.checkpoint) if p is not None}:
                stack.enter_context(locked(folder, folder=True))
                recover(folder)
            yield


def level_path(out: Path, level: int) -> Path:
    """Where the mesh of a tessellation level goes: ``<stem>_level<k><suffix>`` beside ``out``."""
    return out.with_name(f"{out.stem}_level{level}{out.suffix}")


def base_path(out: Path) -> Path:
    """Where the base mesh of a displaced result goes whose format has no place for a displacement
    map: ``<stem>_base<suffix>`` beside ``out``."""
    return out.with_name(f"{out.stem}_base{out.suffix}")


def holds_displacement(out: Path) -> bool:
    """Has the format of a file a place for a displacement map, which its readers heed?"""
    return out.suffix.lower() in USD


def lod_path(out: Path, level: int) -> Path:
    """Where a level of detail goes that is a file of its own: ``<stem>_lod<k><suffix>``."""
    return out.with_name(f"{out.stem}_lod{level}{out.suffix}")


def _check_names(path: Path, names: list[str]) -> None:
    """Raise InputError if one of ``names`` is longer than the file system takes."""
    try:
        there = next(p for p in path.absolute().parents if p.exists())
        most = os.pathconf(there, "PC_NAME_MAX")
    except (OSError, ValueError):
        return
    for name in names:
        if len(os.fsencode(name)) > most:
            excess = len(os.fsencode(name)) - most
            raise InputError(
                f"{path.parent / path.name[:40]}...: the name is too long by {excess} bytes for what is written under "
                "it or beside it; choose a shorter one"
            )


def _beside(out: Path) -> tuple[str, ...]:
    """Patterns of the names that the writers of ``asset`` and ``stages.displacement`` give to what lies
    beside ``out``."""
    stem = escape(out.stem)
    displacement = f"{stem}_displacement*.png"
    return {
        ".obj": (f"{stem}.mtl", *(f"{stem}_*{s}" for s in SUFFIXES.values())),
        ".gltf": (f"{stem}.bin", *(f"{stem}_[0-9]*{s}" for s in SUFFIXES.values()), displacement),
    }.get(out.suffix.lower(), (displacement,))
