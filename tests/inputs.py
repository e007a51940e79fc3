"""Are inputs what they were? Hashes of files before and after a command."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from appearance_opt.asset.types import Asset
from appearance_opt.jobs.paths import Outputs


def hashes(files: Iterable[Path]) -> dict[Path, str]:
    """SHA-256 of files."""
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in files if path.is_file()}


@contextmanager
def unchanged(folder: Path, *written: str) -> Iterator[None]:
    """Fails if a file that is in ``folder`` is another one afterwards, but for names that match
    ``written``."""
    before = hashes(p for p in folder.iterdir() if not any(fnmatchcase(p.name, w) for w in written))
    yield
    assert hashes(before) == before


def watch_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on every job in this process fails if it changes a file that its inputs consist of,
    or one beside them that it does not write."""
    seen: dict[Path, str] = {}
    check_inputs, held = Outputs.check_inputs, Outputs.held

    def known(self: Outputs, *assets: Asset | None) -> None:
        check_inputs(self, *assets)
        patterns = [(folder.resolve(), pattern) for folder, pattern in self.patterns()]
        files = {file for asset in assets if asset is not None for file in asset.files}
        beside = {path for folder in {file.parent for file in files} for path in folder.iterdir()}
        seen.update(
            hashes(
                path
                for path in files | beside
                if path in files
                or (
                    not path.name.startswith(".")
                    and not any(
                        path.parent == folder and fnmatchcase(path.name, name)
                        for folder, name in patterns
                    )
                )
            )
        )

    @contextmanager
    def watched(self: Outputs) -> Iterator[None]:
        seen.clear()
        with held(self):
            yield
        assert hashes(seen) == seen, "a job has changed its input"

    monkeypatch.setattr(Outputs, "check_inputs", known)
    monkeypatch.setattr(Outputs, "held", watched)
