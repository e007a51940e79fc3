"""MaterialX networks that USD composes: UsdShade prims whose identifiers are names of MaterialX
node definitions."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset.materialx_nodes import Input
from appearance_opt.asset.types import srgb_to_linear

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from appearance_opt.asset.types import ColorSpace, Texture

_TYPE = re.compile(
    r"(float[234]?|integer|boolean|color[34]|vector[234]|string|surfaceshader|material)(FA|B|I)?"
)
_WIDTHS = {
    "float2": 2,
    "float3": 3,
    "float4": 4,
    "float": 1,
    "color3": 3,
    "color4": 4,
    "vector2": 2,
    "vector3": 3,
    "vector4": 4,
    "integer": 1,
    "boolean": 1,
}
_DEFINITION = "ND_"


def category(identifier: str) -> tuple[str, int, bool]:
    """(category, channels, does it give colours?) of a node by its definition's name:
    ND_<category>_<types>[_<version>]."""
    words = identifier.removeprefix(_DEFINITION).split("_")
    while len(words) > 1 and words[-1].isdigit():
        words.pop()
    first = next((k for k, w in enumerate(words) if k and _TYPE.fullmatch(w)), len(words))
    types = [m[1] for w in words[first:] if (m := _TYPE.fullmatch(w))]
    name = "_".join(words[:first])
    # what converts names what it reads before what it gives; what extracts gives single channels
    width = {"extract": 1, "gltf_colorimage": 3, "normalmap": 3}.get(name)
    if name in ("convert", "swizzle"):
        types = types[1:] or types
    colors = name in ("gltf_colorimage", "UsdUVTexture") or bool(
        types and types[0].startswith("color")
    )
    return name, width if width is not None else _WIDTHS.get(types[0], 0) if types else 0, colors


class UsdNode:
    """A shader prim, see ``materialx_nodes.Node``. ``read``: pixels of the file of an input;
    ``fitted``: see there."""

    def __init__(
        self,
        shader: Any,
        read: Callable[[Any], NDArray | None],
        fitted: Callable[[Texture, Any], Texture],
    ) -> None:
        self._shader, self._read, self._fitted = shader, read, fitted
        self.name = str(shader.GetPrim().GetName())
        self.category, self.width, self.colors = category(str(shader.GetIdAttr().Get() or ""))

    def input(self, name: str) -> Input | None:
        from pxr import UsdShade

        given = self._shader.GetInput(name)
        if not given:
            return None
        attributes = UsdShade.Utils.GetValueProducingAttributes(given)
        if not attributes:
            return None
        source = attributes[0]
        if UsdShade.Utils.GetType(source.GetName()) == UsdShade.AttributeType.Output:
            node = UsdShade.Shader(source.GetPrim())
            if not node or not node.GetIdAttr().Get():
                return None
            return Input(
                node=UsdNode(node, self._read, self._fitted),
                output=UsdShade.Output(source).GetBaseName(),
            )
        return _constant(source, self.category)

    def picture(self) -> NDArray | None:
        return self._read(self._shader.GetInput("file"))

    def fitted(self, texture: Texture) -> Texture:
        return self._fitted(texture, self._shader.GetInput("file"))


def _constant(attribute: Any, owner: str) -> Input | None:
    value = attribute.Get()
    if value is None:
        return None
    kind = str(attribute.GetTypeName())
    if kind == "asset":
        return Input(str(value.path), space=_space(attribute, owner))
    if isinstance(value, (bool, int, float)):
        return Input((float(value),))
    if isinstance(value, str):
        return Input(value)
    try:
        numbers = tuple(float(x) for x in value)
    except TypeError:
        return None
    if kind.startswith("color") and _space(attribute, owner) == "srgb":
        numbers = (*srgb_to_linear(np.array(numbers[:3], np.float64)).tolist(), *numbers[3:])
    return Input(numbers)


def _space(attribute: Any, owner: str) -> ColorSpace | None:
    """How colours are encoded; None where nothing says."""
    named = str(attribute.GetColorSpace() or "")
    if attribute.GetTypeName() == "asset" and owner == "UsdUVTexture":
        source = attribute.GetPrim().GetAttribute("inputs:sourceColorSpace")
        named = named or {"sRGB": "srgb_texture", "raw": "raw"}.get(
            str(source.Get() if source else ""), ""
        )
    if not named:
        return None
    return "srgb" if named.lower().startswith(("srgb", "g22", "gamma22")) else "linear"
