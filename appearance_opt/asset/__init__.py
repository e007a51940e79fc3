"""Host-side data and the only doors to disk: ``load`` and ``save``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from appearance_opt.asset.companions import CHOICES, Companions, MissingTextures
from appearance_opt.asset.file_options import PLAIN, FileOptions
from appearance_opt.asset.types import Asset, Displacement, Material, Mesh, Texture
from appearance_opt.errors import InputError
from appearance_opt.publish import publishing

__all__ = ["Asset", "Displacement", "FileOptions", "Material", "Mesh", "Texture", "load", "save"]

READABLE = (".glb", ".gltf", ".usd", ".usda", ".usdc", ".usdz", ".obj", ".ply", ".stl")
MAX_REFINE = 5
"""Level to which subdivision surfaces are refined at the most: each makes four faces of one."""

WRITABLE = (".glb", ".gltf", ".usd", ".usda", ".usdc", ".usdz", ".obj")


def load(
    path: str | Path,
    *,
    refine: int = 1,
    variants: dict[str, str] | None = None,
    missing_textures: MissingTextures = "error",
    root: str | Path | None = None,
    crease_angle: float | None = None,
    keep_layout: bool = False,
    mend: bool = True,
    keep_rig: bool = False,
) -> Asset:
    """Read an asset; the suffix chooses the format. Units become metres, the up axis +Y.

    ``refine``: level to which USD subdivision surfaces are refined. ``variants``: USD variant
    selections by set name, instead of those in the file; for glTF, {"": name} chooses one of its
    material variants. ``missing_textures``: "error" refuses an asset that names a texture file
    which is not there, "ignore" goes on with the material's constants (without a normal map, if it
    is that) and a note. ``root``: folder in which files that it refers to may lie, beside its own.
    ``crease_angle``: of files that say nothing of normals (STL, some PLY and OBJ): degrees between
    the normals of two faces above which the edge between them is hard; None: 40, and more where the
    surface is noisy. ``keep_layout``: for a mesh to be baked onto, whose vertices and texture
    coordinates stay as the file has them: no transform of a texture is applied to them, and
    vertices of a mesh without normals are not split at hard edges. ``keep_rig``: with what moves
    the meshes (``Asset.rig``), these in its bind space instead of at rest. Harmless faults are repaired and
    noted in ``Asset.notes``, unless ``mend`` is off. Raises InputError for everything else, naming
    the file.
    """
    path = Path(path)
    if missing_textures not in CHOICES:
        raise InputError(f"--missing-textures {missing_textures}: choose from {', '.join(CHOICES)}")
    suffix = path.suffix.lower()
    if suffix not in READABLE:
        raise InputError(f"{path}: unknown format '{suffix}'; readable are {' '.join(READABLE)}")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if not isinstance(refine, int) or not 0 <= refine <= MAX_REFINE:
        raise InputError(f"--refine {refine}: must be from 0 to {MAX_REFINE}")
    if root is not None and not Path(root).is_dir():
        raise InputError(f"--root {root}: no such folder")
    if crease_angle is not None and not 0 <= crease_angle <= 180:
        raise InputError(f"--crease-angle {crease_angle}: must be from 0 to 180 degrees")
    import numpy as np

    from appearance_opt.asset.door import reading, with_text_names
    from appearance_opt.asset.validate import repair

    # numbers that do not fit a float32 become infinite, which ``repair`` refuses by name
    with reading(path), np.errstate(over="ignore", invalid="ignore"):
        companions = Companions(missing_textures, None if root is None else Path(root))
        asset = with_text_names(
            _read(path, suffix, refine, variants, companions, keep_layout, crease_angle, keep_rig)
        )
        asset = replace(asset, files=(path.resolve(), *dict.fromkeys(companions.files)))
        return repair(asset, str(path)) if mend else asset


def _read(
    path: Path,
    suffix: str,
    refine: int,
    variants: dict[str, str] | None,
    companions: Companions,
    keep_layout: bool,
    crease_angle: float | None,
    keep_rig: bool,
) -> Asset:
    if suffix in (".glb", ".gltf"):
        from appearance_opt.asset.gltf_read import load_gltf

        return load_gltf(path, companions, keep_layout, _name_of_variant(variants, path), keep_rig)
    if variants and suffix in (".obj", ".ply", ".stl"):
        raise InputError(f"{path}: {suffix} files have no variants; leave --variant out")
    if suffix == ".obj":
        from appearance_opt.asset.obj import load_obj

        return load_obj(path, companions, keep_layout, crease_angle)
    if suffix == ".ply":
        from appearance_opt.asset.ply import load_ply

        return load_ply(path, companions, keep_layout, crease_angle)
    if suffix == ".stl":
        from appearance_opt.asset.stl import load_stl

        return load_stl(path, keep_layout, crease_angle)
    from appearance_opt.asset.usd_read import load_usd

    return load_usd(path, refine, variants, companions, keep_layout, keep_rig)


def _name_of_variant(variants: dict[str, str] | None, path: Path) -> str | None:
    """glTF has one set of variants, which has no name: what looks like one belongs to the variant's
    name."""
    names = ["=".join(filter(None, v)) for v in (variants or {}).items()]
    if len(names) > 1:
        raise InputError(
            f"{path}: --variant {', '.join(names)}: glTF files show one variant at a time"
        )
    return names[0] if names else None


def save(asset: Asset, path: str | Path, options: FileOptions = PLAIN) -> None:
    """Write an asset; the suffix chooses the format, ``options`` codecs and compression. The files
    of a format that has several appear together or not at all. Raises InputError for what cannot be
    written, OSError when the disk refuses."""
    path = Path(path)
    check_writable(path)
    options.check(path)
    with publishing(path) as place:
        write(asset, place, options)


HOLDS_LEVELS = tuple(suffix for suffix in WRITABLE if suffix != ".obj")
"""Formats whose files can hold several levels of detail."""


def write(
    asset: Asset,
    path: Path,
    options: FileOptions = PLAIN,
    coarser: Sequence[Asset] = (),
    coverage: Sequence[float] = (),
) -> None:
    """Write an asset's files where they are to be, one after the other: for places of a
    publication. ``coarser``, ``coverage``: see ``save_gltf``; formats that cannot hold levels
    (see ``HOLDS_LEVELS``) leave them out. Raises OSError."""
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        from appearance_opt.asset.gltf_write import save_gltf

        save_gltf(asset, path, options, coarser, coverage)
    elif suffix == ".obj":
        from appearance_opt.asset.obj_write import save_obj

        save_obj(asset, path, options)
    else:
        from appearance_opt.asset.usd_write import save_usd

        save_usd(asset, path, options, coarser)


def check_writable(path: Path) -> None:
    """Raise InputError if the format of ``path`` cannot be written, or its folder not be used."""
    suffix = path.suffix.lower()
    if suffix not in WRITABLE:
        raise InputError(
            f"{path}: cannot write '{suffix}' files; choose one of {' '.join(WRITABLE)}"
        )
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file in it")
    _existing(path.parent, path)


def check_folder(folder: Path) -> None:
    """Raise InputError if files cannot be created in ``folder``, or it cannot be made. Leaves
    nothing behind."""
    import tempfile

    there = _existing(Path(folder), Path(folder))
    try:
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        raise InputError(
            f"{folder}: nothing can be written there ({error.strerror}); choose another folder"
        ) from None


def _existing(folder: Path, path: Path) -> Path:
    """The nearest folder that exists, from ``folder`` upwards. Raises InputError if it is no
    folder."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    if not folder.is_dir():
        raise InputError(f"{path}: '{folder}' is not a folder")
    return folder
