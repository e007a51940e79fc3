"""Networks in MaterialX documents, through the package MaterialX."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.materialx_nodes import Input
from appearance_opt.asset.paths import read_text, without_stray_bytes
from appearance_opt.asset.types import srgb_to_linear
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from appearance_opt.asset.companions import Companions
    from appearance_opt.asset.types import ColorSpace, Texture

_METRES = {
    "nanometer": 1e-9, "micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048,
    "yard": 0.9144, "meter": 1.0, "kilometer": 1e3, "mile": 1609.344,
}  # fmt: skip
"""Units of lengths, of which only ratios count here."""

MAX_INCLUDES = 16
"""Documents that include each other, in a row."""

WIDTHS = {
    "float": 1,
    "integer": 1,
    "boolean": 1,
    "vector2": 2,
    "vector3": 3,
    "color3": 3,
    "vector4": 4,
    "color4": 4,
}
_ENCODED = ("srgb_texture", "srgb_displayp3", "g22_rec709", "gamma22")
"""Colour spaces that are decoded as sRGB is; all others count as linear."""


def find_surface(
    path: Path,
    name: str,
    companions: Companions,
    read: Callable[[str], NDArray | None],
    fitted: Callable[[Texture, str], Texture],
) -> DocumentNode | None:
    """The surface shader of the material ``name`` of a .mtlx file; None if it is not there.
    ``read``: pixels of a file that it names; ``fitted``: see ``Node``. Raises InputError."""
    document = _read(path, companions)
    material = document.getNode(name)
    if material is None or material.getType() != "material":
        return None
    shader = material.getInput("surfaceshader")
    node = None if shader is None else shader.getConnectedNode()
    return None if node is None else DocumentNode(node, _Context(document, read, fitted))


def _read(path: Path, companions: Companions) -> Any:
    import MaterialX as mx

    def include(into: Any, file: Any, search: Any, options: Any, depth: int) -> None:
        if depth > MAX_INCLUDES:
            raise InputError(f"{path}: its documents include each other in circles")
        found = companions.find(file.asString(), path)
        options.readXIncludeFunction = partial(include, depth=depth + 1)
        mx.readFromXmlString(
            into,
            without_stray_bytes(read_text(found)),
            mx.FileSearchPath(str(found.parent)),
            options,
        )

    document = mx.createDocument()
    options = mx.XmlReadOptions()
    options.readXIncludeFunction = partial(include, depth=1)
    try:
        mx.readFromXmlString(
            document,
            without_stray_bytes(read_text(path)),
            mx.FileSearchPath(str(path.parent)),
            options,
        )
        document.flattenSubgraphs()  # nodes that the document itself makes of others
    except (mx.Exception, mx.ExceptionParseError, RuntimeError) as error:
        raise InputError(
            f"{path}: not a readable MaterialX file ({' '.join(str(error).split())[:160]})"
        ) from None
    for element in document.traverseTree():
        if isinstance(element, mx.Input) and element.getType() == "filename":
            companions.mention(element.getResolvedValueString(), path)
    return document


@dataclass(frozen=True)
class _Context:
    """What the nodes of a document share: itself, for it ends with its last owner, and what reads
    its pictures."""

    document: Any
    read: Callable[[str], NDArray | None]
    fitted: Callable[[Texture, str], Texture]


class DocumentNode:
    """A node of a document, see ``materialx_nodes.Node``."""

    def __init__(self, node: Any, context: _Context) -> None:
        self._node, self._context = node, context
        self.name: str = node.getName()
        self.category: str = node.getCategory()
        self.width = WIDTHS.get(node.getType(), 0)
        self.colors = node.getType().startswith("color") or self.category in (
            "gltf_colorimage",
            "UsdUVTexture",
        )

    def input(self, name: str) -> Input | None:
        given = self._node.getInput(name)
        if given is None:
            text = self._node.getAttribute(
                name
            )  # documents before 1.38.9 have some of these as attributes
            return Input(text) if text else None
        node = given.getConnectedNode()
        if node is not None:
            output = given.getConnectedOutput()
            within = output.getOutputString() if output is not None else given.getOutputString()
            return Input(node=DocumentNode(node, self._context), output=within)
        interface = given.getInterfaceInput() if given.hasInterfaceName() else None
        source = given if interface is None else interface
        return _constant(source)

    def _file(self) -> str:
        given = self._node.getInput("file")
        if given is None:
            return ""
        interface = given.getInterfaceInput() if given.hasInterfaceName() else None
        return str((given if interface is None else interface).getResolvedValueString())

    def picture(self) -> NDArray | None:
        file = self._file()
        return self._context.read(file) if file else None

    def fitted(self, texture: Texture) -> Texture:
        return self._context.fitted(texture, self._file())


def _constant(source: Any) -> Input | None:
    text, kind = source.getValueString(), source.getType()
    if kind not in WIDTHS:
        return Input(text, space=_space(source)) if text else None
    if kind == "boolean":
        return Input((float(text == "true"),))
    try:
        scale = _METRES.get(source.getUnit(), 1.0)
        numbers = tuple(scale * float(x) for x in re.split(r"[,\s]+", text.strip()))
    except ValueError:
        return None
    if kind.startswith("color") and _space(source) == "srgb":
        decoded = srgb_to_linear(np.array(numbers[:3], np.float64))
        numbers = (*decoded.tolist(), *numbers[3:])
    return Input(numbers)


def _space(source: Any) -> ColorSpace:
    """How the colours of an input are encoded."""
    return "srgb" if source.getActiveColorSpace() in _ENCODED else "linear"
