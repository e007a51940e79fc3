"""What nodes of MaterialX networks give: numbers, pictures, and where these read.

A network is a graph of ``Node``, whatever holds it: a MaterialX document (``materialx_file``) or
UsdShade prims (``usd_networks``). Pictures are followed through image nodes, transforms of their
coordinates and arithmetic, whose meaning is that of the MaterialX 1.39 specification (standard
nodes) and of the node graphs that come with MaterialX.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from appearance_opt.asset import images, uv_transforms
from appearance_opt.asset.packing import resize
from appearance_opt.asset.types import Texture
from appearance_opt.asset.uv_transforms import Place

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.asset.types import ColorSpace, Wrap

MAX_DEPTH = 64
"""Nodes in a row: networks may have cycles."""


class Node(Protocol):
    """``category``: "image", "multiply", ...; ``width``: channels of what it gives, 0 if that is no
    number; ``colors``: are these colours, which alone have a colour space?"""

    name: str
    category: str
    width: int
    colors: bool

    def input(self, name: str) -> Input | None:
        """What the network says of an input; None if nothing, so that its default counts."""

    def picture(self) -> NDArray | None:
        """(H, W, C) pixels of the file that the node names, as stored; None without one."""

    def fitted(self, texture: Texture) -> Texture:
        """The texture of that file, brought to the size that it may have."""


@dataclass(frozen=True)
class Input:
    """A constant ``value`` (numbers, or a text), or the ``output`` of a ``node``. ``space``: how
    colours are encoded, None where nothing says."""

    value: tuple[float, ...] | str | None = None
    node: Node | None = None
    output: str = ""
    space: ColorSpace | None = None


_IMAGES = ("image", "tiledimage", "gltf_image", "gltf_colorimage", "gltf_normalmap", "UsdUVTexture")
_MEANS_COLORS = ("displayColor", "Cd", "color")
_WRAPS: dict[str, Wrap] = {
    "periodic": "repeat",
    "repeat": "repeat",
    "mirror": "mirror",
    "clamp": "clamp",
}
_CHANNELS = {"r": 0, "x": 0, "g": 1, "y": 1, "b": 2, "z": 2, "a": 3, "w": 3}
_LUMA = np.array([0.2722287, 0.6740818, 0.0536895], np.float32)


def _remap(x: NDArray, low: NDArray, high: NDArray, new_low: NDArray, new_high: NDArray) -> NDArray:
    return new_low + (x - low) / (high - low) * (new_high - new_low)


def _luminance(x: NDArray) -> NDArray:
    return np.repeat((x[..., :3] * _LUMA).sum(axis=-1, keepdims=True), 3, axis=-1)


_ARITHMETIC: dict[str, tuple[dict[str, float], Callable[..., NDArray]]] = {
    "multiply": ({"in1": 0, "in2": 1}, np.multiply),
    "divide": ({"in1": 0, "in2": 1}, np.divide),
    "add": ({"in1": 0, "in2": 0}, np.add),
    "subtract": ({"in1": 0, "in2": 0}, np.subtract),
    "power": ({"in1": 0, "in2": 1}, lambda a, b: np.maximum(a, 0) ** b),
    "min": ({"in1": 0, "in2": 0}, np.minimum),
    "max": ({"in1": 0, "in2": 0}, np.maximum),
    "absval": ({"in": 0}, np.abs),
    "invert": ({"in": 0, "amount": 1}, lambda x, amount: amount - x),
    "clamp": (
        {"in": 0, "low": 0, "high": 1},
        lambda x, low, high: np.minimum(np.maximum(x, low), high),
    ),
    "mix": ({"fg": 0, "bg": 0, "mix": 0}, lambda fg, bg, mix: bg + (fg - bg) * mix),
    "remap": ({"in": 0, "inlow": 0, "inhigh": 1, "outlow": 0, "outhigh": 1}, _remap),
    "contrast": (
        {"in": 0, "amount": 1, "pivot": 0.5},
        lambda x, amount, pivot: (x - pivot) * amount + pivot,
    ),
    "luminance": ({"in": 0}, _luminance),
    "saturate": (
        {"in": 0, "amount": 1},
        lambda x, amount: _luminance(x) * (1 - amount) + x * amount,
    ),
}
"""Inputs with their defaults, and the function of arrays whose last axes are channels."""


class NotUnderstood(Exception):
    """A network does what is not read here: the message says what."""


class Missing(Exception):
    """A picture is not there, which has been told, or the node names none."""


@dataclass(frozen=True)
class Value:
    """``factor`` (C,), times ``texture`` where there is one, linear."""

    factor: NDArray[np.float32]
    texture: Texture | None = None
    place: Place = field(default_factory=Place)

    def adapted(self, width: int) -> Value:
        """The same in ``width`` channels: one is repeated, of more the first are taken."""
        texture, factor = self.texture, self.factor
        if texture is not None and texture.pixels.shape[2] != width:
            texture = replace(texture, pixels=_channels(texture.pixels, width))
        factor = np.repeat(factor, width) if len(factor) == 1 else _channels(factor, width)
        return replace(self, factor=factor, texture=texture)

    def linear(self) -> NDArray[np.float32]:
        """(C,) or (H, W, C) numbers."""
        return self.factor if self.texture is None else self.texture.linear() * self.factor


def _channels(values: NDArray, width: int) -> NDArray:
    if values.shape[-1] < width:
        fill = np.repeat(values[..., :1], width, axis=-1)
        if values.shape[-1] > 1:
            fill[..., : values.shape[-1]] = values
            fill[..., values.shape[-1] :] = (
                np.iinfo(values.dtype).max if values.dtype.kind == "u" else 1
            )
        return fill
    return np.ascontiguousarray(values[..., :width])


def normal_map(given: Input, depth: int = 0) -> tuple[Value, float]:
    """(tangent-space normals stored as (n + 1) / 2, strength) of an input for normals. Raises
    NotUnderstood."""
    node = given.node
    if node is None or depth > MAX_DEPTH:
        raise Missing
    if node.category == "normalmap":
        space = node.input("space")
        if space is not None and space.value == "object":
            raise NotUnderstood("a normal map in object space")
        within = node.input("in")
        if within is None:
            raise Missing
        scale = evaluate(node.input("scale") or Input((1.0,)), 1)
        if scale.texture is not None:
            raise NotUnderstood("a normal map whose strength is a picture")
        return evaluate(within, 3), float(scale.factor[0])
    if node.category == "gltf_normalmap":
        return evaluate(given, 3), 1.0
    if node.category in ("dot", "convert", "normalize"):
        return normal_map(node.input("in") or Input(), depth + 1)
    if node.category == "UsdUVTexture":  # its scale and bias make normals of texels
        return combine(lambda n: n * np.float32(0.5) + np.float32(0.5), [evaluate(given, 3)]), 1.0
    raise NotUnderstood(f"the node '{node.category}'")


def evaluate(given: Input, width: int, depth: int = 0) -> Value:
    """What an input is worth, in ``width`` channels. Raises NotUnderstood."""
    if depth > MAX_DEPTH:
        raise NotUnderstood("a network that runs in circles")
    if given.node is None:
        if given.value is None or isinstance(given.value, str):
            raise Missing
        return Value(np.array(given.value, np.float32)).adapted(width)
    value = _select(_evaluate(given.node, depth + 1), given.node, given.output)
    return value.adapted(width)


def _select(value: Value, node: Node, output: str) -> Value:
    """One of several outputs of a node."""
    name = output.removeprefix("out")
    if (
        node.category in ("separate2", "separate3", "separate4", "gltf_colorimage", "UsdUVTexture")
        and name in _CHANNELS
    ):
        return _channel(value, _CHANNELS[name])
    return value


def _channel(value: Value, channel: int) -> Value:
    if channel == 3 and value.texture is not None and value.texture.pixels.shape[2] < 4:
        return Value(value.factor[3:4] if len(value.factor) > 3 else np.ones(1, np.float32))
    factor = value.factor[min(channel, len(value.factor) - 1)][None]
    if value.texture is None:
        return replace(value, factor=factor)
    pixels = value.texture.pixels[..., min(channel, value.texture.pixels.shape[2] - 1)][..., None]
    space = "linear" if channel == 3 else value.texture.color_space  # alpha is linear
    return Value(
        factor,
        replace(value.texture, pixels=np.ascontiguousarray(pixels), color_space=space),
        value.place,
    )


def _evaluate(node: Node, depth: int) -> Value:
    category = node.category

    def get(name: str, default: float = 0.0, width: int = 0) -> Value:
        return evaluate(node.input(name) or Input((default,)), width or node.width or 1, depth)

    if category in _IMAGES:
        return _image(node, depth)
    if category == "constant":
        return get("value")
    if category in ("dot", "convert"):
        return evaluate(node.input("in") or Input((0.0,)), node.width or 1, depth)
    if category.startswith("combine"):
        parts = [get(f"in{k + 1}", 0.0, 1) for k in range(int(category[7:]))]
        return combine(
            lambda *channels: np.concatenate(np.broadcast_arrays(*channels), axis=-1), parts
        )
    if category.startswith("separate"):
        return get("in", 0.0, 4 if category.endswith("4") else 3)
    if category == "extract":
        return _channel(get("in", 0.0, 4), int(number(node, "index", 0.0)))
    if category == "swizzle":
        picked = node.input("channels")
        names = str(picked.value) if picked is not None else ""
        if not names or any(n not in "rgbaxyzw01" for n in names):
            raise NotUnderstood("the node 'swizzle'")
        value = get("in", 0.0, 4)
        fixed = {d: Value(np.array([float(d)], np.float32)) for d in "01"}
        parts = [fixed[n] if n in fixed else _channel(value, _CHANNELS[n]) for n in names]
        if len(set(names)) == 1:
            return parts[0].adapted(len(names))
        return combine(
            lambda *channels: np.concatenate(np.broadcast_arrays(*channels), axis=-1), parts
        )
    if category == "switch":
        return get(f"in{int(number(node, 'which', 0.0)) + 1}")
    if category in ("geomcolor", "geompropvalue", "UsdPrimvarReader"):
        named = node.input("geomprop") or node.input("varname")
        if category == "geomcolor" or (named is not None and named.value in _MEANS_COLORS):
            return Value(
                np.ones(max(node.width, 1), np.float32)
            )  # the mesh's vertex colours take its place
    if category not in _ARITHMETIC:
        raise NotUnderstood(f"the node '{category}'")
    defaults, function = _ARITHMETIC[category]
    values = [
        _as_given(node.input(name) or Input((default,)), node.width, depth)
        for name, default in defaults.items()
    ]
    return combine(
        function,
        values,
        keeps_texture=category == "multiply"
        or (category == "divide" and not _textured(values[1:])),
    )


def _as_given(given: Input, width: int, depth: int) -> Value:
    """An argument of arithmetic: as many channels as the result, or the one that it has."""
    alone = (
        given.node is None
        and given.value is not None
        and not isinstance(given.value, str)
        and len(given.value) == 1
    )
    one = alone or (given.node is not None and given.node.width == 1)
    return evaluate(given, 1 if one else width or 1, depth)


def _textured(values: list[Value]) -> bool:
    return any(v.texture is not None for v in values)


def combine(
    function: Callable[..., NDArray], values: list[Value], keeps_texture: bool = False
) -> Value:
    """A function of values. ``keeps_texture``: it multiplies, so that one picture among constants
    stays as it is."""
    pictures = [v for v in values if v.texture is not None]
    if not pictures:
        with np.errstate(all="ignore"):
            return Value(np.asarray(function(*(v.factor for v in values)), np.float32))
    if keeps_texture and len(pictures) == 1:
        with np.errstate(all="ignore"):
            factor = np.asarray(function(*(v.factor for v in values)), np.float32)
        return replace(pictures[0], factor=factor).adapted(len(factor))
    if any(not v.place.equals(pictures[0].place) for v in pictures):
        raise NotUnderstood("pictures at different places, one combined with the other")
    height, width = (
        max(v.texture.pixels.shape[k] for v in pictures if v.texture is not None) for k in (0, 1)
    )
    arrays = [
        v.linear() if v.texture is None else resize(v.linear(), height, width) for v in values
    ]
    with np.errstate(all="ignore"):
        pixels = np.ascontiguousarray(function(*arrays), np.float32)
    if not np.isfinite(pixels).all():
        raise NotUnderstood("arithmetic that gives infinite texels")
    assert pictures[0].texture is not None
    texture = Texture(pixels, "linear", pictures[0].texture.wrap)
    return Value(np.ones(pixels.shape[2], np.float32), texture, pictures[0].place)


def number(node: Node, name: str, default: float) -> float:
    value = evaluate(node.input(name) or Input((default,)), 1)
    if value.texture is not None:
        raise NotUnderstood(f"the node '{node.category}' whose '{name}' is a picture")
    return float(value.factor[0])


def _pair(node: Node, name: str, default: float) -> NDArray[np.float64]:
    value = evaluate(node.input(name) or Input((default,)), 2)
    if value.texture is not None:
        raise NotUnderstood(f"the node '{node.category}' whose '{name}' is a picture")
    return value.factor.astype(np.float64)


def _image(node: Node, depth: int) -> Value:
    pixels = node.picture()
    if pixels is None:
        default = node.input("default") or node.input("fallback")
        if default is None:
            raise Missing
        return evaluate(default, node.width or 3, depth)
    several = node.category in (
        "gltf_colorimage",
        "UsdUVTexture",
    )  # they have channels as outputs of their own
    width = (pixels.shape[2] if pixels.shape[2] == 4 else 3) if several else node.width or 3
    pixels = pixels[..., :1] if width == 1 else _channels(images.to_color(pixels), width)
    file = node.input("file")
    given = file.space if file is not None else None
    space: ColorSpace = (
        (given or ("srgb" if pixels.dtype == np.uint8 else "linear")) if node.colors else "linear"
    )
    wraps = [node.input(n) or node.input(f"wrap{n[0].upper().replace('U', 'S').replace('V', 'T')}")
             for n in ("uaddressmode", "vaddressmode")]  # fmt: skip
    u, v = (_WRAPS.get(str(w.value), "clamp") if w is not None else "repeat" for w in wraps)
    texture = node.fitted(Texture(np.ascontiguousarray(pixels), space, (u, v)))
    place = _coordinates(node.input("texcoord") or node.input("st"), depth)
    factor = np.ones(width, np.float32)
    if node.category == "tiledimage":
        tiling, move = _pair(node, "uvtiling", 1.0), _pair(node, "uvoffset", 0.0)
        size = _pair(node, "realworldtilesize", 1.0) / _pair(node, "realworldimagesize", 1.0)
        place = place.then(_upward(np.diag(tiling * size), -move * size))
    elif node.category.startswith("gltf_"):
        place = place.then(_gltf_transform(node))
        tint = node.input("color" if node.category == "gltf_colorimage" else "factor")
        if tint is not None:
            factor = evaluate(tint, width, depth).factor
    elif node.category == "UsdUVTexture":
        scale, bias = (
            evaluate(node.input(n) or Input((d,)), width).factor
            for n, d in (("scale", 1.0), ("bias", 0.0))
        )
        factor = scale
        if bias.any():
            value = Value(scale, texture, place)
            return combine(lambda x, b: x + b, [value, Value(bias)])
    return Value(factor, texture, place)


def _coordinates(given: Input | None, depth: int) -> Place:
    """Where an image reads: which set of texture coordinates, and through which transform. Raises
    NotUnderstood."""
    if given is None or given.node is None:
        return Place()
    if depth > MAX_DEPTH:
        raise NotUnderstood("a network that runs in circles")
    node = given.node
    before = node.input("in") or node.input("texcoord")
    if node.category == "texcoord":
        return Place(f"st{int(number(node, 'index', 0.0)) or ''}")
    if node.category in ("geompropvalue", "UsdPrimvarReader"):
        named = node.input("geomprop") or node.input("varname")
        name = str(named.value) if named is not None and named.value else "st"
        return Place({"UV0": "st", "UV1": "st1"}.get(name, name))
    if node.category == "place2d":
        scale, move, pivot = (
            _pair(node, "scale", 1.0),
            _pair(node, "offset", 0.0),
            _pair(node, "pivot", 0.0),
        )
        turn = _rotation(number(node, "rotate", 0.0))
        if int(number(node, "operationorder", 0.0)) == 0:
            linear, offset = turn @ np.diag(1 / scale), -move
        else:
            linear = np.diag(1 / scale) @ turn
            offset = -linear @ move
        return _coordinates(before, depth + 1).then(
            _upward(linear, offset - linear @ pivot + pivot)
        )
    if node.category == "UsdTransform2d":
        scale, move = _pair(node, "scale", 1.0), _pair(node, "translation", 0.0)
        matrix = uv_transforms.usd_affine(tuple(scale), number(node, "rotation", 0.0), tuple(move))
        return _coordinates(before, depth + 1).then(matrix)
    if node.category == "rotate2d":
        return _coordinates(before, depth + 1).then(
            _upward(_rotation(number(node, "amount", 0.0)), np.zeros(2))
        )
    if node.category in ("dot", "convert"):
        return _coordinates(before, depth + 1)
    if node.category in ("multiply", "divide", "add", "subtract"):
        first, by = node.input("in1"), node.input("in2")
        if node.category in ("multiply", "add") and (first is None or first.node is None):
            first, by = by, first
        value = evaluate(by or Input((1.0,)), 2, depth)
        if value.texture is None:
            v = value.factor.astype(np.float64)
            scales = (
                {"multiply": v, "divide": 1 / v} if node.category in ("multiply", "divide") else {}
            )
            moves = {"add": v, "subtract": -v}
            matrix = _upward(
                np.diag(scales.get(node.category, np.ones(2))),
                moves.get(node.category, np.zeros(2)),
            )
            return _coordinates(first, depth + 1).then(matrix)
    raise NotUnderstood(f"the node '{node.category}' among texture coordinates")


def _gltf_transform(node: Node) -> NDArray[np.float64]:
    """KHR_texture_transform as the gltf_ nodes have it: they call place2d with what undoes its
    conventions."""
    scale, move, pivot = _pair(node, "scale", 1.0), _pair(node, "offset", 0.0), np.array([0.0, 1.0])
    given = node.input("pivot")
    pivot = pivot if given is None else _pair(node, "pivot", 0.0)
    linear = _rotation(-number(node, "rotate", 0.0)) @ np.diag(scale)
    return _upward(linear, move * (1, -1) - linear @ pivot + pivot)


def _rotation(degrees: float) -> NDArray[np.float64]:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s], [-s, c]])


def _upward(linear: NDArray, offset: NDArray) -> NDArray[np.float64]:
    """(2, 3) for coordinates that count v downward of a transform of those that count it upward."""
    (a, b), (c, d) = linear
    return np.array([[a, -b, b + offset[0]], [-c, d, 1 - d - offset[1]]])
