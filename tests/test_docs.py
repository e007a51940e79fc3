"""The documentation's samples run, its links lead somewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.S)


@pytest.mark.parametrize("sample", SAMPLES, ids=range(len(SAMPLES)))
def test_samples_run(sample: str) -> None:
    done = subprocess.run([sys.executable, "-c", sample], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def test_links_lead_somewhere(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "scripts/build_docs.py", str(tmp_path)], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "design.html").is_file()
    for link in re.findall(r"\]\(([^)#:]+)\)", (ROOT / "README.md").read_text(encoding="utf-8")):
        assert (ROOT / link).exists(), link


def names(text: str, option: str) -> bool:
    """Does a text name this very option as code, and not only a longer one that begins like it?"""
    return re.search(rf"`--{option.replace('_', '-')}(?![\w-])", text) is not None


def test_every_option_is_documented() -> None:
    from appearance_opt.config import OPTION_NAMES

    text = (ROOT / "docs" / "usage.md").read_text(encoding="utf-8")
    assert not [n for n in OPTION_NAMES if not names(text, n)]


def test_every_option_of_a_bake_is_documented() -> None:
    from appearance_opt.config import BAKE_OPTION_NAMES, MAPS

    text = (ROOT / "docs" / "baking.md").read_text(encoding="utf-8")
    assert not [n for n in BAKE_OPTION_NAMES if not names(text, n)]
    assert not [n for n in MAPS if f"`{n}`" not in text]
