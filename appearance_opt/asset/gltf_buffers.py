"""The binary side of a glTF file that is written: buffer views and accessors, quantised
(KHR_mesh_quantization) and compressed (EXT_meshopt_compression) if asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.quantize import NORMAL_BITS, Grid, normalized

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.file_options import FileOptions
    from appearance_opt.asset.rig import Skin
    from appearance_opt.asset.types import Mesh

QUANTIZATION, MESHOPT = "KHR_mesh_quantization", "EXT_meshopt_compression"

_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_COMPONENTS = {
    np.dtype(np.uint8): 5121,
    np.dtype(np.int16): 5122,
    np.dtype(np.uint16): 5123,
    np.dtype(np.uint32): 5125,
    np.dtype(np.float32): 5126,
}
_SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_SET = 4
"""Influences in one pair of JOINTS_n and WEIGHTS_n."""

_LARGEST = 65535
"""The largest index of 16 bits, which is reserved (primitive restart)."""


class Buffers:
    """Collects ``binary``, the one buffer with data, and the JSON of ``views`` and ``accessors``.
    ``required``: extensions that a reader of them needs."""

    def __init__(self, options: FileOptions) -> None:
        self.binary = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.required: list[str] = []
        self._quantized, self._packed = options.quantize, options.compress == "meshopt"
        self._plain = 0  # bytes of all compressed views when they are decompressed

    def extents(self, uri: str | None) -> list[dict[str, Any]]:
        """The JSON of the buffers. What is compressed claims a second one, which has no data, for
        where its plain bytes would lie."""
        out: list[dict[str, Any]] = [{"byteLength": len(self.binary)}]
        if uri is not None:
            out[0]["uri"] = uri
        if self._plain:
            out.append({"byteLength": self._plain, "extensions": {MESHOPT: {"fallback": True}}})
        return out

    def add_bytes(self, data: bytes) -> int:
        """Index of a view of an image."""
        return self._add({"buffer": 0, **self._placed(data)})

    def primitive(self, mesh: Mesh, grid: Grid | None) -> dict[str, Any]:
        """Attributes and indices of a mesh. ``grid``: of its positions, if they are quantised."""
        mesh = _ordered(mesh) if self._packed else mesh
        positions, attributes = mesh.positions, {}
        if grid is None:
            attributes["POSITION"] = self._attribute(positions, bounds=True)
        else:
            self._require(QUANTIZATION)
            attributes["POSITION"] = self._attribute(grid.integers(positions), bounds=True)
        if mesh.normals is not None:
            attributes["NORMAL"] = self._directions(_unit(mesh.normals))
            if mesh.tangents is not None:
                tangents = [_unit(mesh.tangents[:, :3]), mesh.tangents[:, 3:]]
                attributes["TANGENT"] = self._directions(np.concatenate(tangents, axis=1))
        for name, values in (("TEXCOORD_0", mesh.uvs), ("COLOR_0", mesh.colors)):
            if values is not None:
                integers = normalized(values) if self._quantized else None
                attributes[name] = self._attribute(values if integers is None else integers)
        if mesh.skin is not None:
            attributes |= self._influences(mesh.skin)
        return {"attributes": attributes, "indices": self._indices(mesh)}

    def _influences(self, skin: Skin) -> dict[str, int]:
        """Joints and weights in sets of four; the bones of ``skin`` are joints of the file's."""
        joints = np.where(skin.weights > 0, skin.bones, 0)
        weights = skin.weights / skin.weights.sum(axis=1, keepdims=True)
        missing = -joints.shape[1] % _SET
        joints, weights = (np.pad(v, ((0, 0), (0, missing))) for v in (joints, weights))
        kind = np.uint8 if joints.max(initial=0) < 256 else np.uint16
        found = {}
        for k in range(joints.shape[1] // _SET):
            part = slice(_SET * k, _SET * k + _SET)
            index = self._attribute(joints[:, part].astype(kind))
            del self.accessors[index]["normalized"]
            found[f"JOINTS_{k}"] = index
            found[f"WEIGHTS_{k}"] = self._attribute(weights[:, part])
        return found

    def add_numbers(self, values: NDArray, bounds: bool = False) -> int:
        """Index of an accessor of (N, width) floats that are no attributes of vertices."""
        values = np.ascontiguousarray(values, np.float32)
        view = self._add({"buffer": 0, **self._placed(values.tobytes())})
        shape = _SHAPES[values.shape[1]]
        index = self._accessor(view, values.dtype, shape, len(values))
        if bounds:
            low, high = values.min(axis=0).tolist(), values.max(axis=0).tolist()
            self.accessors[index] |= {"min": low, "max": high}
        return index

    def _indices(self, mesh: Mesh) -> int:
        kind: type = np.uint16 if len(mesh.positions) < _LARGEST else np.uint32
        indices: NDArray[np.integer] = np.ascontiguousarray(mesh.faces, kind).ravel()
        if self._packed:
            import meshopt

            data = meshopt.encode_gltf_buffer(indices.astype(np.uint32), "TRIANGLES")
            size = indices.itemsize
            view = self._compressed(data, len(indices), size, "TRIANGLES", _ELEMENT_BUFFER)
        else:
            data = indices.tobytes()
            view = self._add({"buffer": 0, **self._placed(data), "target": _ELEMENT_BUFFER})
        return self._accessor(view, indices.dtype, "SCALAR", len(indices))

    def _directions(self, values: NDArray[np.float32]) -> int:
        """Unit vectors (V, 3), or (V, 4) with a sign behind them. Quantised they are normalised
        integers of 16 bits; compressed, too, octahedral ones of fewer (the filter of that name)."""
        if not self._quantized:
            return self._attribute(values)
        self._require(QUANTIZATION)
        width = values.shape[1]
        if not self._packed:
            return self._attribute(np.round(values * np.float32(32767)).astype(np.int16))
        import meshopt

        four = np.ones((len(values), 4), np.float32)
        four[:, :width] = values
        rows = meshopt.encode_filter_oct(four, 8, NORMAL_BITS)
        data = meshopt.encode_gltf_buffer(rows, "ATTRIBUTES")
        view = self._compressed(data, len(rows), 8, "ATTRIBUTES", _ARRAY_BUFFER, "OCTAHEDRAL")
        return self._accessor(view, np.dtype(np.int16), f"VEC{width}", len(rows), normalized=True)

    def _attribute(self, values: NDArray, bounds: bool = False) -> int:
        """Index of an accessor of (V, width) floats, or of integers that stand for floats."""
        kind = values.dtype if values.dtype.kind in "iu" else np.dtype(np.float32)
        values = np.ascontiguousarray(values, kind)
        count, width = values.shape
        stride = -(-width * kind.itemsize // 4) * 4  # "aligned to 4-byte boundaries"
        rows = np.zeros((count, stride // kind.itemsize), kind)
        rows[:, :width] = values
        if self._packed:
            import meshopt

            data = meshopt.encode_gltf_buffer(rows, "ATTRIBUTES")
            view = self._compressed(data, count, stride, "ATTRIBUTES", _ARRAY_BUFFER)
        else:
            extent = {"buffer": 0, **self._placed(rows.tobytes()), "target": _ARRAY_BUFFER}
            if stride != width * kind.itemsize:
                extent["byteStride"] = stride
            view = self._add(extent)
        index = self._accessor(view, kind, f"VEC{width}", count, kind.kind != "f")
        if bounds:
            low, high = values.min(axis=0).tolist(), values.max(axis=0).tolist()
            self.accessors[index] |= {"min": low, "max": high}
        return index

    def _accessor(
        self, view: int, kind: np.dtype, shape: str, count: int, normalized: bool = False
    ) -> int:
        accessor = {
            "bufferView": view,
            "componentType": _COMPONENTS[kind],
            "count": count,
            "type": shape,
        }
        if normalized:
            accessor["normalized"] = True
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def _compressed(
        self, data: bytes, count: int, stride: int, mode: str, target: int, filter: str = ""
    ) -> int:
        """Index of a view of ``count`` elements of ``stride`` bytes each, of which ``data`` is the
        compressed form."""
        self._require(MESHOPT)
        packed: dict[str, Any] = {"buffer": 0, **self._placed(data), "byteStride": stride}
        packed |= {"mode": mode, "count": count} | ({"filter": filter} if filter else {})
        self._plain += -self._plain % 4
        view: dict[str, Any] = {
            "buffer": 1,
            "byteOffset": self._plain,
            "byteLength": count * stride,
        }
        view |= {"target": target, "extensions": {MESHOPT: packed}}
        if mode == "ATTRIBUTES":
            view["byteStride"] = stride
        self._plain += count * stride
        return self._add(view)

    def _placed(self, data: bytes) -> dict[str, int]:
        """Where bytes lie in the buffer, to which they are added."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        extent = {"byteOffset": len(self.binary), "byteLength": len(data)}
        self.binary += data
        return extent

    def _add(self, view: dict[str, Any]) -> int:
        self.views.append(view)
        return len(self.views) - 1

    def _require(self, extension: str) -> None:
        if extension not in self.required:
            self.required.append(extension)


def _ordered(mesh: Mesh) -> Mesh:
    """A mesh with its triangles and vertices in the order in which they compress well."""
    import meshopt

    faces = np.ascontiguousarray(mesh.faces, np.uint32).ravel()
    if not len(faces):
        return mesh
    indices, place, used = meshopt.reorder_mesh(faces, True, True)
    order = np.argsort(place, kind="stable")[:used]

    return mesh.take(order, indices.reshape(-1, 3))


def _unit(v: NDArray) -> NDArray[np.float32]:
    """Unit length to float32 precision, which the validator asks for."""
    w = np.asarray(v, np.float64)
    return (w / np.maximum(np.linalg.norm(w, axis=1, keepdims=True), 1e-30)).astype(np.float32)
