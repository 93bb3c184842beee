"""Imports go one way: what a part is made of never knows what is made of it."""

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import torchrl_nerd

PACKAGE = Path(torchrl_nerd.__file__).parent
LEAVES = {
    "compat",
    "compiled",
    "files",
    "row_threads",
    "seeds",
    "settings",
    "__version__",
}
LEVELS = (
    {"keys", "configs", "geometry", "tensor_files"},
    {"scenes"},
    {"tasks"},
    {"robots"},
    {"transforms", "analytic"},
    {"modules"},
    {"dynamics"},
    {"card", "selfcheck", "checkpoint"},
    {"envs"},
    {"data", "training", "evaluation"},
    {"cli", "gymnasium"},
)
LEVEL = {part: level for level, parts in enumerate(LEVELS) for part in parts}
SOURCES = [path for path in sorted(PACKAGE.rglob("*.py")) if path.parent != PACKAGE]
SOURCES += [
    p for p in sorted(PACKAGE.glob("*.py")) if p.stem not in ("__init__", "__main__")
]


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(path: Path) -> Iterator[tuple[str, ...]]:
    """Dotted names that a file imports, wherever in the file it does."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (tuple(alias.name.split(".")) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} has a relative import"
            assert node.module is not None
            yield from ((*node.module.split("."), a.name) for a in node.names)


def own_imports(path: Path) -> set[str]:
    """Parts of the package that a file imports; ``__version__`` counts as one."""
    names = [name for name in imported(path) if name[0] == "torchrl_nerd"]
    assert all(len(name) > 1 for name in names), (
        f"{path.name} imports the whole package"
    )
    return {name[1] for name in names} - {part_of(path)}


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_arrows_never_turn_back(path):
    part, found = part_of(path), own_imports(path)
    if part in LEAVES:
        assert not found - LEAVES
        return
    assert part in LEVEL, f"{part} has no place in the order of imports"
    for other in found - LEAVES:
        assert LEVEL[other] <= LEVEL[part], f"{part} imports {other}"


def test_parts_of_one_level_import_each_other_one_way_at_most():
    graph: dict[str, set[str]] = {}
    for path in SOURCES:
        graph.setdefault(part_of(path), set()).update(own_imports(path) - LEAVES)
    assert set(graph) >= set(LEVEL) - {"data", "training", "evaluation", "cli"}
    list(TopologicalSorter(graph).static_order())  # raises on a cycle


def test_files_of_one_part_import_each_other_one_way_at_most():
    modules = {
        ".".join(path.relative_to(PACKAGE).with_suffix("").parts): path
        for path in SOURCES
        if path.stem != "__init__"
    }
    graph: dict[str, set[str]] = {}
    for name, path in modules.items():
        targets = (".".join(x[1:-1]) for x in imported(path) if x[0] == "torchrl_nerd")
        graph[name] = {target for target in targets if target in modules}
    assert len(graph) > 20 and any(graph.values())
    list(TopologicalSorter(graph).static_order())


def test_checkpoints_know_no_env():
    found = own_imports(PACKAGE / "checkpoint.py") - LEAVES
    assert found <= {
        "scenes",
        "robots",
        "modules",
        "transforms",
        "keys",
        "geometry",
        "analytic",
        "card",
        "configs",
        "dynamics",
        "selfcheck",
        "tensor_files",
    }
    users = {part_of(path) for path in SOURCES if "checkpoint" in own_imports(path)}
    assert min(map(LEVEL.get, users)) >= LEVEL["envs"]


def test_the_package_needs_neither_tests_nor_examples():
    outside = {"tests", "examples", "benchmarks", "helpers", "conftest"}
    for path in PACKAGE.rglob("*.py"):
        assert not outside & {name[0] for name in imported(path)}, path.name
