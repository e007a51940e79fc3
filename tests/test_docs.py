"""The documentation's samples run, its links lead somewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = re.findall(
    r"```python\n(.*?)```", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.S
)


@pytest.mark.parametrize("sample", SAMPLES, ids=range(len(SAMPLES)))
def test_samples_run(sample: str) -> None:
    done = subprocess.run([sys.executable, "-c", sample], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def test_links_lead_somewhere(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "scripts/build_docs.py", str(tmp_path)],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "design.html").is_file()
    for link in re.findall(r"\]\(([^)#:]+)\)", (ROOT / "README.md").read_text(encoding="utf-8")):
        assert (ROOT / link).exists(), link


PAGES = sorted((ROOT / "docs").glob("*.md"))


def headings(page: Path) -> set[str]:
    """The anchors that GitHub makes of a page's headings."""
    lines = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", line.lower()).strip().replace(" ", "-") for line in lines}


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda p: p.stem)
def test_headings_that_links_name_are_there(page: Path) -> None:
    for target, heading in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", page.read_text(encoding="utf-8")):
        assert heading in headings(page.parent / target if target else page), f"{target}#{heading}"


def test_topics_that_code_names_are_there() -> None:
    topics = headings(ROOT / "docs" / "trials.md")
    for path in (ROOT / "appearance_opt").rglob("*.py"):
        for topic in re.findall(r"docs/trials\.md: ([a-z-]+)", path.read_text(encoding="utf-8")):
            assert topic in topics, f"{path}: {topic}"


@pytest.mark.parametrize("name", ["method", "design"])
def test_files_and_functions_that_pages_name_are_there(name: str) -> None:
    text = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    for path, function in re.findall(r"`([a-z_]+(?:/[a-z_]+)*\.py)(?:: ([\w.]+))?`", text):
        places = [p for p in (ROOT / path, ROOT / "appearance_opt" / path) if p.is_file()]
        assert places or list((ROOT / "appearance_opt").rglob(path)), path
        if function:
            code = places[0].read_text(encoding="utf-8")
            last = function.split(".")[-1]
            assert re.search(rf"^\s*(?:def|class) {last}\b|^{last}\b", code, re.M), (
                f"{path}: {function}"
            )


def test_lines_of_pages_are_short() -> None:
    """A hundred columns at most, but for tables and links."""
    for page in [*PAGES, ROOT / "README.md", ROOT / "CHANGELOG.md"]:
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
            assert len(line) <= 100 or line.startswith(("|", "![")), f"{page.name}:{number}"


def undocumented(kind: type, *pages: str) -> list[str]:
    """Options that none of the pages names as code, as this very option and not only a longer one
    that begins like it."""
    from appearance_opt.options.option import entries, spelling

    text = "\n".join((ROOT / "docs" / f"{p}.md").read_text(encoding="utf-8") for p in pages)
    spelt = [spelling(entry.spec, key) for key, entry in entries(kind).items()]
    return [s for s in spelt if re.search(rf"`--{s}(?![\w-])", text) is None]


def test_every_option_is_documented() -> None:
    from appearance_opt.config import BakeOptions, JointOptions, LodOptions, SimplifyOptions
    from appearance_opt.options.baking import MAPS
    from appearance_opt.options.source import SourceOptions

    assert not undocumented(SimplifyOptions, "usage", "files")
    assert not undocumented(LodOptions, "lod", "usage", "files")
    assert not undocumented(BakeOptions, "baking", "files")
    assert not undocumented(JointOptions, "baking", "files")
    assert not undocumented(SourceOptions, "black_boxes")
    text = (ROOT / "docs" / "baking.md").read_text(encoding="utf-8")
    assert not [n for n in MAPS if f"`{n}`" not in text]
