"""What a reader dropped, repaired or assumed, in few lines however often it happens."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

LISTED = 3
"""Names that a note gives; more are counted."""

LINES = 8
"""Notes of one kind that are told one by one; more are counted."""

_SUBJECT = re.compile(r"(?:(\w+) )?'([^']*)': (?:(\d+) )?(.*)", re.DOTALL)


@dataclass
class _Kind:
    """Notes that say the same of several: their names, each once, and the sum of their numbers."""

    names: dict[str, None] = field(default_factory=dict)
    total: int | None = None


class Notes:
    """Collects notes, each told once, in the order in which they came.

    A note of the form ``material 'a': what`` is of one kind with others of ``what``, and so are
    ``mesh 'a': 3 faces dropped`` and ``mesh 'b': 4 faces dropped``: they become one line, which
    gives the first names, counts the others and sums the numbers.
    """

    def __init__(self) -> None:
        self._kinds: dict[tuple[str, ...], _Kind] = {}

    def __call__(self, text: str, kind: str | None = None) -> None:
        """Add a note. ``kind``: for one without a subject, what it has in common with others: of
        these the first ``LINES`` are told in full."""
        subject = _SUBJECT.fullmatch(text) if kind is None else None
        if subject is None:
            self._kinds.setdefault(("", kind or text), _Kind()).names[text] = None
            return
        what, name, number, rest = subject.groups()
        found = self._kinds.setdefault((what or "", rest, "" if number is None else "#"), _Kind())
        found.names[name] = None
        if number is not None:
            found.total = (found.total or 0) + int(number)

    def lines(self) -> tuple[str, ...]:
        """The notes, one line each."""
        out: list[str] = []
        for (what, *rest), kind in self._kinds.items():
            names = list(kind.names)
            if len(rest) == 1:
                out += names[:LINES]
                if len(names) > LINES:
                    out.append(f"... and {len(names) - LINES} more: {rest[0]}")
                continue
            listed = ", ".join(f"'{name}'" for name in names[:LISTED])
            more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
            plural = {"mesh": "meshes"}.get(what, what + "s") if what and len(names) > 1 else what
            number = "" if kind.total is None else f"{kind.total} "
            out.append(f"{plural} {listed}{more}: {number}{rest[0]}".lstrip())
        return tuple(out)


def counted(number: int, one: str, many: str = "") -> str:
    """A number of things: "1 mesh", "2 meshes"; ``many``: their plural, if it is not ``one``s."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"
