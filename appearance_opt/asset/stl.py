"""STL: triangles without shared vertices, some with colours."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.creases import add_normals
from appearance_opt.asset.normals import weld
from appearance_opt.asset.origin import settle
from appearance_opt.asset.paths import read_bytes
from appearance_opt.asset.types import Asset, Material, Mesh, srgb_to_linear
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

_HEAD = 84
"""Bytes before the facets of a binary file: a header without meaning, and their number."""

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

_OWN = 1 << 15
"""The bit that says what the other fifteen of a facet's attribute mean."""


def load_stl(path: Path, keep_layout: bool = False, crease_angle: float | None = None) -> Asset:
    """Read an STL file: vertices at one place are one, edges sharp by ``creases.smooth_by_angle``
    are hard. ``keep_layout``, ``crease_angle``: see ``asset.load``. Raises InputError."""
    path = Path(path)
    data = read_bytes(path)
    notes = ["no material in this format: a default one is used"]
    facets = _facets(data, path, notes.append)
    if facets is None:
        corners, colors = _from_text(data, path), None
    else:
        corners = facets["corners"].astype(np.float64).reshape(-1, 3)
        colors = facet_colors(data[:80], facets["attribute"], notes.append)
    if not len(corners):
        raise InputError(f"{path}: there are no triangles in it")
    first, place = weld(corners)
    positions, faces = corners[first], place.reshape(-1, 3)
    vertex_colors = None
    if colors is not None:  # a vertex for each colour at a place
        values, kind = np.unique(colors, axis=0, return_inverse=True)
        pair, new = np.unique(faces * len(values) + kind.reshape(-1, 1), return_inverse=True)
        positions, faces = positions[pair // len(values)], new.reshape(-1, 3)
        vertex_colors = srgb_to_linear(values.astype(np.float32))[pair % len(values)]
    material = Material(name=path.stem, roughness=0.8)
    mesh = Mesh(
        positions,  # type: ignore[arg-type]
        faces.astype(np.int32),
        colors=vertex_colors,
        material=material,
        name=path.stem,
    )
    meshes, origin = settle([mesh], notes.append)
    if not keep_layout:
        meshes = add_normals(meshes, crease_angle=crease_angle)
    return Asset(tuple(meshes), path.stem, tuple(notes), origin=origin)


def _facets(data: bytes, path: Path, note: Callable[[str], None]) -> NDArray | None:
    """The facets of a binary file, None for one of text. Raises InputError if it is cut short."""
    count = int.from_bytes(data[_HEAD - 4 : _HEAD], "little")
    there, rest = divmod(len(data) - _HEAD, _FACET.itemsize)
    # binary files may begin like those of text: their length tells
    if len(data) < _HEAD or (_is_text(data) and (count != there or rest)):
        return None
    if count > there:
        raise InputError(
            f"{path}: the STL file is cut short, or is none: {there} of {count} facets are there"
        )
    if count == 0 and there:
        note(f"its number of facets is 0: all {there} are read")
        count = there
    elif count != there or rest:
        note(
            f"{len(data) - _HEAD - count * _FACET.itemsize} bytes behind its {count} facets are ignored"
        )
    return np.frombuffer(data, _FACET, count, _HEAD)


def _is_text(data: bytes) -> bool:
    return data.removeprefix(b"\xef\xbb\xbf").lstrip()[:5].lower() == b"solid"


def _from_text(data: bytes, path: Path) -> NDArray[np.float64]:
    """(3 F, 3) corners of the facets of a file of text."""
    import trimesh

    try:
        loaded = trimesh.load(io.BytesIO(data), file_type="stl_ascii", process=False, force="mesh")
    except Exception as error:  # trimesh's readers raise anything on damaged files
        raise InputError(f"{path}: not a readable STL file ({type(error).__name__})") from error
    if not isinstance(loaded, trimesh.Trimesh):
        return np.empty((0, 3))
    return np.asarray(loaded.vertices, np.float64)[loaded.faces].reshape(-1, 3)


def facet_colors(
    header: bytes, attribute: NDArray[np.uint16], note: Callable[[str], None]
) -> NDArray[np.float64] | None:
    """(F, 3) colours of the facets of a binary file, encoded as sRGB, from their ``attribute``
    (F,); None if they have none. ``header``: of 80 bytes.

    Two conventions have five bits for each channel. Materialise Magics writes ``COLOR=`` and four
    bytes of red, green, blue and alpha into the header: the colour of the facets whose highest bit
    is set; the others have their own, red in the lowest bits. VisCAM and SolidView write no such
    header; a facet has a colour, blue in the lowest bits, if its highest bit is set, and is white
    otherwise.
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
