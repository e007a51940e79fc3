"""Geometry that glTF holds compressed by Draco (KHR_draco_mesh_compression), through the optional
package DracoPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.gltf_accessors import Document

DRACO = "KHR_draco_mesh_compression"


@dataclass(frozen=True)
class Compressed:
    """The triangles of a primitive, ``faces`` (F, 3), and those of its attributes that are
    compressed, by ``name in`` and ``attribute(name)``."""

    faces: NDArray[np.int64]
    _document: Document
    _stored: dict[str, NDArray]
    _accessors: dict[str, int]

    @classmethod
    def of(cls, document: Document, primitive: dict[str, Any]) -> Compressed | None:
        """None if the primitive is not compressed, or if the package is missing and the file has
        the same geometry uncompressed. Raises InputError if it cannot be read."""
        extension = primitive.get("extensions", {}).get(DRACO)
        if extension is None:
            return None
        try:
            import DracoPy
        except ImportError:
            if _has_fallback(document, primitive):
                return None
            raise InputError(
                f"{document.path}: Draco compression needs the package DracoPy: pip install 'appearance-opt[draco]' "
                "(or save the file uncompressed)"
            ) from None
        data = bytes(document.buffer_view(extension["bufferView"])[0])
        try:
            mesh = DracoPy.decode(data)
            faces = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
            by_id = {a["unique_id"]: np.asarray(a["data"]) for a in mesh.attributes}
        except (
            Exception
        ) as error:  # the decoder raises types of its own, and a cloud of points has no faces
            raise InputError(
                f"{document.path}: its Draco data is damaged ({type(error).__name__})"
            ) from error
        stored = {name: by_id[number] for name, number in extension["attributes"].items()}
        return cls(faces, document, stored, primitive["attributes"])

    def __contains__(self, name: str) -> bool:
        return name in self._stored

    def attribute(self, name: str) -> NDArray:
        """(V, width) values, as ``Document.accessor`` returns them."""
        return self._document.scaled(self._accessors[name], self._stored[name])


def _has_fallback(document: Document, primitive: dict[str, Any]) -> bool:
    """Do all accessors of a primitive have data of their own?"""
    used = [
        *primitive["attributes"].values(),
        *([primitive["indices"]] if "indices" in primitive else []),
    ]
    return all("bufferView" in document.items("accessors")[k] for k in used)
