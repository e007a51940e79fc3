"""A bounded number of damaged files of every format, read in processes of their own."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from tests.fuzz.campaign import run
from tests.fuzz.mutators import mutate
from tests.fuzz.seeds import SEEDS, write_seeds
from tests.fuzz.worker import outcome

SLOW = {"USDA", "USDC", "USDZ", "MaterialX"}
"""Formats that another process reads first (``asset.usd_guard``)."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", SEEDS)
def test_damaged_files_are_read_or_refused(kind: str) -> None:
    pytest.importorskip(
        "DracoPy" if kind == "Draco" else "meshopt" if kind == "meshopt" else "numpy"
    )
    tally = run(kind, 60 if kind in SLOW else 300)
    assert not tally.faults
    assert tally.refused  # and the damage is seen


def test_seeds_are_whole_and_damage_changes_them(tmp_path: Path) -> None:
    write_seeds(tmp_path)
    rng = random.Random(0)
    for kind, seed in SEEDS.items():
        data = (tmp_path / seed.file).read_bytes()
        if kind != "TOML":  # it has a key that is unknown
            assert outcome(seed.reader, tmp_path / seed.root) == "read", kind
        assert sum(mutate(kind, data, rng) != data for _ in range(20)) > 10, kind
