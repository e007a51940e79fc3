"""glTF 2.0 buffers and accessors (specification, section 3.6)."""

from __future__ import annotations

import base64
import codecs
import json
import struct
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np

from appearance_opt.asset import gltf_meshopt
from appearance_opt.asset.paths import read_bytes
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.companions import Companions

COMPONENTS = {
    5120: np.int8,
    5121: np.uint8,
    5122: np.int16,
    5123: np.uint16,
    5125: np.uint32,
    5126: np.float32,
}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
FREE_ZEROS = 1 << 16
"""Elements that an accessor without data, which stands for zeros, may have in any file. Beyond that
it has no more than the largest accessor with data: a few bytes of JSON must not ask for any amount
of memory and time."""
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942


class Document:
    """A parsed glTF or GLB file: its JSON, and its buffers, read when asked for."""

    def __init__(self, path: Path, companions: Companions) -> None:
        self.path, self.companions = Path(path), companions
        data = read_bytes(self.path)
        text, self._binary = _chunks(data, self.path) if data[:4] == b"glTF" else (data, None)
        try:
            self.json: dict[str, Any] = json.loads(_decoded(text))
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: not a glTF file, or cut short ({error})") from None
        if not isinstance(self.json, dict) or not isinstance(self.json.get("asset"), dict):
            raise InputError(f"{path}: not a glTF file (no 'asset' object)")
        if not str(self.json["asset"].get("version", "")).startswith("2"):
            raise InputError(
                f"{path}: glTF version {self.json['asset'].get('version')} is not supported; convert to 2.0"
            )
        self._buffers: dict[int, bytes] = {}
        self._decompressed: dict[int, bytes | memoryview] = {}
        self._accessors: dict[int, NDArray] = {}

    def items(self, kind: str) -> list[dict[str, Any]]:
        """A top-level array of the JSON, empty when absent."""
        return self.json.get(kind, [])

    def extension(self, name: str) -> dict[str, Any]:
        """What an extension says of the file as a whole, empty when absent."""
        return self.json.get("extensions", {}).get(name, {})

    def uri(self, uri: str) -> bytes:
        """Bytes behind a data URI or a path relative to the file."""
        if uri.startswith("data:"):
            try:
                text = "".join(unquote(uri.split(",", 1)[1]).split()).rstrip("=")
                # some writers break lines, and leave out what fills up the last group
                return base64.b64decode(text + "=" * (-len(text) % 4), validate=True)
            except (IndexError, ValueError):
                raise InputError(f"{self.path}: a data URI is damaged") from None
        return read_bytes(self.companions.find(uri, self.path, percent_encoded=True))

    def buffer_view(self, index: int) -> tuple[bytes | memoryview, int]:
        """(bytes, stride or 0) of a buffer view. It shares its memory with the buffer."""
        view = self.items("bufferViews")[index]
        packed = gltf_meshopt.compressed(view)
        if packed is None:
            return self._slice(view, index), view.get("byteStride", 0)
        if index not in self._decompressed:
            self._decompressed[index] = self._decompress(view, packed, index)
        return self._decompressed[index], view.get("byteStride", 0)

    def accessor(self, index: int) -> NDArray:
        """(count, width) array, not to be written to: floats for float and normalized types,
        integers otherwise. Each is read once."""
        if index not in self._accessors:
            self._accessors[index] = self._read_accessor(index)
        return self._accessors[index]

    def _read_accessor(self, index: int) -> NDArray:
        a = self.items("accessors")[index]
        kind, width, count = np.dtype(COMPONENTS[a["componentType"]]), WIDTHS[a["type"]], a["count"]
        if "bufferView" in a:
            out = self._elements(a["bufferView"], a.get("byteOffset", 0), kind, width, count)
        elif count > max(FREE_ZEROS, self._most_elements):
            raise InputError(
                f"{self.path}: accessor {index} has {count} elements but no data; the file is damaged"
            )
        else:
            out = np.zeros((count, width), kind)
        if "sparse" in a:
            s = a["sparse"]
            at = s["indices"]
            where = self._elements(
                at["bufferView"],
                at.get("byteOffset", 0),
                np.dtype(COMPONENTS[at["componentType"]]),
                1,
                s["count"],
            )
            out = out.copy()
            out[where[:, 0]] = self._elements(
                s["values"]["bufferView"], s["values"].get("byteOffset", 0), kind, width, s["count"]
            )
        return self.scaled(index, out)

    @cached_property
    def _most_elements(self) -> int:
        """Elements of the largest accessor that has data."""
        most = 0
        for a in self.items("accessors"):
            if "bufferView" in a:
                size = np.dtype(COMPONENTS[a["componentType"]]).itemsize * WIDTHS[a["type"]]
                most = max(most, min(a["count"], len(self.buffer_view(a["bufferView"])[0]) // size))
        return most

    def scaled(self, index: int, stored: NDArray) -> NDArray:
        """What the numbers ``stored`` of an accessor mean: floats in [-1, 1] if it is normalized,
        else themselves."""
        a = self.items("accessors")[index]
        kind = np.dtype(COMPONENTS[a["componentType"]])
        if a.get("normalized") and kind.kind != "f":
            return np.maximum(stored.astype(np.float32) / np.float32(np.iinfo(kind.type).max), -1)
        return stored

    def _elements(self, view: int, offset: int, kind: np.dtype, width: int, count: int) -> NDArray:
        data, stride = self.buffer_view(view)
        stride = stride or kind.itemsize * width
        if (
            count < 0
            or offset < 0
            or (count and offset + stride * (count - 1) + kind.itemsize * width > len(data))
        ):
            raise InputError(
                f"{self.path}: an accessor reaches beyond its buffer view; the file is cut short"
            )
        return np.ndarray(
            (count, width), kind.newbyteorder("<"), data, offset, (stride, kind.itemsize)
        )

    def _slice(self, extent: dict[str, Any], index: int) -> memoryview:
        data = self._buffer(extent["buffer"])
        start, length = extent.get("byteOffset", 0), extent["byteLength"]
        if start < 0 or length < 0 or start + length > len(data):
            raise InputError(
                f"{self.path}: buffer view {index} reaches beyond its buffer; the file is cut short"
            )
        return memoryview(data)[start : start + length]

    def _decompress(
        self, view: dict[str, Any], packed: dict[str, Any], index: int
    ) -> bytes | memoryview:
        """A view's plain bytes; those of its fallback buffer if the package is missing and there is
        one."""
        try:
            return gltf_meshopt.decompress(
                bytes(self._slice(packed, index)), packed, str(self.path)
            )
        except gltf_meshopt.PackageMissing:
            if "uri" not in self.items("buffers")[view["buffer"]]:
                raise
            return self._slice(view, index)

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            buffer = self.items("buffers")[index]
            if "uri" in buffer:
                self._buffers[index] = self.uri(buffer["uri"])
            elif self._binary is not None and index == 0:
                self._buffers[index] = self._binary
            else:
                raise InputError(f"{self.path}: buffer {index} has no data")
        return self._buffers[index]


def _chunks(data: bytes, path: Path) -> tuple[bytes, bytes | None]:
    """(JSON, binary chunk) of a GLB file."""
    if len(data) < 20:
        raise InputError(f"{path}: the GLB file is cut short ({len(data)} bytes)")
    _, version, length = struct.unpack_from("<III", data)
    if version != 2:
        raise InputError(f"{path}: GLB version {version} is not supported; convert it to glTF 2.0")
    if length > len(data):
        raise InputError(f"{path}: the GLB file is cut short ({len(data)} of {length} bytes)")
    text, binary, offset = None, None, 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<II", data, offset)
        chunk = data[offset + 8 : offset + 8 + size]
        if len(chunk) < size:
            raise InputError(f"{path}: a chunk of the GLB file is cut short")
        if kind == _JSON and text is None:
            text = chunk
        elif kind == _BIN and binary is None:
            binary = chunk
        offset += 8 + size
    if text is None:
        raise InputError(f"{path}: the GLB file has no JSON chunk")
    text = text.rstrip(b"\0")  # the specification pads with spaces
    return text, binary


def _decoded(text: bytes) -> str:
    """JSON as text. Names in it that are no UTF-8, which JSON asks for, keep their bytes (see
    ``paths.resolve``)."""
    return text.removeprefix(codecs.BOM_UTF8).decode("utf-8", "surrogateescape")
