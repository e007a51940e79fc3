"""What stands around every reader: one error for whatever damaged data raises, and names that are
text."""

from __future__ import annotations

import struct
import traceback
import zipfile
import zlib
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from appearance_opt.asset.paths import without_stray_bytes
from appearance_opt.errors import InputError, one_line

if TYPE_CHECKING:
    from collections.abc import Iterator

    from appearance_opt.asset.types import Asset, Material

DATA_FAULTS = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    OSError,
    RuntimeError,  # what libraries raise that are bound to C++, and RecursionError
    SyntaxError,  # of XML
    TypeError,
    ValueError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)
"""What data that is not as a reader expects can raise. Others (NameError, AssertionError,
ImportError ...) can only be faults of our own, and stay what they are."""

OUR_FAULTS = (NotImplementedError,)


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what damaged data raises into one InputError that names the file and the place where its
    reader stood, with the exception as its cause. InputErrors and faults of our own pass."""
    try:
        yield
    except MemoryError as error:
        raise InputError(
            f"{path}: asks for more memory than there is; it is damaged or too large"
        ) from error
    except OUR_FAULTS:
        raise
    except DATA_FAULTS as error:
        if isinstance(getattr(error, "obj", None), ModuleType):
            raise  # a package lacks a function: it has another version than we ask for
        raise InputError(
            f"{path}: its structure is broken "
            f"({type(error).__name__}: {str(error)[:120]}; found in {_place(error)}); export it again"
        ) from error


def _place(error: BaseException) -> str:
    """Where in this package an exception came from: ``module:line``."""
    package = Path(__file__).parent.parent
    ours = [
        f for f in traceback.extract_tb(error.__traceback__) if package in Path(f.filename).parents
    ]
    return f"{Path(ours[-1].filename).stem}:{ours[-1].lineno}" if ours else "a library"


def with_text_names(asset: Asset) -> Asset:
    """The asset with names that every writer takes: text without lone surrogates; and notes of one
    printable line."""
    renamed: dict[int, Material] = {}
    for mesh in asset.meshes:
        material = mesh.material
        if id(material) not in renamed:
            name = _text(material.name)
            renamed[id(material)] = (
                material if name == material.name else replace(material, name=name)
            )
    meshes = []
    for mesh in asset.meshes:
        name, material = _text(mesh.name), renamed[id(mesh.material)]
        same = name == mesh.name and material is mesh.material
        meshes.append(mesh if same else replace(mesh, name=name, material=material))
    return replace(
        asset,
        meshes=tuple(meshes),
        nodes=tuple(replace(n, name=_text(n.name)) for n in asset.nodes),
        notes=tuple(one_line(without_stray_bytes(note)) for note in asset.notes),
    )


def _text(name: object) -> str:
    return without_stray_bytes(str(name)).encode("utf-8", "replace").decode("utf-8")
