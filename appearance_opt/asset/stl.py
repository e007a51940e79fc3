"""STL: triangles without shared vertices, some with colours."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.creases import shaded
from appearance_opt.asset.normals import weld
from appearance_opt.asset.origin import settle
from appearance_opt.asset.paths import read_bytes
from appearance_opt.asset.types import Asset, Material, Mesh, srgb_to_linear
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

_OWN = 1 << 15
"""The bit that says what the other fifteen of a facet's attribute mean."""


def load_stl(path: Path, keep_layout: bool = False) -> Asset:
    """Read an STL file: vertices at one place are one, edges sharp by ``creases.smooth_by_angle`` are
    hard. ``keep_layout``: see ``asset.load``. Raises InputError."""
    import trimesh

    path = Path(path)
    data = read_bytes(path)
    notes = ["no material in this format: a default one is used"]
    try:
        loaded = trimesh.load(io.BytesIO(data), file_type="stl", process=False, force="mesh")
    except Exception as error:  # trimesh's readers raise anything on damaged files
        raise InputError(f"{path}: not a readable STL file ({type(error).__name__})") from error
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise InputError(f"{path}: there are no triangles in it")
    attribute = loaded.face_attributes.get("stl")
    colors = None if attribute is None else facet_colors(data[:80], np.asarray(attribute), notes.append)
    first, place = weld(np.asarray(loaded.vertices, np.float64))
    positions, faces = np.asarray(loaded.vertices, np.float64)[first], place[loaded.faces]
    vertex_colors = None
    if colors is not None:  # a vertex for each colour at a place
        values, kind = np.unique(colors, axis=0, return_inverse=True)
        pair, new = np.unique(faces * len(values) + kind.reshape(-1, 1), return_inverse=True)
        positions, faces = positions[pair // len(values)], new.reshape(-1, 3)
        vertex_colors = srgb_to_linear(values.astype(np.float32))[pair % len(values)]
    material = Material(name=path.stem, roughness=0.8)
    mesh = Mesh(positions, faces.astype(np.int32), colors=vertex_colors, material=material, name=path.stem)  # type: ignore[arg-type]
    meshes, origin = settle([mesh], notes.append)
    if not keep_layout:
        meshes = shaded(meshes)
    return Asset(tuple(meshes), path.stem, tuple(notes), origin=origin)


def facet_colors(
    header: bytes, attribute: NDArray[np.uint16], note: Callable[[str], None]
) -> NDArray[np.float64] | None:
    """(F, 3) colours of the facets of a binary file, encoded as sRGB, from their ``attribute`` (F,); None
    if they have none. ``header``: of 80 bytes.

    Two conventions have five bits for each channel. Materialise Magics writes ``COLOR=`` and four bytes
    of red, green, blue and alpha into the header: the colour of the facets whose highest bit is set;
    the others have their own, red in the lowest bits. VisCAM and SolidView write no such header; a
    facet has a colour, blue in the lowest bits, if its highest bit is set, and is white otherwise.
    """
    bits = attribute.astype(np.int64)
    at = header.find(b"COLOR=")
    low, middle, high = (((bits >> shift) & 31) / 31 for shift in (0, 5, 10))
    if at >= 0 and at + 10 <= len(header):
        red, green, blue, alpha = header[at + 6 : at + 10]
        if alpha < 255:
            note("the alpha of its colours (Materialise Magics) is ignored")
        whole = np.array([red, green, blue]) / 255
        return np.where((bits & _OWN)[:, None] > 0, whole, np.stack([low, middle, high], axis=1))
    if not (bits & _OWN).any():
        return None
    return np.where((bits & _OWN)[:, None] > 0, np.stack([high, middle, low], axis=1), 1.0)
