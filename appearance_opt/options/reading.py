"""How assets are read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike, fspath
from typing import Any

from appearance_opt.errors import InputError
from appearance_opt.options.option import Record, option

MISSING_TEXTURES = ("error", "ignore")


def _folder(value: Any) -> str:
    if not isinstance(value, (str, PathLike)):
        raise InputError(f"--root {value!r}: expected the name of a folder")
    return fspath(value)


def _variants(value: Any) -> tuple[str, ...]:
    given = [value] if isinstance(value, str) else value
    if isinstance(value, Mapping):
        given = [f"{name}={choice}" if name else choice for name, choice in value.items()]
    if not isinstance(given, (list, tuple)) or not all(isinstance(v, str) for v in given):
        raise InputError(f"--variant {value!r}: write set=name for USD, a name for glTF")
    for text in given:
        name, choice = _split(text)
        if ("=" in text and not name) or not choice:
            raise InputError(f"--variant {text}: write it as set=name for USD, as a name for glTF")
    return tuple(given)


def _split(text: str) -> tuple[str, str]:
    name, _, choice = text.partition("=") if "=" in text else ("", "", text)
    return name, choice


@dataclass(frozen=True)
class AssetOptions(Record):
    """What ``asset.load`` is given."""

    refine: int = option(
        1, "Level to which USD subdivision surfaces are refined.", panel="Input", low=0, high=5
    )
    missing_textures: str = option(
        "error",
        "What to do when the input names a texture that is not there.",
        panel="Input",
        choices=MISSING_TEXTURES,
    )
    root: str | None = option(
        None,
        "Folder in which files that the input refers to may lie, beside its own.",
        panel="Input",
        metavar="FOLDER",
        parse=_folder,
    )
    crease_angle: float | None = option(
        None,
        "STL, PLY, OBJ without normals: edges sharper than this (degrees) are hard.",
        panel="Input",
        low=0,
        high=180,
        expected="from 0 to 180 degrees",
        automatic="40, more in noise",
    )
    variant: tuple[str, ...] = option(
        (),
        "Variant of the input: set=name for USD (repeatable), a name for glTF.",
        panel="Input",
        metavar="NAME",
        repeated=True,
        parse=_variants,
    )

    def arguments(self) -> dict[str, Any]:
        """What ``asset.load`` is to be given."""
        return {
            "refine": self.refine,
            "variants": dict(map(_split, self.variant)) or None,
            "missing_textures": self.missing_textures,
            "root": self.root,
            "crease_angle": self.crease_angle,
        }
