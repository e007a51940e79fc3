"""A source of ``convert`` once it is open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from appearance_opt.reference.subject import Subject


@dataclass(frozen=True)
class Opened:
    """``subject``: what is fitted to; ``name`` of the result; ``files`` that it was read from,
    which no result may replace; ``notes``: what the user should know of it."""

    subject: Subject
    name: str
    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()
