"""How files are written: the codec of each kind of map, quantised and compressed vertices."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, get_args

from appearance_opt.asset import ktx2
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

Codec = Literal["png", "jpeg", "webp", "ktx2"]
MapKind = Literal["color", "normal", "material"]
Mode = Literal["lossy", "lossless", "etc1s", "uastc"]
Compression = Literal["none", "meshopt"]
Target = Literal["web", "game", "film"]

CODECS: tuple[Codec, ...] = get_args(Codec)
KINDS: tuple[MapKind, ...] = get_args(MapKind)
COMPRESSIONS: tuple[Compression, ...] = get_args(Compression)
TARGETS: tuple[Target, ...] = get_args(Target)

GLTF, USD, OBJ = (".glb", ".gltf"), (".usd", ".usda", ".usdc", ".usdz"), (".obj",)

QUALITY: dict[MapKind, int] = {"color": 90, "normal": 95, "material": 90}
"""Of lossy codecs, where none is given: an error of a normal moves highlights."""

WEB = "color=webp:80,normal=jpeg:90,material=webp:60"
"""Lossy WebP halves the resolution of colour differences, and normals are such: at any quality it
costs 0.5 dB on flight_helmet, where JPEG, which need not do so, costs 0.1."""

_MODES: dict[Codec, tuple[Mode, ...]] = {
    "png": ("lossless",),
    "jpeg": ("lossy",),
    "webp": ("lossy", "lossless"),
    "ktx2": ("etc1s", "uastc"),
}
"""Of each codec, the first one by default, but for what ``_default`` says."""

_HELD: dict[tuple[str, ...], tuple[Codec, ...]] = {
    GLTF: CODECS,
    USD: ("png", "jpeg"),
    OBJ: ("png", "jpeg"),
}


@dataclass(frozen=True)
class TextureFormat:
    """How the maps of one kind are stored. ``quality``: 1 to 100, of modes that lose something,
    100 for the others. PNG keeps 16 bits where a map has them; the others hold 8."""

    codec: Codec = "png"
    mode: Mode = "lossless"
    quality: int = 100


PNG = TextureFormat()


@dataclass(frozen=True)
class FileOptions:
    """How an asset is written. ``color``: base colours and emission; ``normal``: normal maps;
    ``material``: roughness, metalness and occlusion, transmission, thickness, opacity. Height maps
    are 16-bit PNG in any case. ``quantize``: integers for the attributes of vertices
    (KHR_mesh_quantization); ``compress``: "meshopt" (EXT_meshopt_compression)."""

    color: TextureFormat = field(default_factory=TextureFormat)
    normal: TextureFormat = field(default_factory=TextureFormat)
    material: TextureFormat = field(default_factory=TextureFormat)
    quantize: bool = False
    compress: Compression = "none"

    def format_of(self, kind: MapKind) -> TextureFormat:
        """Of a kind of map."""
        return {"color": self.color, "normal": self.normal, "material": self.material}[kind]

    def check(self, path: Path) -> None:
        """Raise InputError if the format of ``path`` cannot hold it, or what writes it is not
        installed."""
        suffix = path.suffix.lower()
        held = next((codecs for suffixes, codecs in _HELD.items() if suffix in suffixes), CODECS)
        for kind in KINDS:
            codec = self.format_of(kind).codec
            if codec not in held:
                raise InputError(
                    f"{path}: {suffix} files cannot hold {codec} textures; use --textures "
                    f"{' or '.join(held)}, or write .glb"
                )
        if suffix not in GLTF:
            for given, option in (
                (self.quantize, "--quantize"),
                (self.compress != "none", f"--compress {self.compress}"),
            ):
                if given:
                    raise InputError(f"{path}: {option} is for .glb and .gltf; leave it out")
        if any(self.format_of(kind).codec == "ktx2" for kind in KINDS):
            ktx2.find_encoder()
        if self.compress == "meshopt" and not _has_meshopt():
            raise InputError(
                "--compress meshopt needs the package meshopt: pip install meshopt "
                "(Python 3.11 or newer)"
            )


PLAIN = FileOptions()
"""PNG and 32-bit floats: what every reader takes, without loss."""


def parse_textures(text: str, given: FileOptions = PLAIN) -> FileOptions:
    """``given`` with the codecs that ``text`` names: "webp", "jpeg:85" for all maps,
    "color=webp:90,normal=png" for some; what is said of one kind goes before what is said of all.
    Behind the colon: a quality of 1 to 100, or "lossless" (WebP), "etc1s", "uastc" (KTX 2.0).
    Raises InputError."""
    every: dict[str, str] = {}
    for item in text.split(","):
        kind, equals, value = item.strip().rpartition("=")
        if equals and kind not in KINDS:
            raise _wrong(text, f"'{kind}' is no kind of map; choose from {', '.join(KINDS)}")
        if kind in every:
            raise _wrong(text, f"'{kind or 'all maps'}' is given twice")
        every[kind] = value
    formats = {}
    for kind in KINDS:
        value = every.get(kind, every.get("", ""))
        if value:
            formats[kind] = _parse_format(value, kind, text)
    if "" in every and not every[""]:
        raise _wrong(text, f"choose from {', '.join(CODECS)}")
    return replace(given, **formats)  # type: ignore[arg-type]


def _parse_format(value: str, kind: MapKind, text: str) -> TextureFormat:
    name, colon, detail = value.partition(":")
    codec = next((c for c in CODECS if c == name.replace("jpg", "jpeg")), None)
    if codec is None:
        raise _wrong(text, f"'{name}' is no codec; choose from {', '.join(CODECS)}")
    modes = _MODES[codec]
    mode = _default(codec, kind)
    quality = QUALITY[kind]
    if colon:
        found = next((m for m in modes if m == detail), None)
        if found is not None:
            mode = found
        elif detail.isascii() and detail.isdigit() and 1 <= int(detail) <= 100 and codec != "png":
            mode, quality = modes[0], int(detail)
        else:
            known = [m for m in modes if m != "lossy"]
            choice = known if codec == "png" else ["a quality of 1 to 100", *known]
            raise _wrong(text, f"'{detail}' behind {codec}: choose {' or '.join(choice)}")
    return TextureFormat(codec, mode, quality if mode in ("lossy", "etc1s") else 100)


def _default(codec: Codec, kind: MapKind) -> Mode:
    """ETC1S has one pair of colours for a block of texels, which what is no colour does not have;
    of lossy WebP see ``WEB``."""
    if codec == "ktx2" and kind != "color":
        return "uastc"
    return "lossless" if codec == "webp" and kind == "normal" else _MODES[codec][0]


def _wrong(text: str, reason: str) -> InputError:
    return InputError(f"--textures {text}: {reason}")


def for_target(target: Target, path: Path) -> FileOptions:
    """What suits a use, as far as the format of ``path`` can hold it and this machine can write it.

    "web": few bytes, WebP, normals as JPEG (all of them in USD and OBJ), quantised and compressed
    vertices. "game": KTX 2.0
    if an encoder is installed, which stays compressed in the memory of a GPU, and quantised
    vertices; else PNG, which engines compress themselves when they import it. "film": nothing is
    lost: PNG, 32-bit floats.
    """
    gltf = path.suffix.lower() in GLTF
    if target == "web":
        compress: Compression = "meshopt" if gltf and _has_meshopt() else "none"
        return replace(parse_textures(WEB if gltf else "jpeg:80"), quantize=gltf, compress=compress)
    if target == "game" and gltf:
        return replace(parse_textures("ktx2" if ktx2.encoder() else "png"), quantize=True)
    return PLAIN


def _has_meshopt() -> bool:
    return importlib.util.find_spec("meshopt") is not None
