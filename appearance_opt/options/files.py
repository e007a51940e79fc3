"""How results are written."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from appearance_opt.errors import InputError
from appearance_opt.options.option import Record, option

if TYPE_CHECKING:
    from pathlib import Path

    from appearance_opt.asset.file_options import FileOptions

TARGETS = ("web", "game", "film")
COMPRESSIONS = ("none", "meshopt")

_BY_TARGET = "by --for"


def _textures(value: Any) -> str:
    if not isinstance(value, str):
        raise InputError(f"--textures {value!r}: write a codec such as webp, or color=webp:90")
    from appearance_opt.asset.file_options import parse_textures

    parse_textures(value)
    return value


@dataclass(frozen=True)
class OutputOptions(Record):
    """``target``: a use, which sets what is not given (see ``asset.file_options.for_target``).
    ``textures``: see ``asset.file_options.parse_textures``."""

    target: str | None = option(
        None,
        "What the result is for: sets --textures, --compress and --quantize where they are not "
        "given.",
        panel="Output",
        key="target",
        flag="--for",
        choices=TARGETS,
    )
    textures: str | None = option(
        None,
        "Codec of the textures, png, jpeg, webp or ktx2, with a quality, for all maps or by kind: "
        "webp:85, or color=jpeg:90,normal=png,material=webp.",
        panel="Output",
        metavar="CODEC",
        automatic=f"png, or {_BY_TARGET}",
        parse=_textures,
    )
    compress: str | None = option(
        None,
        "Compression of vertices in .glb and .gltf.",
        panel="Output",
        choices=COMPRESSIONS,
        automatic=f"none, or {_BY_TARGET}",
    )
    quantize: bool | None = option(
        None,
        "Vertices of 16 bits in .glb and .gltf (KHR_mesh_quantization).",
        panel="Output",
        automatic=f"off, or {_BY_TARGET}",
    )

    def for_file(self, path: Path) -> FileOptions:
        """How to write ``path``. Raises InputError if its format cannot hold what was asked for, or
        what writes it is not installed."""
        from appearance_opt.asset.file_options import PLAIN, for_target, parse_textures

        out = PLAIN if self.target is None else for_target(self.target, path)  # type: ignore[arg-type]
        if self.textures is not None:
            out = parse_textures(self.textures, out)
        given: dict[str, Any] = {"compress": self.compress, "quantize": self.quantize}
        out = replace(out, **{k: v for k, v in given.items() if v is not None})
        out.check(path)
        return out
