"""Experiments start, and the commands that documents give for them exist."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOREIGN = {
    "experiments.baking.blender_bake",
    "experiments.engines.blender_views",
    "experiments.quality.blender_simplify",
}
"""Run in Blender's own Python."""

FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    .removesuffix(".__init__")
    .removesuffix(".__main__"): path
    for path in sorted((ROOT / "experiments").rglob("*.py"))
}
"""Every module by the name that ``python -m`` knows it by: a package stands for its ``__main__``,
if it has one."""

STARTED = """
import contextlib, importlib, io, json, runpy, sys
found = {}
for name, runs in json.loads(sys.argv[1]).items():
    out = io.StringIO()
    try:
        with contextlib.redirect_stdout(out):
            if not runs:
                importlib.import_module(name)
            else:
                sys.argv = [name, "--help"]
                runpy.run_module(name, run_name="__main__", alter_sys=True)
        found[name] = [None, out.getvalue()]
    except BaseException as error:
        found[name] = [f"{type(error).__name__}: {error}", out.getvalue()]
print(json.dumps(found))
"""
"""``--help`` of each module as ``python -m`` runs it, or its import, all in one process."""


def runs(path: Path) -> bool:
    return 'if __name__ == "__main__":' in path.read_text(encoding="utf-8")


def reads_arguments(path: Path) -> bool:
    return "ArgumentParser(" in path.read_text(encoding="utf-8")


@cache
def started() -> dict[str, tuple[str | None, str]]:
    """(how it ended, what it printed) by module."""
    modules = {n: runs(p) and reads_arguments(p) for n, p in FILES.items() if n not in FOREIGN}
    command = [sys.executable, "-W", "ignore::RuntimeWarning", "-c", STARTED, json.dumps(modules)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return {n: (how, text) for n, (how, text) in json.loads(done.stdout.splitlines()[-1]).items()}


@pytest.mark.parametrize("name", [n for n in FILES if n not in FOREIGN])
def test_it_starts_and_shows_its_help(name: str) -> None:
    how, text = started()[name]
    if runs(FILES[name]) and reads_arguments(FILES[name]):
        assert how == "SystemExit: 0" and text.startswith("usage:"), how
    else:
        assert how is None
        # what takes no options must not read them past argparse
        assert (
            "sys.argv[1"
            not in FILES[name].read_text(encoding="utf-8").split('if __name__ == "__main__":')[0]
        )


@pytest.mark.parametrize("name", sorted(FOREIGN))
def test_a_script_for_blender_compiles(name: str) -> None:
    compile(FILES[name].read_text(encoding="utf-8"), name, "exec")


def commands(text: str) -> list[tuple[str, list[str]]]:
    """(module, flags) of every ``python -m experiments...`` in Markdown: a line of a block, or a
    span, which may go on in the next line."""
    blocks = re.findall(r"^```\w*\n(.*?)^```|^ {4}(\S.*)$", text, re.S | re.M)
    lines = [line.split(" #")[0] for block in blocks for line in "\n".join(block).splitlines()]
    spans = re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```", "", text, flags=re.S | re.M))
    found = (re.search(r"python -m (experiments[\w.]*)(.*)", c, re.S) for c in [*lines, *spans])
    return [(m[1], re.findall(r"(?<![\w-])--[a-z][a-z-]*", m[2])) for m in found if m]


PLACES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "experiments").glob("*/README.md")),
]


@pytest.mark.parametrize(
    "place",
    [p for p in PLACES if commands(p.read_text("utf-8"))],
    ids=lambda p: p.parent.name + "/" + p.name,
)
def test_commands_in_documents_exist(place: Path) -> None:
    for module, flags in commands(place.read_text(encoding="utf-8")):
        assert module in FILES and runs(FILES[module]), module
        unknown = [f for f in flags if not re.search(rf"{f}(?![\w-])", started()[module][1])]
        assert not unknown, f"python -m {module} has no {', '.join(unknown)}"


def test_commands_are_found_where_documents_have_them() -> None:
    block = "```\npython -m experiments.a --x 1  # --no\n```\n"
    text = f"{block}\nsee `python -m experiments.b.c --y\n  --z-z 2` and\n\n    python -m experiments.d\n"
    assert commands(text) == [
        ("experiments.a", ["--x"]),
        ("experiments.d", []),
        ("experiments.b.c", ["--y", "--z-z"]),
    ]
