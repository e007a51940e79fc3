"""A source of ``convert`` once it is open."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from appearance_opt.reference.album import Album, Numbered

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from appearance_opt.reference.subject import Subject

LEAST = 192
"""Pixels per side of images that are kept, at least: what looks for a shape sees so many."""


@dataclass(frozen=True)
class Opened:
    """``subject``: what is fitted to; ``name`` of the result; ``files`` that it was read from,
    which no result may replace; ``notes``: what the user should know of it. ``slow``: are its
    images worth keeping? ``close``: ends what was started for it."""

    subject: Subject
    name: str
    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()
    slow: bool = False
    close: Callable[[], None] = lambda: None

    def kept(self, resolution: int, folder: Path | None, job: str) -> Opened:
        """The same with an album of its images, if they are worth it (see ``Album``)."""
        if not self.slow:
            return self
        subject = self.subject
        album = Album(subject.reference, max(resolution, LEAST), folder, job)
        subject = replace(subject, reference=album, sampler=Numbered(subject.sampler))
        return replace(self, subject=subject)
