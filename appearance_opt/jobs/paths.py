"""What a job may write where: checked before any work."""

from __future__ import annotations

from fnmatch import fnmatchcase
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING

from appearance_opt.asset import check_folder, check_writable
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from appearance_opt.asset.types import Asset


def check_paths(
    source: str | Path | Asset | None,
    out: str | Path | None,
    *folders: str | Path | None,
) -> None:
    """Raise InputError if results could not be written, or would replace the input. ``folders``: others that
    will be written to (report, checkpoint, textures)."""
    if out is not None:
        check_writable(Path(out))
        check_folder(Path(out).parent)
        if isinstance(source, (str, Path)) and Path(out).resolve() == Path(source).resolve():
            raise InputError(f"{out}: is the input itself, which is never changed; choose another name")
    for folder in folders:
        if folder is not None:
            check_folder(Path(folder))


def check_replaces(assets: Iterable[Asset], out: str | Path | None, textures: str | Path | None = None) -> None:
    """Raise InputError if writing ``out``, or loose maps into ``textures``, could replace a file that one of the assets
    was read from: a material file, a buffer, a picture."""
    if out is None:
        return
    out = Path(out)
    written = [(out.parent, name) for name in (escape(out.name), *_beside(out))]
    written += [(out.with_name(out.stem + folder), "*") for folder in ("_textures", "_maps")]
    if textures is not None:
        written.append((Path(textures), f"{escape(out.stem)}_*"))
    for file in (file for asset in assets for file in asset.files):
        if any(file.parent == folder.resolve() and fnmatchcase(file.name, name) for folder, name in written):
            raise InputError(
                f"{out}: writing it could replace '{file}', which the input refers to and which is never changed; "
                "choose another name or folder"
            )


def _beside(out: Path) -> tuple[str, ...]:
    """Patterns of the names that the writers of ``asset`` and ``jobs.displaced`` give to what lies beside ``out``."""
    stem = escape(out.stem)
    displacement = f"{stem}_displacement*.png"
    return {
        ".obj": (f"{stem}.mtl", f"{stem}_*.png"),
        ".gltf": (f"{stem}.bin", f"{stem}_[0-9]*.png", displacement),
    }.get(out.suffix.lower(), (displacement,))
