"""PLY: geometry alone, through trimesh."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.creases import shaded
from appearance_opt.asset.normals import unit
from appearance_opt.asset.origin import settle
from appearance_opt.asset.paths import read_bytes
from appearance_opt.asset.types import Asset, Material, Mesh, srgb_to_linear
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    import trimesh
    from numpy.typing import NDArray


def load_geometry(path: Path, keep_layout: bool = False) -> Asset:
    """Read a .ply file. Without normals, edges sharp by ``creases.smooth_by_angle`` are hard.
    ``keep_layout``: see ``asset.load``. Raises InputError."""
    import io

    import trimesh

    path = Path(path)
    data = read_bytes(path)
    notes = ["no material in this format: a default one is used"]
    data = _plain_ply(data, path, notes)
    try:
        loaded = trimesh.load(io.BytesIO(data), file_type="ply", process=False, force="mesh")
    except Exception as error:  # trimesh's readers raise anything on damaged files
        raise InputError(f"{path}: not a readable PLY file ({type(error).__name__})") from error
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise InputError(f"{path}: there are no triangles in it")
    positions = np.asarray(loaded.vertices, np.float64)
    faces = np.asarray(loaded.faces, np.int32)
    colors = None
    if loaded.visual.kind == "vertex":
        colors = srgb_to_linear(np.asarray(loaded.visual.vertex_colors[:, :3], np.float32) / np.float32(255))
    normals = _normals(loaded)
    material = Material(name=path.stem, roughness=0.8)
    mesh = Mesh(positions, faces, normals, colors=colors, material=material, name=path.stem)  # type: ignore[arg-type]
    meshes, origin = settle([mesh], notes.append)
    if not keep_layout:
        meshes = shaded(meshes)
    return Asset(tuple(meshes), path.stem, tuple(notes), origin=origin)


def _normals(loaded: trimesh.Trimesh) -> NDArray[np.float32] | None:
    """(V, 3) normals of the vertices of a file, None if it has none: trimesh hands out others then."""
    vertex = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    try:
        given = np.stack([np.asarray(vertex[name], np.float64).ravel() for name in ("nx", "ny", "nz")], axis=1)
    except (KeyError, ValueError, TypeError, IndexError):
        return None
    if len(given) != len(loaded.vertices) or not given.any():
        return None
    return unit(given).astype(np.float32)


def _plain_ply(data: bytes, path: Path, notes: list[str]) -> bytes:
    """A PLY file without the name of a picture in its header, which trimesh would look for. Raises InputError if it
    has triangle strips, which trimesh passes over."""
    header, end, body = data.partition(b"end_header")
    if not end:
        return data
    lines = header.split(b"\n")
    if any(line.split()[:2] == [b"element", b"tristrips"] for line in lines):
        raise InputError(f"{path}: triangle strips are not supported; save it with faces")
    kept = [line for line in lines if line.split()[:2] != [b"comment", b"TextureFile"]]
    if len(kept) < len(lines):
        notes.append("its texture is ignored")
    return b"\n".join(kept) + end + body
