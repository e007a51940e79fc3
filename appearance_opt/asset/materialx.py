"""The part of MaterialX that maps to metallic-roughness: standard_surface with image textures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from appearance_opt.asset import images
from appearance_opt.asset.packing import pack_orm
from appearance_opt.asset.paths import read_bytes
from appearance_opt.asset.types import Material, Texture
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from appearance_opt.asset.companions import Companions


def load_materialx(path: Path, name: str, companions: Companions) -> Material | None:
    """The surface material ``name`` of a .mtlx file, or None if it is not there. Raises InputError."""
    try:
        root = ElementTree.fromstring(read_bytes(path))
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: not a readable MaterialX file ({error})") from None
    material = root.find(f"./surfacematerial[@name='{name}']")
    if material is None:
        return None
    link = material.find("./input[@name='surfaceshader']")
    shader = None if link is None else root.find(f"./standard_surface[@name='{link.get('nodename')}']")
    return None if shader is None else _Shader(root, shader, path, companions).material(name)


class _Shader:
    def __init__(self, root: Element, shader: Element, path: Path, companions: Companions) -> None:
        self.root, self.shader, self.path, self.companions = root, shader, path, companions

    def material(self, name: str) -> Material:
        base, rough, metal = (self._texture(k) for k in ("base_color", "specular_roughness", "metalness"))
        color = self._numbers("base_color", [0.8, 0.8, 0.8])
        return Material(
            name=name,
            base_color=(1.0, 1.0, 1.0) if base else (color[0], color[1], color[2]),
            roughness=1.0 if rough else self._numbers("specular_roughness", [0.2])[0],
            metalness=1.0 if metal else self._numbers("metalness", [0.0])[0],
            base_color_texture=base,
            orm_texture=pack_orm(rough, metal) if rough or metal else None,
            normal_texture=self._texture("normal"),
        )

    def _input(self, key: str) -> Element | None:
        return self.shader.find(f"./input[@name='{key}']")

    def _numbers(self, key: str, default: list[float]) -> list[float]:
        found = self._input(key)
        value = None if found is None else found.get("value")
        return default if value is None else [float(x) for x in value.split(",")]

    def _texture(self, key: str) -> Texture | None:
        """The image at the end of an input's connections, through node graphs and normal maps."""
        node = self._input(key)
        scope = self.root
        for _ in range(8):
            if node is None:
                return None
            graph = node.get("nodegraph")
            if graph is not None:
                scope = self.root.find(f"./nodegraph[@name='{graph}']") or self.root
                node = scope.find(f"./output[@name='{node.get('output')}']")
            elif node.get("nodename") is not None:
                node = scope.find(f"./*[@name='{node.get('nodename')}']")
            elif node.tag in ("image", "tiledimage"):
                return self._image(node)
            else:
                node = node.find("./input[@name='in']")
        return None

    def _image(self, node: Element) -> Texture | None:
        file = node.find("./input[@name='file']")
        if file is None or not file.get("value"):
            return None
        reference = file.get("value", "")
        pixels = self.companions.read(lambda: images.read(self.companions.find(reference, self.path)))
        if pixels is None:
            return None
        space = "srgb" if "srgb" in file.get("colorspace", "") else "linear"
        if node.get("type") == "float":
            pixels = pixels[..., :1]
        elif pixels.shape[2] < 3:
            pixels = np.repeat(pixels[..., :1], 3, axis=2)
        return Texture(pixels, space)  # type: ignore[arg-type]
