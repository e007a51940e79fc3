"""The one-way flow of docs/design.md, read from the imports: no floor knows of one above it, and no
circle."""

from __future__ import annotations

import ast
from pathlib import Path

import appearance_opt

ROOT = Path(appearance_opt.__file__).parent
FLOORS = (
    ("errors", "memory", "digest", "asset", "lock", "publish"),
    ("views", "backend", "placement", "options", "config", "progress", "interrupts", "doctor"),
    ("render", "sdf"),
    ("latent", "reference", "baking", "initial"),
    ("optimize",),
    ("stages",),
    ("evaluate",),
    ("jobs",),
    ("cli", "parameters", "__init__", "__main__"),
)


def modules() -> dict[str, Path]:
    """Every module by its name without that of the package."""
    return {".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in ROOT.rglob("*.py")}


def imports(path: Path, known: dict[str, Path], types: bool = False) -> set[str]:
    """Modules of the package that a module imports, within functions, too; what only types need if
    ``types``."""
    found: set[str] = set()

    def walk(node: ast.AST) -> None:
        if not types and isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            return
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == ROOT.name:
            base = node.module.partition(".")[2]  # type: ignore[union-attr]
            for alias in node.names:
                full = f"{base}.{alias.name}" if base else alias.name
                names = (full, base, f"{base}.__init__")
                found.update([n for n in names if n in known][:1])
        for child in ast.iter_child_nodes(node):
            walk(child)

    walk(ast.parse(path.read_text(encoding="utf-8")))
    return found


def test_every_part_has_its_floor_and_none_looks_up() -> None:
    known = modules()
    assert {"errors", "progress"} <= imports(known["cli"], known)  # it sees those within functions
    floor = {part: number for number, parts in enumerate(FLOORS) for part in parts}
    assert {name.split(".")[0] for name in known} == set(floor)
    above = [
        f"{name} imports {other}"
        for name, path in known.items()
        for other in imports(path, known)
        if floor[other.split(".")[0]] > floor[name.split(".")[0]]
    ]
    assert not above


def test_no_module_imports_itself_by_way_of_others() -> None:
    """Nor for types: what two modules share has a module of its own."""
    known = modules()
    graph = {name: imports(path, known, types=True) - {name} for name, path in known.items()}
    while leaves := [name for name, others in graph.items() if not others & graph.keys()]:
        for name in leaves:
            del graph[name]
    circle = {name for name in graph if any(name in others for others in graph.values())}
    assert not circle
