"""Rigged inputs built for tests, and a plain evaluator of glTF skins that shares no code with the
package: lists, loops and the formulas of the specification."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from tests.test_asset_gltf import write_glb
from tests.test_asset_gltf_nodes import CODES, TYPES

Matrix = np.ndarray


class GltfBuilder:
    """Collects accessors of a glTF file."""

    def __init__(self) -> None:
        self.binary = b""
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "accessors": [],
            "bufferViews": [],
        }

    def accessor(self, values: np.ndarray, **more: object) -> int:
        values = np.ascontiguousarray(values)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": values.nbytes}
        self.json["bufferViews"].append(view)
        entry = {
            "bufferView": len(self.json["bufferViews"]) - 1,
            "componentType": CODES[str(values.dtype)],
            "count": len(values),
            "type": TYPES[values.shape[1]],
            **more,
        }
        self.json["accessors"].append(entry)
        self.binary += values.tobytes() + b"\0" * (-values.nbytes % 4)
        return len(self.json["accessors"]) - 1

    def write(self, path: Path) -> Path:
        self.json["buffers"] = [{"byteLength": len(self.binary)}]
        write_glb(path, self.json, self.binary)
        return path


def unit_quaternion(rng: np.random.Generator, angle: float = 1.0) -> list[float]:
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    return [*(axis * math.sin(angle / 2)).tolist(), math.cos(angle / 2)]


def sheet(rng: np.random.Generator, count: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Positions of triangles that share no vertices, and their faces."""
    p = rng.normal(size=(3 * count, 3)).astype(np.float32)
    return p, np.arange(3 * count).reshape(-1, 3)


def character(path: Path, seed: int = 0) -> Path:
    """Two skinned meshes with inverse bind matrices of their own for the same joints, one with
    joints in eight places and 16 bit weights; a prop on a joint, a part on an animated node with a
    scale, shear in the hierarchy, and a mesh that stands still. Every kind of interpolation."""
    rng = np.random.default_rng(seed)
    b = GltfBuilder()
    nodes: list[dict[str, Any]] = [{"name": "figure", "children": [1, 8], "scale": [1, 2, 0.5]}]
    for k in range(1, 6):  # a chain of joints below a scale that is not uniform: shear
        node: dict[str, Any] = {
            "name": f"bone.{k}",
            "translation": (rng.normal(size=3) * 0.3).tolist(),
            "rotation": unit_quaternion(rng, 0.4),
        }
        if k < 5:
            node["children"] = [k + 1]
        nodes.append(node)
    nodes[3]["scale"] = [1.1, 0.9, 1.2]
    nodes[2]["extras"] = {"rule": [1, "two"]}
    nodes[5]["children"] = [6]
    nodes.append({"name": "prop", "mesh": 2, "translation": [0, 0.1, 0]})
    nodes.append({"name": "body", "mesh": 0, "skin": 0, "translation": [9, 9, 9]})
    nodes.append({"name": "wheel", "mesh": 3, "scale": [2, 2, 2]})
    nodes.append({"name": "floor", "mesh": 4})
    nodes.append({"name": "coat", "mesh": 1, "skin": 1})
    b.json["nodes"] = nodes
    b.json["scenes"] = [{"nodes": [0, 7, 9, 10]}]
    worlds = Evaluator({**b.json, "animations": []}, b"").worlds(None, 0.0)
    meshes = []
    for name, places, kind in (("body", 4, "float32"), ("coat", 8, "uint16")):
        p, faces = sheet(rng)
        joints = rng.integers(0, 5, (len(p), places)).astype(np.uint8)
        weights = rng.random((len(p), places)) ** 3
        weights /= weights.sum(axis=1, keepdims=True)
        whole = np.floor(weights * 65535).astype(np.uint16)  # of sum one, as glTF asks
        whole[:, 0] += (65535 - whole.sum(axis=1)).astype(np.uint16)
        attributes = {
            "POSITION": b.accessor(p),
            "NORMAL": b.accessor(p / np.linalg.norm(p, axis=1, keepdims=True)),
        }
        for k in range(places // 4):
            part = slice(4 * k, 4 * k + 4)
            attributes[f"JOINTS_{k}"] = b.accessor(joints[:, part])
            stored, more = weights[:, part].astype(np.float32), {}
            if kind == "uint16":
                stored, more = whole[:, part], {"normalized": True}
            attributes[f"WEIGHTS_{k}"] = b.accessor(stored, **more)
        indices = b.accessor(faces.reshape(-1, 1).astype(np.uint32))
        meshes.append(
            {"name": name, "primitives": [{"attributes": attributes, "indices": indices}]}
        )
    for name in ("prop", "wheel", "floor"):
        p, faces = sheet(rng, 5)
        attributes = {
            "POSITION": b.accessor(p),
            "NORMAL": b.accessor(p / np.linalg.norm(p, axis=1, keepdims=True)),
        }
        indices = b.accessor(faces.reshape(-1, 1).astype(np.uint32))
        meshes.append(
            {"name": name, "primitives": [{"attributes": attributes, "indices": indices}]}
        )
    b.json["meshes"] = meshes
    skins = []
    for offset in (np.eye(4), np.diag([100.0, 100, 100, 1])):  # the coat is in centimetres
        bound = [worlds[k] for k in range(1, 6)]
        inverse = np.stack([(np.linalg.inv(w) @ np.linalg.inv(offset)).T.ravel() for w in bound])
        skins.append(
            {
                "joints": [1, 2, 3, 4, 5],
                "inverseBindMatrices": b.accessor(inverse.astype(np.float32)),
            }
        )
    b.json["skins"] = skins
    walk_times = np.array([[0.0], [0.5], [0.75], [2.0]], np.float32)
    spin_times = np.array([[0.25], [1.0]], np.float32)
    turns = np.array([unit_quaternion(rng, a) for a in (0.3, -2.8, 1.2, 0.1)], np.float32)
    turns[2] *= -1  # the other sign of the same rotation: the shorter arc is taken
    cubic = rng.normal(size=(12, 3)).astype(np.float32) * 0.3
    spline = 0.5 * rng.normal(size=(6, 4)).astype(np.float32)
    spline[1::3] = turns[[0, 3]]
    walk = [
        (1, "translation", walk_times, rng.normal(size=(4, 3)).astype(np.float32), "LINEAR"),
        (2, "rotation", walk_times, turns, "LINEAR"),
        (3, "scale", walk_times, (1 + 0.2 * rng.random((4, 3))).astype(np.float32), "STEP"),
        (4, "translation", walk_times, cubic, "CUBICSPLINE"),
        (8, "rotation", spin_times, turns[:2], "STEP"),
    ]
    spin = [
        (5, "rotation", spin_times, spline, "CUBICSPLINE"),
        (8, "translation", spin_times, turns[:2, :3], "LINEAR"),
    ]
    b.json["animations"] = [
        {
            "name": name,
            "samplers": [
                {"input": b.accessor(t), "output": b.accessor(v), "interpolation": how}
                for _, _, t, v, how in channels
            ],
            "channels": [
                {"sampler": k, "target": {"node": node, "path": path}}
                for k, (node, path, *_) in enumerate(channels)
            ],
        }
        for name, channels in (("walk", walk), ("spin.1", spin))
    ]
    b.json["animations"][1]["extras"] = {"loop": True}
    return b.write(path)


class Evaluator:
    """Plays a GLB file as the specification says, vertex by vertex."""

    def __init__(self, document: dict[str, Any], binary: bytes) -> None:
        self.json, self.binary = document, binary
        self.parent = {c: k for k, n in enumerate(document["nodes"]) for c in n.get("children", [])}

    @classmethod
    def of(cls, path: Path) -> Evaluator:
        data = path.read_bytes()
        (length,) = struct.unpack_from("<I", data, 12)
        return cls(json.loads(data[20 : 20 + length]), data[28 + length :])

    def accessor(self, index: int) -> list[list[float]]:
        a = self.json["accessors"][index]
        view = self.json["bufferViews"][a["bufferView"]]
        letter, size = {5121: ("B", 1), 5123: ("H", 2), 5125: ("I", 4), 5126: ("f", 4)}[
            a["componentType"]
        ]
        width = {v: k for k, v in TYPES.items()}[a["type"]]
        start = view.get("byteOffset", 0) + a.get("byteOffset", 0)
        numbers = struct.unpack_from(f"<{a['count'] * width}{letter}", self.binary, start)
        top = float(2 ** (8 * size) - 1) if a.get("normalized") else 1.0
        return [[x / top for x in numbers[i : i + width]] for i in range(0, len(numbers), width)]

    def worlds(self, clip: str | None, time: float) -> list[Matrix]:
        moved: dict[tuple[int, str], list[float]] = {}
        for animation in self.json.get("animations", []):
            if animation["name"] != clip:
                continue
            for channel in animation["channels"]:
                sampler = animation["samplers"][channel["sampler"]]
                target = channel["target"]
                moved[target["node"], target["path"]] = self.value(sampler, target["path"], time)

        def local(k: int) -> Matrix:
            node = self.json["nodes"][k]
            if "matrix" in node:
                return np.array(node["matrix"], np.float64).reshape(4, 4).T
            x, y, z = moved.get((k, "translation"), node.get("translation", [0, 0, 0]))
            i, j, m, r = moved.get((k, "rotation"), node.get("rotation", [0, 0, 0, 1]))
            sx, sy, sz = moved.get((k, "scale"), node.get("scale", [1, 1, 1]))
            turn = [
                [r * r + i * i - j * j - m * m, 2 * (i * j - r * m), 2 * (i * m + r * j)],
                [2 * (i * j + r * m), r * r - i * i + j * j - m * m, 2 * (j * m - r * i)],
                [2 * (i * m - r * j), 2 * (j * m + r * i), r * r - i * i - j * j + m * m],
            ]
            out = np.eye(4)
            out[:3, :3] = np.array(turn) @ np.diag([sx, sy, sz])
            out[:3, 3] = x, y, z
            return out

        def world(k: int) -> Matrix:
            return local(k) if k not in self.parent else world(self.parent[k]) @ local(k)

        return [world(k) for k in range(len(self.json["nodes"]))]

    def value(self, sampler: dict[str, Any], path: str, time: float) -> list[float]:
        times = [t for (t,) in self.accessor(sampler["input"])]
        values = np.array(self.accessor(sampler["output"]))
        how = sampler.get("interpolation", "LINEAR")
        cubic = how == "CUBICSPLINE"
        key = values[1::3] if cubic else values
        if time <= times[0] or time >= times[-1]:
            out = key[0] if time <= times[0] else key[-1]
            return list(out / np.linalg.norm(out)) if path == "rotation" else list(out)
        k = max(n for n, t in enumerate(times) if t <= time)
        step = times[k + 1] - times[k]
        t = (time - times[k]) / step
        if how == "STEP":
            return list(key[k])
        if cubic:
            out = (2 * t**3 - 3 * t**2 + 1) * key[k] + step * (t**3 - 2 * t**2 + t) * values[
                3 * k + 2
            ]
            out = (
                out + (-2 * t**3 + 3 * t**2) * key[k + 1] + step * (t**3 - t**2) * values[3 * k + 3]
            )
        elif path == "rotation":
            dot = float(key[k] @ key[k + 1])
            angle = math.acos(min(abs(dot), 1.0))
            if angle < 1e-9:
                out = key[k]
            else:
                out = (
                    math.sin(angle * (1 - t)) * key[k]
                    + math.copysign(1, dot) * math.sin(angle * t) * key[k + 1]
                )
        else:
            out = (1 - t) * key[k] + t * key[k + 1]
        return list(out / np.linalg.norm(out)) if path == "rotation" else list(out)

    def positions(self, clip: str | None, time: float) -> dict[str, np.ndarray]:
        """World positions of the first primitive of each mesh node by its name."""
        worlds, out = self.worlds(clip, time), {}
        for k, node in enumerate(self.json["nodes"]):
            if "mesh" not in node:
                continue
            attributes = self.json["meshes"][node["mesh"]]["primitives"][0]["attributes"]
            points = self.accessor(attributes["POSITION"])
            if "skin" not in node:
                out[node["name"]] = np.array([(worlds[k] @ [*p, 1])[:3] for p in points])
                continue
            skin = self.json["skins"][node["skin"]]
            inverse = [
                np.array(m).reshape(4, 4).T for m in self.accessor(skin["inverseBindMatrices"])
            ]
            matrices = [worlds[j] @ m for j, m in zip(skin["joints"], inverse, strict=True)]
            moved = [np.zeros(3) for _ in points]
            for n in range(4):
                if f"JOINTS_{n}" not in attributes:
                    continue
                joints, weights = (
                    self.accessor(attributes[f"{a}_{n}"]) for a in ("JOINTS", "WEIGHTS")
                )
                for v, p in enumerate(points):
                    for j, w in zip(joints[v], weights[v], strict=True):
                        moved[v] = moved[v] + w * (matrices[int(j)] @ [*p, 1])[:3]
            out[node["name"]] = np.array(moved)
        return out
