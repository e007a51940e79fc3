"""Which parts of an asset are fitted, and whether they stay parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from appearance_opt.errors import InputError
from appearance_opt.options.option import Record, option

PARTS = ("keep", "merge")


def _names(value: Any) -> tuple[str, ...]:
    given = [value] if isinstance(value, str) else value
    if not isinstance(given, (list, tuple)) or not all(isinstance(v, str) and v for v in given):
        raise InputError(f"--keep {value!r}: write the name of a node or a material")
    return tuple(given)


@dataclass(frozen=True)
class PartOptions(Record):
    """``parts``: "keep" writes what was fitted as the nodes that it stems from, "merge" as one
    mesh. ``keep``: names of nodes and materials that pass into the result as they are."""

    parts: str = option(
        "keep",
        "Parts are written as the nodes that they were, with names and pivots, or as one mesh.",
        panel="Output",
        choices=PARTS,
    )
    keep: tuple[str, ...] = option(
        (),
        "Node or material that passes into the result as it is (repeatable, with * and ?).",
        panel="Input",
        metavar="NAME",
        repeated=True,
        parse=_names,
    )
