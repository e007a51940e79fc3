"""The memory that reading one asset may take: asked for before it is allocated, refused with the
number.

A few bytes of a file can ask for any amount: pictures of one colour, accessors without data,
instances of instances. What is counted here is what stays in memory while an asset is read,
roughly; it protects the machine, and a reader need not be exact about it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from appearance_opt.errors import InputError
from appearance_opt.memory import available_memory

if TYPE_CHECKING:
    from appearance_opt.asset.types import Mesh

SHARE = 0.5
"""Share of the memory that is free which reading may take; what is made of the asset afterwards
takes the rest."""

UNKNOWN = 8 << 30
"""Bytes allowed where the system does not say how much memory is free."""

BYTES = {"vertices": 150, "faces": 60, "prims": 3000, "nodes": 3000, "instances": 500}
"""About what one takes while it is read, in double precision and with its copies."""

PICTURE_COPIES = 2
"""A picture's pixels lie in memory this often at a time."""


def _allowed() -> int:
    free = available_memory()
    return UNKNOWN if free is None else int(SHARE * free)


@dataclass
class Budget:
    """``limit``: bytes that all of an asset may take together; ``used``: those that were taken so
    far."""

    limit: int = field(default_factory=_allowed)
    used: int = 0

    def take(self, count: int, kind: str, owner: object) -> None:
        """Count ``count`` more of a ``kind`` of ``BYTES``. Raises InputError, naming ``owner``, if
        that is too much."""
        self._add(count * BYTES[kind], f"{count:,} {kind}", owner)

    def take_copies(self, mesh: Mesh, copies: int, owner: object) -> None:
        """Count a mesh ``copies`` times. Raises InputError as ``take`` does."""
        self.take(len(mesh.positions) * copies, "vertices", owner)
        self.take(len(mesh.faces) * copies, "faces", owner)

    def take_picture(self, width: int, height: int, bytes_per_pixel: int, owner: object) -> None:
        """Count a picture. Raises InputError as ``take`` does."""
        size = width * height * bytes_per_pixel * PICTURE_COPIES
        self._add(size, f"a picture of {width} x {height} pixels", owner)

    def give_back_picture(self, width: int, height: int, bytes_per_pixel: int) -> None:
        """Count a picture no more: a smaller one stands for it."""
        self.used -= width * height * bytes_per_pixel * PICTURE_COPIES

    def _add(self, size: int, what: str, owner: object) -> None:
        total = self.used + size
        if total > self.limit:
            raise InputError(
                f"{owner}: with {what}, reading it takes about {total / 2**30:.1f} GiB of memory, and "
                f"{self.limit / 2**30:.1f} GiB may be used here; make it smaller, or use a machine with more memory"
            )
        self.used = total
